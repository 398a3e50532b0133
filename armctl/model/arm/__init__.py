"""The arm: joints, kinematics, dynamics, and their parity with MuJoCo."""

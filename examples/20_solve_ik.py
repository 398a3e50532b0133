"""Inverse kinematics of one pose: the solution, its measured error, and the result of a failure."""

import armctl

arm = armctl.load("robot_arm_3dof")

result = armctl.solve_ik(arm, [0.3, 0.2, 0.3])  # a point; a Pose also sets the orientation
print(f"q = {result.q.round(4)} rad: {result}")

near = armctl.solve_ik(arm, [0.3, 0.2, 0.31], q0=result.q)  # a warm start stays near
print(f"moved by at most {abs(near.q - result.q).max():.4f} rad for one centimetre")

clear = armctl.solve_ik(arm, [0.3, 0.2, 0.3], avoid=True)
print(f"without touching anything: {clear.ok}")

far = armctl.solve_ik(arm, [1.0, 0.2, 0.3])  # an answer, not an exception
print(f"{far}; the tip would be at {arm.fk(far.q).position.round(3)}")

"""Where to go: inverse kinematics, motions within limits, paths around obstacles, and streams of targets."""

"""Inverse kinematics.

`solve_ik` is for one target, `solve_ik_all` for all its solutions, `solve_ik_batch` for many targets, `DifferentialIk` for a
target that moves.
"""

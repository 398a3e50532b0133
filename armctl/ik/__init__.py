"""Inverse kinematics: `solve_ik` for one target, `solve_ik_batch` for many, `DifferentialIk` for a target that moves."""

from armctl.ik.result import IkResult
from armctl.ik.solve import solve_ik

__all__ = ["IkResult", "solve_ik"]

"""Inverse kinematics.

`solve_ik` is for one target, `solve_ik_all` for all its solutions, `solve_ik_batch` for many targets, `DifferentialIk` for a
target that moves.
"""

from armctl.ik.all_solutions import solve_ik_all
from armctl.ik.batch import solve_ik_batch
from armctl.ik.differential import DifferentialIk
from armctl.ik.reachability import Reachability, reachability
from armctl.ik.result import IkBatch, IkResult
from armctl.ik.solve import solve_ik

__all__ = [
    "DifferentialIk",
    "IkBatch",
    "IkResult",
    "Reachability",
    "reachability",
    "solve_ik",
    "solve_ik_all",
    "solve_ik_batch",
]

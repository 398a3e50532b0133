"""Experts: scripted policies that solve the tasks with armctl's inverse kinematics, motions and planner."""

from armctl.envs.experts.interface import Expert
from armctl.envs.experts.pick_place import PickPlaceExpert
from armctl.envs.experts.planned import ReachExpert, ReachPastExpert, TrackExpert
from armctl.envs.experts.push import PushExpert

EXPERTS: dict[str, type[Expert]] = {
    "Reach": ReachExpert,
    "ReachPast": ReachPastExpert,
    "Track": TrackExpert,
    "Push": PushExpert,
    "PickPlace": PickPlaceExpert,
}

__all__ = ["EXPERTS", "Expert"]

"""Command robot arms in MuJoCo from Python.

A public name is one line in each of the two lists below: where it is, for Python, which imports it when it is first used, and
the same for type checkers.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from armctl.core import hooks

__version__ = "0.1.0"

_MODULES = {
    "Adaptive": "armctl.control",
    "Arm": "armctl.robot.arm",
    "ArmctlError": "armctl.core.errors",
    "ArmctlWarning": "armctl.core.errors",
    "ComputedTorque": "armctl.control",
    "Controller": "armctl.control",
    "DifferentialIk": "armctl.ik",
    "IkBatch": "armctl.ik",
    "GripResult": "armctl.sim.gripper",
    "Gripper": "armctl.sim.gripper",
    "IkResult": "armctl.ik",
    "Impedance": "armctl.control",
    "InputError": "armctl.core.errors",
    "LimitError": "armctl.core.errors",
    "Limits": "armctl.core.trajectory",
    "Log": "armctl.core.log",
    "ModelError": "armctl.core.errors",
    "MoveResult": "armctl.core.result",
    "NotInstalledError": "armctl.core.errors",
    "OnlineMotion": "armctl.motion",
    "OperationalSpace": "armctl.control",
    "PD": "armctl.control",
    "PDGravity": "armctl.control",
    "PIDGravity": "armctl.control",
    "PayloadEstimate": "armctl.design.identification",
    "PlanError": "armctl.core.errors",
    "Plant": "armctl.sim.plant",
    "Pose": "armctl.core.pose",
    "Push": "armctl.sim.plant",
    "Report": "armctl.analysis.report",
    "Scene": "armctl.loading.scene",
    "SerialChain": "armctl.loading.chain",
    "Setpoint": "armctl.core.trajectory",
    "Simulation": "armctl.sim.simulation",
    "SimulationError": "armctl.core.log",
    "State": "armctl.control",
    "Team": "armctl.sim.multi_arm",
    "Trajectory": "armctl.core.trajectory",
    "UnknownNameError": "armctl.core.errors",
    "chains": "armctl.loading.load",
    "check_torque": "armctl.motion",
    "compare": "armctl.analysis.comparison",
    "excitation": "armctl.design.identification",
    "identify_payload": "armctl.design.identification",
    "load": "armctl.loading.load",
    "load_arms": "armctl.loading.load",
    "move_c": "armctl.motion",
    "move_j": "armctl.motion",
    "move_l": "armctl.motion",
    "move_path": "armctl.motion",
    "move_through": "armctl.motion",
    "simulate": "armctl.sim.simulation",
    "solve_ik": "armctl.ik",
    "solve_ik_batch": "armctl.ik",
}

if TYPE_CHECKING:
    from armctl.analysis.comparison import compare as compare
    from armctl.analysis.report import Report as Report
    from armctl.control import PD as PD
    from armctl.control import Adaptive as Adaptive
    from armctl.control import ComputedTorque as ComputedTorque
    from armctl.control import Controller as Controller
    from armctl.control import Impedance as Impedance
    from armctl.control import OperationalSpace as OperationalSpace
    from armctl.control import PDGravity as PDGravity
    from armctl.control import PIDGravity as PIDGravity
    from armctl.control import State as State
    from armctl.core.errors import ArmctlError as ArmctlError
    from armctl.core.errors import ArmctlWarning as ArmctlWarning
    from armctl.core.errors import InputError as InputError
    from armctl.core.errors import LimitError as LimitError
    from armctl.core.errors import ModelError as ModelError
    from armctl.core.errors import NotInstalledError as NotInstalledError
    from armctl.core.errors import PlanError as PlanError
    from armctl.core.errors import UnknownNameError as UnknownNameError
    from armctl.core.log import Log as Log
    from armctl.core.log import SimulationError as SimulationError
    from armctl.core.pose import Pose as Pose
    from armctl.core.result import MoveResult as MoveResult
    from armctl.core.trajectory import Limits as Limits
    from armctl.core.trajectory import Setpoint as Setpoint
    from armctl.core.trajectory import Trajectory as Trajectory
    from armctl.design.identification import PayloadEstimate as PayloadEstimate
    from armctl.design.identification import excitation as excitation
    from armctl.design.identification import identify_payload as identify_payload
    from armctl.ik import DifferentialIk as DifferentialIk
    from armctl.ik import IkBatch as IkBatch
    from armctl.ik import IkResult as IkResult
    from armctl.ik import solve_ik as solve_ik
    from armctl.ik import solve_ik_batch as solve_ik_batch
    from armctl.loading.chain import SerialChain as SerialChain
    from armctl.loading.load import chains as chains
    from armctl.loading.load import load as load
    from armctl.loading.load import load_arms as load_arms
    from armctl.loading.scene import Scene as Scene
    from armctl.motion import OnlineMotion as OnlineMotion
    from armctl.motion import check_torque as check_torque
    from armctl.motion import move_c as move_c
    from armctl.motion import move_j as move_j
    from armctl.motion import move_l as move_l
    from armctl.motion import move_path as move_path
    from armctl.motion import move_through as move_through
    from armctl.robot.arm import Arm as Arm
    from armctl.sim.gripper import Gripper as Gripper
    from armctl.sim.gripper import GripResult as GripResult
    from armctl.sim.multi_arm import Team as Team
    from armctl.sim.plant import Plant as Plant
    from armctl.sim.plant import Push as Push
    from armctl.sim.simulation import Simulation as Simulation
    from armctl.sim.simulation import simulate as simulate

__all__ = list(_MODULES)  # pyright: ignore[reportUnsupportedDunderAll]


def __getattr__(name: str) -> object:
    if name not in _MODULES:
        raise AttributeError(f"module 'armctl' has no attribute {name!r}")
    value = getattr(import_module(_MODULES[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *_MODULES})


def _open_viewer(arm: Any) -> Any:
    """The page behind `Simulation(viewer=True)`."""
    from armctl.viewer.viewer import Viewer

    return Viewer(arm)


hooks.open_viewer = _open_viewer

"""Controllers: one method `torque(state, setpoint)`."""

from collections.abc import Callable
from functools import partial

from armctl.control.admittance import Admittance
from armctl.control.computed_torque import ComputedTorque
from armctl.control.computed_torque_learning import ComputedTorqueLearning
from armctl.control.computed_torque_observer import ComputedTorqueObserver
from armctl.control.computed_torque_qp import ComputedTorqueQP
from armctl.control.elastic_feedback import ElasticFeedback
from armctl.control.elastic_feedforward import ElasticFeedforward
from armctl.control.hybrid_force import HybridForce
from armctl.control.impedance import Impedance
from armctl.control.interface import CompiledController, Controller, State, controller_name
from armctl.control.lqr import LQR, LQRGains
from armctl.control.mpc import MPC, MPCCounts
from armctl.control.operational_space import OperationalSpace
from armctl.control.pd import PD, PDFeedforward, PDGravity
from armctl.control.torque_filter import LowPass, Notch, TorqueFilter, TorqueRateLimit
from armctl.core.errors import UnknownNameError
from armctl.robot.arm import Arm

CONTROLLERS: dict[str, Callable[[Arm], Controller]] = {
    "pd": PD,
    "pd-feedforward": PDFeedforward,
    "pd-gravity": PDGravity,
    "computed-torque": ComputedTorque,
    "computed-torque-textbook": partial(ComputedTorque, form="textbook"),
    "computed-torque-observer": ComputedTorqueObserver,
    "computed-torque-learning": ComputedTorqueLearning,
    "qp": ComputedTorqueQP,
    "lqr": LQR,
    "mpc": MPC,
    "operational-space": OperationalSpace,
    "impedance": Impedance,
}


def controller_by_name(name: str, arm: Arm) -> Controller:
    """A controller with its default gains, by its name in `CONTROLLERS`."""
    if name not in CONTROLLERS:
        raise UnknownNameError.of("controller", name, CONTROLLERS)
    return CONTROLLERS[name](arm)


__all__ = [
    "CONTROLLERS",
    "LQR",
    "MPC",
    "PD",
    "Admittance",
    "CompiledController",
    "ComputedTorque",
    "ComputedTorqueLearning",
    "ComputedTorqueObserver",
    "ComputedTorqueQP",
    "Controller",
    "ElasticFeedback",
    "ElasticFeedforward",
    "HybridForce",
    "Impedance",
    "LQRGains",
    "LowPass",
    "MPCCounts",
    "Notch",
    "OperationalSpace",
    "PDFeedforward",
    "PDGravity",
    "State",
    "TorqueFilter",
    "TorqueRateLimit",
    "controller_by_name",
    "controller_name",
]

"""The laws of the compiled core: runs, memory, and what they refuse."""

import ctypes

import numpy as np
import pytest

import armctl
from armctl import _core
from armctl.control.interface import WRENCH_SIZE

pytestmark = pytest.mark.core

TICKS = 30
MADE = {
    "pd": armctl.PD,
    "pd of a bandwidth": lambda arm: armctl.PD(arm, bandwidth=20.0),
    "pd-feedforward": armctl.PDFeedforward,
    "pd-gravity": armctl.PDGravity,
    "computed torque": armctl.ComputedTorque,
    "textbook": lambda arm: armctl.ComputedTorque(arm, form="textbook"),
    "observer": armctl.ComputedTorqueObserver,
    "learning": armctl.ComputedTorqueLearning,
    "qp": lambda arm: armctl.ComputedTorqueQP(arm, bandwidth=60.0),
    "operational space": armctl.OperationalSpace,
    "impedance": lambda arm: armctl.Impedance(arm, error_max=0.05),
    "admittance": armctl.Admittance,
    "hybrid force": lambda arm: armctl.HybridForce(arm, {"z": -20.0}),
    "hybrid force of the tip": lambda arm: armctl.HybridForce(arm, {"x": 5.0, "y": 0.0}, frame="tip"),
    "limited rates": lambda arm: armctl.TorqueRateLimit(arm, armctl.ComputedTorqueObserver(arm), 100.0),
}


def ticks(arm: armctl.Arm, dt: float, continuous: bool):
    """States and setpoints that are near each other at first, and then far away."""
    rng = np.random.default_rng(5)
    q = arm.limits.random(arm.limits.clamp(arm.home), 1, rng)[0]
    for tick in range(TICKS):
        scale = 0.1 if tick < TICKS // 2 else 2.0
        q = q + 0.01 * scale * rng.normal(size=arm.n)
        wrench = 10.0 ** rng.uniform(-1, 2) * rng.normal(size=WRENCH_SIZE)
        state = armctl.State(q, scale * rng.normal(size=arm.n), tick * dt, dt, continuous, wrench)
        motion = scale * rng.normal(size=(4, arm.n))
        yield state, armctl.Setpoint(q + 0.05 * scale * rng.normal(size=arm.n), *motion)


def torque(law: _core.Law, state: armctl.State, setpoint: armctl.Setpoint) -> np.ndarray:
    tau = np.full(law.n, np.nan)
    law.torque(state.q, state.v, np.array([setpoint[k] for k in range(5)]), state.wrench, tau)
    return tau


@pytest.mark.parametrize("name", MADE)
def test_a_clone_begins_a_run_and_leaves_the_law_alone(bundled: armctl.Arm, name: str):
    law = MADE[name](bundled).make_law(0.002, False)
    run = list(ticks(bundled, 0.002, False))
    first = [torque(law, *tick) for tick in run]
    memory = law.memory.copy()
    clone = law.clone()
    assert not clone.memory.any()
    assert all((torque(clone, *tick) == tau).all() for tick, tau in zip(run, first, strict=True))
    assert (law.memory == memory).all()
    law.reset()
    assert all((torque(law, *tick) == tau).all() for tick, tau in zip(run, first, strict=True))


def test_memory_can_be_moved_to_a_law_with_other_gains(bundled: armctl.Arm):
    run = list(ticks(bundled, 0.002, False))
    controller = armctl.ComputedTorqueLearning(bundled)
    law = controller.make_law(0.002, False)
    other = controller.make_law(0.002, False)
    for tick in run[:10]:
        torque(law, *tick)
    other.memory[:] = law.memory
    assert (other.disturbance == law.disturbance).all()
    assert (other.estimate == law.estimate).all()
    assert all((torque(law, *tick) == torque(other, *tick)).all() for tick in run[10:])


@ctypes.CFUNCTYPE(None, *[ctypes.POINTER(ctypes.c_double)] * 7, ctypes.c_int64)
def spring_with_memory(parameters, q, v, reference, wrench, memory, tau, n):
    """A spring to the reference, a damper by its mean velocity, the force z on the tip, and a count of the ticks."""
    memory[0] += 1.0
    for i in range(n):
        tau[i] = parameters[0] * (reference[i] - q[i]) + parameters[1] * (reference[3 * n + i] - v[i]) + wrench[2] + memory[0]


def test_a_c_function_is_a_law(bundled: armctl.Arm):
    address = ctypes.cast(spring_with_memory, ctypes.c_void_p).value
    law = _core.CFunctionLaw(address, n=bundled.n, parameters=np.array([100.0, 3.0]), memory_size=1, needs_wrench=True)
    for count, (state, setpoint) in enumerate(ticks(bundled, 0.002, False), start=1):
        expected = 100.0 * (setpoint.q - state.q) + 3.0 * (setpoint.v_tick - state.v) + state.wrench[2] + count
        assert (torque(law, state, setpoint) == expected).all()
    assert law.memory == [TICKS]
    assert law.clone().memory == [0.0]


@pytest.mark.parametrize(
    ("make", "what"),
    [
        (lambda arm: _core.PD(stiffness=np.ones(3), damping=np.ones(2)), "damping: need 3 numbers, got 2"),
        (lambda arm: _core.PD(stiffness=-np.ones(3), damping=np.ones(3)), "stiffness: need a finite number of at least 0"),
        (lambda arm: _core.PDGravity(arm.core_model, stiffness=np.ones(2), damping=np.ones(2)), "stiffness: need 3 numbers"),
        (lambda arm: _core.CFunctionLaw(0, n=3, parameters=np.ones(1)), "address: need that of a function"),
        (
            lambda arm: _core.TorqueRateLimit(MADE["pd"](arm).make_law(0.0, False), tau_rate_max=np.ones(2), dt=0.002),
            "tau_rate",
        ),
    ],
)
def test_wrong_gains_are_refused(bundled: armctl.Arm, make, what: str):
    with pytest.raises(armctl.InputError, match=what):
        make(bundled)


def test_wrong_lengths_are_refused(bundled: armctl.Arm):
    law = armctl.Admittance(bundled).make_law(0.002, False)
    three = np.zeros(3)
    for arguments, name in [
        ((np.zeros(2), three, np.zeros((5, 3)), np.zeros(6), three), "q"),
        ((three, three, np.zeros((4, 3)), np.zeros(6), three), "reference"),
        ((three, three, np.zeros((5, 3)), np.zeros(0), three), "wrench"),
        ((three, three, np.zeros((5, 3)), np.zeros(6), np.zeros(4)), "tau"),
    ]:
        with pytest.raises(armctl.InputError, match=f"^{name}: "):
            law.torque(*arguments)


def test_a_controller_is_its_law_and_an_assigned_gain_keeps_the_memory(bundled: armctl.Arm):
    controller = armctl.ComputedTorque(bundled, bandwidth=10.0)
    law = controller.make_law(0.002, False)
    run = list(ticks(bundled, 0.002, False))
    assert all((controller.torque(*tick) == torque(law, *tick)).all() for tick in run[:10])
    controller.bandwidth = 15.0
    stiffer = controller.make_law(0.002, False)
    stiffer.memory[:] = law.memory
    assert all((controller.torque(*tick) == torque(stiffer, *tick)).all() for tick in run[10:20])
    assert (controller.memory == stiffer.memory).all()
    controller.damping_ratio = np.nan
    with pytest.raises(armctl.InputError, match="damping: need a finite number of at least 0, got nan"):
        controller.torque(*run[20])


def test_a_law_with_limited_rates_shows_the_estimates_of_its_controller(bundled: armctl.Arm):
    inner = armctl.ComputedTorqueObserver(bundled)
    limited = armctl.TorqueRateLimit(bundled, inner, 1e9)
    alone = armctl.ComputedTorqueObserver(bundled)
    for tick in ticks(bundled, 0.002, False):
        assert (limited.torque(*tick) == alone.torque(*tick)).all()
    assert inner.disturbance.any()
    assert (inner.disturbance == alone.disturbance).all()
    assert not limited.fresh().controller.disturbance.any()

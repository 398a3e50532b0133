"""The laws of the compiled core: runs, memory, and what they refuse."""

import ctypes
from collections.abc import Callable

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
        (lambda arm: _core.PD(stiffness=np.ones(3), damping=np.ones(2)), r"damping: need an array of shape \(3,\), got \(2,\)"),
        (lambda arm: _core.PD(stiffness=np.ones(3), dampin=np.ones(3)), "dampin: there is no such argument"),
        (lambda arm: _core.PD(stiffness=np.ones(3)), "damping: this argument is missing"),
        (
            lambda arm: _core.PDGravity(arm.core_model, stiffness=np.ones(2), damping=np.ones(2)),
            r"stiffness: need an array of shape \(3,\)",
        ),
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
    with pytest.raises(armctl.InputError, match="damping_ratio: "):
        controller.damping_ratio = np.nan
    assert controller.damping_ratio == 1.0
    assert (controller.torque(*run[20]) == torque(stiffer, *run[20])).all()


def own_law(make: Callable[[], object], n: object = 3) -> armctl.CompiledController:
    """A controller whose law is what a function gives."""

    class Own(armctl.CompiledController):
        def make_law(self, dt, continuous):
            return make()

    return Own(n)  # type: ignore[arg-type]


def c_law(**arguments: object) -> armctl.CFunctionLaw:
    address = ctypes.cast(spring_with_memory, ctypes.c_void_p).value
    return armctl.CFunctionLaw(**({"address": address, "n": 3, "parameters": [1.0, 2.0], "memory_size": 1} | arguments))


@pytest.mark.parametrize(
    ("make", "what"),
    [
        (lambda: c_law(memory_size=-1), r"memory_size: expected a number in \[0, 1e\+06\], got -1"),
        (lambda: c_law(memory_size=1.5), "memory_size: expected a whole number"),
        (lambda: c_law(memory_size=10**12), "memory_size: expected a number in"),
        (lambda: c_law(parameters=None), "parameters: None is not an array of numbers"),
        (lambda: c_law(parameters=[[1.0]]), "parameters: expected a list of numbers"),
        (lambda: c_law(n=10**12), "n: expected a number in"),
        (lambda: c_law(address=0), r"address: expected a number in \[1, "),
        (lambda: c_law(address="x"), "address: 'x' is not a number"),
        (lambda: c_law(needs_wrench=1), "needs_wrench: expected True or False, got 1"),
        (lambda: c_law(needs_wrench=True), "needs_wrench: the law of Own reads the wrench; set it to True in the class"),
        (lambda: c_law(n=4), "make_law: expected a law for 3 joints, got one for 4"),
        (lambda: "x", "make_law: expected a law, such as armctl.CFunctionLaw, got 'x'"),
    ],
)
def test_a_law_of_ones_own_that_does_not_fit_is_one_sentence(bundled: armctl.Arm, make, what: str):
    with pytest.raises(armctl.InputError, match=what):
        own_law(make).torque(*next(ticks(bundled, 0.002, False)))
    with pytest.raises(armctl.InputError, match=what):
        armctl.simulate(bundled, own_law(make), armctl.move_j(bundled, bundled.home, bundled.home))


@pytest.mark.parametrize("n", [0, -1, 1.5, None, 10**9])
def test_a_controller_has_at_least_one_joint(n):
    with pytest.raises(armctl.InputError, match=r"^n: "):
        own_law(c_law, n)


def test_a_law_that_gets_another_memory_begins_with_zeros(bundled: armctl.Arm):
    sizes = [2, 5]
    controller = own_law(lambda: c_law(memory_size=sizes[0]))
    run = list(ticks(bundled, 0.002, False))
    for tick in run[:3]:
        controller.torque(*tick)
    assert list(controller.memory) == [3.0, 0.0]
    del sizes[0]
    controller.anything = None
    controller.torque(*run[3])
    assert list(controller.memory) == [1.0, 0.0, 0.0, 0.0, 0.0]


HOSTILE_GAINS = [
    -1.0,
    np.nan,
    np.inf,
    1e308,
    "x",
    None,
    {},
    [1.0, -1.0, 1.0],
    np.zeros(9),
    np.zeros((3, 3)),
    1j,
    True,
    object(),
]
GAINS = {
    "PD": {"stiffness": "n", "damping": "n", "delay_margin": "one"},
    "PDFeedforward": {"stiffness": "n", "damping": "n"},
    "PDGravity": {"stiffness": "n", "damping": "n"},
    "ComputedTorque": {"bandwidth": "one", "damping_ratio": "one", "estimate_bandwidth": "optional", "form": "word"},
    "ComputedTorqueQP": {"bandwidth": "one", "damping_ratio": "one", "estimate_bandwidth": "optional"},
    "ComputedTorqueObserver": {"bandwidth": "optional", "damping_ratio": "optional", "observer_bandwidth": "optional"},
    "ComputedTorqueLearning": {"bandwidth": "optional", "damping_ratio": "optional", "observer_bandwidth": "optional"},
    "OperationalSpace": {"bandwidth": "one", "damping_ratio": "one", "posture_bandwidth": "one"},
    "Impedance": {"stiffness": "six", "error_max": "bound", "damping_ratio": "one", "posture_stiffness": "n"},
    "Admittance": {"mass": "six", "damping": "six", "stiffness": "six", "bandwidth": "one"},
    "HybridForce": {
        "frame": "word",
        "bandwidth": "one",
        "damping_ratio": "one",
        "approach_speed": "optional",
        "contact_force": "optional",
    },
    "TorqueRateLimit": {"tau_rate_max": "n", "controller": "controller"},
}
# Besides what is wrong for every gain: what a kind allows of it.
ALLOWED = {
    "n": (1e308,),
    "six": (1e308,),
    "bound": (1e308, np.inf),
    "optional": (None,),
}


def controller_of(name: str, arm: armctl.Arm) -> armctl.CompiledController:
    rest = {"HybridForce": ({"z": 1.0},), "TorqueRateLimit": (armctl.PD(arm), 100.0)}.get(name, ())
    return getattr(armctl, name)(arm, *rest)


@pytest.mark.parametrize("name", GAINS)
def test_an_assigned_gain_is_checked_like_one_that_is_given(bundled: armctl.Arm, name: str):
    controller = controller_of(name, bundled)
    public = {key for key in vars(controller) if not key.startswith("_")} - {"name"}
    assert public <= set(GAINS[name]) | {"form", "delay_margin"}, "a gain that is not tested"
    for gain, kind in GAINS[name].items():
        before = getattr(controller, gain)
        for value in HOSTILE_GAINS:
            allowed = ALLOWED.get(kind, ())
            if any(value is each for each in allowed) or (
                gain == "contact_force" and isinstance(value, float) and value == 1e308
            ):
                continue
            with pytest.raises(armctl.InputError, match=f"^{gain}: "):
                setattr(controller, gain, value)
            assert np.all(getattr(controller, gain) == before)


def test_one_number_is_assigned_to_all_joints_and_a_callers_array_stays_theirs(bundled: armctl.Arm):
    controller = armctl.PDGravity(bundled)
    controller.stiffness = 50.0
    mine = np.full(bundled.n, 5.0)
    controller.damping = mine
    mine[:] = -1.0
    other = armctl.PDGravity(bundled, stiffness=50.0, damping=5.0)
    assert (controller.stiffness == 50.0).all()
    for tick in ticks(bundled, 0.002, False):
        assert (controller.torque(*tick) == other.torque(*tick)).all()


def test_a_law_with_limited_rates_shows_the_estimates_of_its_controller(bundled: armctl.Arm):
    inner = armctl.ComputedTorqueObserver(bundled)
    limited = armctl.TorqueRateLimit(bundled, inner, 1e9)
    alone = armctl.ComputedTorqueObserver(bundled)
    for tick in ticks(bundled, 0.002, False):
        assert (limited.torque(*tick) == alone.torque(*tick)).all()
    assert inner.disturbance.any()
    assert (inner.disturbance == alone.disturbance).all()
    assert not limited.fresh().controller.disturbance.any()

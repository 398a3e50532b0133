"""The linear loop of an arm and any controller predicts its margins and its frequency response."""

import math
import re
from collections import deque
from dataclasses import replace

import mujoco
import numpy as np
import pytest
from arms import arm_of, some_of
from instability import grows
from synthetic import BENT, SHAPES, serial_arm

import armctl
from armctl.cli.describe import facts
from armctl.control import CONTROLLERS, controller_by_name
from armctl.control.gains import sample_configurations
from armctl.control.margin_exceptions import pd_peak_sensitivity
from armctl.control.observer_gains import PAYLOAD_LEVER_M, max_unknown_payload
from armctl.core.defaults import MAX_PEAK_SENSITIVITY
from armctl.lab.identification.frequency_response import averaged_response
from armctl.lab.loops.linearization import Linearizer

PLANT = armctl.Plant(timestep=0.004)


@pytest.fixture(scope="module")
def arm(tmp_path_factory):
    return serial_arm(tmp_path_factory.mktemp("planar"), BENT["planar"])


class Filtered(armctl.PD):
    """A PD whose velocity goes through a low-pass and whose torque is late: memory in a list, a deque and a float."""

    def __init__(self, arm):
        super().__init__(arm)
        self.past = {"v": np.zeros(arm.n)}
        self.late = deque([np.zeros(arm.n)] * 2)
        self.next_time = 0.0

    def torque(self, state, setpoint):
        if abs(state.t - self.next_time) > 0.5 * state.dt:
            self.past["v"] = np.zeros_like(state.v)
            self.late = deque([np.zeros_like(state.v)] * 2)
        self.next_time = state.t + state.dt
        self.past["v"] = 0.8 * self.past["v"] + 0.2 * state.v
        self.late.append(super().torque(state._replace(v=self.past["v"]), setpoint))
        return self.late.popleft()


class Averaging(Filtered):
    """It never resets its memory, and averages over the last twelve measurements in a ring."""

    def __init__(self, arm):
        super().__init__(arm)
        self.ring = np.tile(np.concatenate([arm.home, np.zeros(arm.n)]), (12, 1))
        self.row = 0

    def torque(self, state, setpoint):
        self.ring[self.row] = np.concatenate([state.q, state.v])
        self.row = (self.row + 1) % len(self.ring)
        q, v = np.split(self.ring.mean(axis=0), 2)
        return self.stiffness * (setpoint.q - q) - self.damping * v


@pytest.mark.parametrize("dt", [pytest.param(0.001, marks=pytest.mark.full), 0.004])
@pytest.mark.parametrize(
    "shape",
    some_of([SHAPES["tapering"], SHAPES["damped"], SHAPES["sliding"]], [SHAPES["sliding"]]),
    ids=["tapering", "damped", "sliding"],
)
def test_the_observer_tolerates_an_unknown_payload_by_default(shape, dt, tmp_path):
    arm = serial_arm(tmp_path, shape)
    mass = max_unknown_payload(arm)
    without, designed, twice = (
        armctl.margins(
            arm,
            "computed-torque-observer",
            2,
            [armctl.Plant(timestep=dt, payload=payload, payload_center=[0.0, 0.0, PAYLOAD_LEVER_M])],
        )
        for payload in (0.0, mass, 2 * mass)
    )
    for found in (without, designed):
        assert found.delay.value >= max(5e-3, 2.5 * dt)
    assert without.peak_sensitivity.value <= 1.7
    assert designed.peak_sensitivity.value <= 3.0  # 2 along the eigenvectors of the inertias, of which joints are sums
    assert twice.ok, twice.reason


@pytest.mark.parametrize("controller", CONTROLLERS)
def test_the_predicted_delay_margin_is_that_of_the_simulation_to_the_tick(arm, controller):
    loop = armctl.linearize(arm, controller, arm.home, PLANT)
    ticks = int(loop.margins().delay_margin / loop.dt)
    assert not grows(arm, controller, loop, ticks)
    assert grows(arm, controller, loop, ticks + 1)


@pytest.mark.parametrize("shape", ["six joints", "redundant"])
def test_the_delay_margin_is_exact_for_arms_of_many_joints(shape, tmp_path):
    arm = serial_arm(tmp_path, BENT[shape])
    loop = armctl.linearize(arm, "computed-torque-observer", arm.home, armctl.Plant(timestep=0.002))
    ticks = int(loop.margins().delay_margin / loop.dt)
    assert not grows(arm, "computed-torque-observer", loop, ticks)
    assert grows(arm, "computed-torque-observer", loop, ticks + 1)


@pytest.mark.parametrize("controller", CONTROLLERS)
def test_margins_agree_with_the_eigenvalues_of_the_closed_loop(arm, controller):
    rng = np.random.default_rng(1)
    for q in arm.limits.random(arm.home, 3, rng):
        for dt in (0.001, 0.002, 0.004):
            loop = armctl.linearize(arm, controller, q, armctl.Plant(timestep=dt))
            found = loop.margins()
            ticks = int(found.delay_margin / dt)
            assert loop.delayed(ticks).margins().ok
            assert not loop.delayed(ticks + 1).margins().ok
            for gain, outwards in ((found.lower_gain_margin, 1 / 1.001), (found.upper_gain_margin, 1.001)):
                for factor, is_stable in ((gain / outwards, True), (gain * outwards, False)) if gain else ((0.01, True),):
                    closed = loop.A - factor * loop.B @ loop.C
                    assert (np.abs(np.linalg.eigvals(closed)).max() < 1.0) == is_stable
            assert found.gain_margin in (found.lower_gain_margin, found.upper_gain_margin)


@pytest.mark.parametrize("controller", ["pd", "computed-torque", "computed-torque-observer"])
def test_the_measured_sensitivity_is_the_predicted_one(arm, controller):
    found = armctl.frequency_response(arm, controller, arm.home, 1, PLANT)
    assert found.ok, found.reason
    assert found.error.max() < 1e-4
    assert found.coherence.min() > 0.9999
    assert found.nonlinear.max() < 1e-3
    assert np.abs(found.predicted).max() > 1.0


@pytest.mark.parametrize("ratio", [1e-4, 0.03])  # friction as a share of the torque limit, below the excitation and far above
def test_dry_friction_is_a_nonlinear_share_that_coherence_does_not_show(arm, ratio):
    plant = armctl.Plant(timestep=0.004, coulomb_friction=ratio * arm.limits.tau_max)
    found = armctl.frequency_response(arm, "pd-gravity", arm.home, 1, plant)
    assert found.coherence.min() > 0.999
    assert found.error.max() > 0.1
    assert found.nonlinear.max() > 0.1
    assert not found.ok
    assert "nonlinear share" in found.reason


def test_noise_is_no_nonlinear_share(arm):
    noisy = armctl.Plant(timestep=0.004, encoder_noise=1e-5, seed=3)
    found = armctl.frequency_response(arm, "computed-torque", arm.home, 1, noisy)
    assert found.ok, found.reason
    assert 0.5 < found.coherence.min() < 0.9999
    assert found.nonlinear.max() < 0.1


def test_the_variance_of_a_response_is_that_of_repeated_measurements():
    rng = np.random.default_rng(4)
    lines = np.array([5, 9, 15])
    time = np.arange(64)
    signal = sum(np.cos(2 * np.pi * line * time / 64 + line) for line in lines)
    found = [averaged_response(signal + rng.normal(size=(4, 64)), signal, lines) for _ in range(3000)]
    scatter = np.var([each.response for each in found], axis=0)
    assert np.mean([each.variance for each in found], axis=0) == pytest.approx(scatter, rel=0.1)


@pytest.mark.nightly
@pytest.mark.parametrize("controller", ["pd", "computed-torque"])
def test_the_lag_of_a_differenced_velocity_is_predicted(arm, controller):
    plant = armctl.Plant(timestep=0.004, continuous=True)
    found = armctl.frequency_response(arm, controller, arm.home, 1, plant)
    assert found.ok, found.reason
    assert found.error.max() < 1e-3
    sensed = armctl.linearize(arm, controller, arm.home, armctl.Plant(timestep=0.004, continuous=True, velocity_noise=1e-9))
    of_true_velocity = sensed.sensitivity(found.frequency)[:, 1, 1]
    error = np.abs(found.measured / of_true_velocity - 1).max()
    assert error > 0.01 if controller == "pd" else error < 1e-3  # computed torque estimates the velocity itself


@pytest.mark.parametrize("continuous", [False, True])
def test_a_linear_arm_moves_like_the_simulated_one(arm, continuous):
    plant = armctl.Plant(timestep=0.004, continuous=continuous)
    linear = armctl.linear_arm(arm, arm.home, plant)
    tau = np.array([0.02, -0.01, 0.015])

    class Constant:
        def torque(self, state, setpoint):
            return linear.holding_torque + tau

    x = np.zeros(2 * arm.n)
    expected = []
    for _ in range(10):
        expected.append(x)
        x = linear.A @ x + linear.B @ tau
    standstill = armctl.move_j(arm, arm.home, arm.home)
    log = armctl.simulate(arm, Constant(), standstill, plant, dwell=0.04)
    measured = np.hstack([log.q - arm.home, log.v])[: len(expected)]
    assert np.abs(measured - np.array(expected)[: len(measured)]).max() < 1e-3 * np.abs(expected).max()


@pytest.mark.full
def test_a_search_finds_worse_margins_than_the_sampled_configurations(arm):
    law = armctl.PDGravity(arm)
    searched = armctl.margins(arm, law, 5, [PLANT])
    sampled = armctl.margins(arm, law, arm.limits.random(arm.home, 5, np.random.default_rng(3)), [PLANT])
    assert searched.delay.value < sampled.delay.value
    many = armctl.margins(arm, law, arm.limits.random(arm.home, 200, np.random.default_rng(4)), [PLANT])
    assert 0.0 < searched.delay.value < 1.02 * many.delay.value


@pytest.mark.parametrize("shape", ["planar", "six joints", "redundant"])
@pytest.mark.parametrize("controller", ["pd-gravity", "computed-torque", "computed-torque-observer"])
def test_default_gains_have_their_margins_at_configurations_that_nobody_designed_for(shape, controller, tmp_path):
    arm = serial_arm(tmp_path, BENT[shape])
    law = controller_by_name(controller, arm)
    linearizer = Linearizer(arm, armctl.Plant(timestep=0.001))
    found = [linearizer.loop_at(law, q).coarse_margins() for q in arm.limits.random(arm.home, 60, np.random.default_rng(99))]
    assert min(each.delay.min() for each in found) >= 5e-3
    if shape != "planar":  # gravity needs more stiffness of it than can be damped
        assert max(each.peak_sensitivity.max() for each in found) <= 1.7


@pytest.mark.parametrize("shape", [SHAPES["damped"], BENT["planar"]], ids=["damped", "planar"])
def test_the_sensitivity_that_info_declares_is_that_of_the_loops(shape, tmp_path):
    arm = serial_arm(tmp_path, replace(shape, joints=3))
    linearizer = Linearizer(arm, armctl.Plant(timestep=0.004))
    laws = armctl.PD(arm), armctl.PDGravity(arm)
    loops = [linearizer.loop_at(law, q).coarse_margins() for law in laws for q in sample_configurations(arm)]
    largest = max(each.peak_sensitivity.max() for each in loops)
    assert pd_peak_sensitivity(arm, 0.004) == pytest.approx(largest, rel=0.01)


@pytest.mark.parametrize("make", [armctl.PD, armctl.ComputedTorqueObserver])
def test_gains_for_a_larger_delay_margin_have_it(arm, make):
    worst = armctl.margins(arm, make(arm, delay_margin=0.012), 3, [armctl.Plant(timestep=0.001)])
    assert worst.delay.value >= 0.012


@pytest.mark.parametrize("make", [Filtered, Averaging])
def test_the_memory_of_any_controller_is_part_of_the_loop(arm, make):
    loop = armctl.linearize(arm, make(arm), arm.home, PLANT)
    assert len(loop.A) > 2 * arm.n
    measured = armctl.frequency_response(arm, make(arm), arm.home, 0, PLANT)
    assert measured.ok, measured.reason
    assert measured.error.max() < 1e-3
    assert measured.error.max() < 0.1 * error_without_memory(arm, measured)


def error_without_memory(arm, measured):
    """The error of a prediction that takes a filtering PD for a plain one."""
    plain = armctl.linearize(arm, "pd", arm.home, PLANT).sensitivity(measured.frequency)[:, 0, 0]
    return np.abs(measured.measured / plain - 1).max()


def test_a_controller_keeps_its_memory(arm):
    law = armctl.ComputedTorqueObserver(arm)
    z = np.zeros(arm.n)
    armctl.linearize(arm, law, arm.home, PLANT)
    fresh = armctl.ComputedTorqueObserver(arm)
    state = armctl.State(arm.home + 0.1, z, 0.0, 0.001)
    setpoint = armctl.Setpoint(arm.home, z, z, z, z)
    for k in range(3):
        later = state._replace(t=k * 0.001)
        assert np.array_equal(law.torque(later, setpoint), fresh.torque(later, setpoint))


def test_a_delay_in_seconds_is_that_of_the_plant_in_ticks(arm):
    late = armctl.linearize(arm, "computed-torque", arm.home, PLANT, delay=0.008)
    plant = armctl.linearize(arm, "computed-torque", arm.home, armctl.Plant(timestep=0.004, delay=2))
    none = armctl.linearize(arm, "computed-torque", arm.home, PLANT)
    assert late.delay == plant.delay == 2
    assert np.array_equal(late.A, plant.A)
    assert late.margins().delay_margin == pytest.approx(none.margins().delay_margin - 0.008, abs=1e-9)
    w = np.array([1.0, 30.0])
    assert np.allclose(late.transfer(w), none.transfer(w) * np.exp(-1j * w * 0.008)[:, None, None])


def test_the_compliance_at_low_frequency_is_that_of_the_springs(arm):
    law = armctl.PDGravity(arm, stiffness=300.0, damping=20.0)
    J = arm.jacobian(arm.home)[:3]
    static = np.linalg.norm(J @ J.T / 300.0, 2)
    assert armctl.linearize(arm, law, arm.home, PLANT).compliance([1e-3])[0] == pytest.approx(static, rel=1e-3)


def test_an_unstable_loop_has_no_margins(arm):
    loop = armctl.linearize(arm, armctl.PD(arm, damping=1e4, stiffness=0.0), arm.home, PLANT)
    found = loop.margins()
    assert not found
    assert "unstable" in found.reason
    assert found.delay_margin == 0.0
    assert found.peak_sensitivity == math.inf
    everywhere = armctl.margins(arm, armctl.PD(arm, damping=1e4, stiffness=0.0), configurations=2)
    assert not everywhere
    assert "unstable" in everywhere.reason


def test_the_worst_margins_name_their_configuration_and_plant(arm):
    plants = [PLANT, armctl.Plant(timestep=0.004, payload=1.0)]
    worst = armctl.margins(arm, "pd-gravity", 4, plants)
    assert worst.ok
    assert worst.loops == 8 + 4  # and the worst ones of two searches for each of two margins
    assert len(str(worst)) > 20
    for each, of in (
        (worst.delay, lambda m: m.delay_margin),
        (worst.gain, lambda m: m.gain_margin),
        (worst.phase, lambda m: m.phase_margin),
        (worst.peak_sensitivity, lambda m: m.peak_sensitivity),
    ):
        (plant,) = [p for p in plants if str(p) == each.plant]
        assert of(armctl.linearize(arm, "pd-gravity", each.q, plant).margins()) == each.value
    assert worst.lower_gain.value <= 1.0 <= worst.upper_gain.value
    given = armctl.margins(arm, "pd-gravity", [arm.home], [PLANT])
    assert given.delay.value >= worst.delay.value
    assert given.to_dict()["delay"]["value"] == given.delay.value


def test_python_control_computes_the_same_loop(arm):
    control = pytest.importorskip("control", reason="python-control is an extra")
    loop = armctl.linearize(arm, "computed-torque-observer", arm.home, PLANT, delay=0.004)
    w = np.array([1.0, 20.0, 300.0])
    response = control.frequency_response(loop.to_control(), w)
    answer = response.magnitude * np.exp(1j * response.phase)
    assert np.allclose(np.moveaxis(answer, 2, 0), loop.transfer(w))


def test_a_loop_is_drawn(arm, tmp_path):
    picture = armctl.linearize(arm, "pd", arm.home, PLANT).plot(tmp_path / "loop.svg")
    text = picture.read_text()
    assert "Nyquist" in text or text.count("<path") > 20


class Switching:
    def torque(self, state, setpoint):
        return 0.1 * np.sign(setpoint.q - state.q)


class Broken:
    def torque(self, state, setpoint):
        raise RuntimeError("no data")


def test_a_controller_without_a_linear_model_is_refused(arm):
    with pytest.raises(armctl.ModelError, match="no linear model"):
        armctl.linearize(arm, Switching(), arm.home)
    with pytest.raises(armctl.ModelError, match="no data"):
        armctl.linearize(arm, Broken(), arm.home)


@pytest.mark.parametrize(
    "call",
    [
        lambda arm: armctl.linearize(arm, "pd", arm.home[:-1]),
        lambda arm: armctl.linearize(arm, "pd", arm.home, delay=0.0001),
        lambda arm: armctl.linearize(arm, "pd", arm.home, delay=-1.0),
        lambda arm: armctl.linearize(arm, 3, arm.home),
        lambda arm: armctl.linearize(arm, "pd", arm.home).sensitivity([0.0]),
        lambda arm: armctl.linearize(arm, "pd", arm.home).delayed(-1),
        lambda arm: armctl.margins(arm, "pd", 0),
        lambda arm: armctl.margins(arm, "pd", plants=3),
        lambda arm: armctl.margins(arm, "pd", plants=["nominal"]),
        lambda arm: armctl.margins(arm, "pd", "many"),
        lambda arm: armctl.frequency_response(arm, "pd", arm.home, "elbow"),
        lambda arm: armctl.frequency_response(arm, "pd", arm.home, 3),
    ],
)
def test_a_wrong_call_is_an_input_error(arm, call):
    with pytest.raises(armctl.InputError):
        call(arm)


@pytest.mark.parametrize("dt", [0.001, 0.004])
@pytest.mark.parametrize("name", some_of(["planar", "rubbing", "six joints", "robot_arm_3dof"], ["planar", "six joints"]))
def test_an_arm_names_the_default_gains_whose_loops_are_too_sensitive(name: str, dt: float):
    arm = arm_of(name)
    exceptions = facts(arm)["margin_exceptions"]
    linearizer = Linearizer(arm, armctl.Plant(timestep=dt))
    for law in ("pd", "pd-gravity", "impedance"):
        controller = controller_by_name(law, arm)
        loops = [linearizer.loop_at(controller, q) for q in arm.limits.random(arm.home, 30, np.random.default_rng(3))]
        peak = max(loop.coarse_margins().peak_sensitivity.max() for loop in loops)
        named = [each["text"] for each in exceptions if law in each["controllers"]]
        periods = [re.findall(r"[\d.]+", sentence.partition(" ms (")[0]) for sentence in named]
        is_named = any(law == "impedance" or f"{1e3 * dt:g}" in row for row in periods)
        assert is_named == (peak > MAX_PEAK_SENSITIVITY)
        if is_named and law != "impedance":
            assert float(re.findall(r"\(Ms ([\d.]+)", named[0])[0]) == pytest.approx(peak, rel=0.2)


def pendulum(dt, gravity="0 0 -9.81"):
    """A mass of 2 kg at 0.4 m above a joint, which is upright at zero."""
    return armctl.load(
        mujoco.MjSpec.from_string(f"""
        <mujoco><option timestep="{dt}" gravity="{gravity}"/><worldbody><body>
          <joint name="swing" axis="0 1 0" range="-170 170"/>
          <inertial pos="0 0 0.4" mass="2" diaginertia="0.02 0.02 0.02"/><site name="tool" pos="0 0 0.5"/>
        </body></worldbody><actuator><motor joint="swing" ctrlrange="-50 50"/></actuator></mujoco>"""),
        tip="tool",
    )


@pytest.mark.parametrize("stiffness", [9.0, 12.0, 40.0])
def test_the_lower_gain_margin_of_a_pendulum_is_gravity_over_stiffness(stiffness):
    arm = pendulum(0.001)
    found = armctl.margins(arm, armctl.PD(arm, stiffness=stiffness, damping=2.0), [[0.0]])
    falls = 2.0 * 9.81 * 0.4 / stiffness
    assert found.ok
    assert found.lower_gain.value == pytest.approx(falls, rel=1e-4)
    assert found.gain.value == found.lower_gain.value
    assert f"{falls:.3g} (lower)" in str(found)


@pytest.mark.parametrize("bandwidth", [3.0, 0.1, 0.03, 0.007])
def test_the_phase_margin_of_a_slow_loop_is_that_of_its_formula(bandwidth):
    """The loop is (2 w0 s + w0^2) / s^2, which has the gain 1 at w0 (2 + 5^0.5)^0.5."""
    arm = pendulum(0.01, "0 0 0")
    loop = armctl.linearize(arm, armctl.ComputedTorque(arm, bandwidth=bandwidth, form="textbook"), [0.3])
    found = loop.margins()
    x = np.geomspace(0.1, 100.0, 20_000)
    crossing = math.sqrt(2 + math.sqrt(5))
    delay = 0.5 * 0.01 * bandwidth  # of a torque that is held through a semi-implicit step
    assert found.phase_margin == pytest.approx(math.atan(2 * crossing) - delay * crossing, rel=2e-2)
    assert found.delay_margin * bandwidth == pytest.approx(math.atan(2 * crossing) / crossing, abs=2 * delay)
    L = (1 + 2j * x) / -(x**2) * np.exp(-1j * delay * x)
    assert found.peak_sensitivity == pytest.approx(np.abs(1 / (1 + L)).max(), rel=5e-3)
    assert found.peak_sensitivity > 1.0


@pytest.mark.parametrize(
    ("shape", "damping"),
    [
        ("planar", 30.0),
        pytest.param("planar", 200.0, marks=pytest.mark.full),
        pytest.param("six joints", 30.0, marks=pytest.mark.full),
    ],
)
def test_default_pd_of_a_damped_arm_has_the_margins_and_twice_its_stiffness_has_not(shape, damping, tmp_path):
    arm = serial_arm(tmp_path, replace(BENT[shape], joint=f'damping="{damping}"'))
    fresh = arm.limits.random(arm.home, 25, np.random.default_rng(77))
    for make in (armctl.PD, armctl.PDGravity):
        law = make(arm)
        found = armctl.margins(arm, law, fresh)
        assert found.delay.value >= 5e-3
        assert found.peak_sensitivity.value <= MAX_PEAK_SENSITIVITY
        twice = armctl.margins(arm, make(arm, stiffness=2 * law.stiffness, damping=law.damping), fresh)
        assert twice.delay.value < 5e-3 or twice.peak_sensitivity.value > MAX_PEAK_SENSITIVITY


LATE_PLANTS = [
    {"sensor_delay": 3},
    {"delay": 2, "sensor_delay": 1},
    {"sensor_delay": 2, "jitter": 2},
    {"sensor_delay": 4, "encoder_bits": 14},
    {"delay": 1, "jitter": 1, "encoder_noise": 1e-5},
]


def delayed_by_states(arm, law, options):
    """The poles and the loop transfer function with every delay as states: a line of past measurements, one of torques."""
    undelayed = {name: value for name, value in options.items() if name not in ("delay", "sensor_delay", "jitter")}
    loop = armctl.linearize(arm, law, arm.home, armctl.Plant(timestep=0.004, **undelayed))
    A, B, C = loop.A, loop.B, loop.C
    n = arm.n
    jitter = options.get("jitter", 0)
    mean = {0: [1.0], 1: [0.5, 0.5], 2: [1 / 3, 4 / 9, 2 / 9]}[jitter]  # a late command is not followed by an older one
    taps = np.concatenate([np.zeros(options.get("delay", 0) + options.get("sensor_delay", 0)), mean])
    line = (len(taps) - 1) * n
    closed = np.zeros((len(A) + line, len(A) + line))
    closed[: len(A), : len(A)] = A - taps[0] * B @ C
    closed[: len(A), len(A) :] = -np.hstack([tap * B for tap in taps[1:]])
    closed[len(A) : len(A) + n, : len(A)] = C
    closed[len(A) + n :, len(A) : -n] = np.eye(line - n)

    def transfer(w):
        z = np.exp(1j * w * loop.dt)
        return sum(tap * z**-k for k, tap in enumerate(taps)) * (C @ np.linalg.solve(z * np.eye(len(A)) - A, B))

    return np.linalg.eigvals(closed), transfer


@pytest.mark.parametrize("law", ["pd-gravity", "computed-torque"])
@pytest.mark.parametrize("options", LATE_PLANTS, ids=str)
def test_delays_have_the_poles_and_responses_of_lines_of_past_torques(arm, options, law):
    loop = armctl.linearize(arm, law, arm.home, armctl.Plant(timestep=0.004, **options))
    poles, transfer = delayed_by_states(arm, law, options)
    assert loop.margins().spectral_radius == pytest.approx(np.abs(poles).max(), rel=1e-9)
    for w, found in zip((1.0, 30.0, 300.0), loop.transfer([1.0, 30.0, 300.0]), strict=True):
        assert np.allclose(found, transfer(w), rtol=1e-9, atol=1e-12 * np.abs(found).max())


@pytest.mark.parametrize("options", LATE_PLANTS, ids=str)
def test_a_delay_of_sensors_is_one_state_per_joint_and_tick(arm, options):
    loop = armctl.linearize(arm, "pd-gravity", arm.home, armctl.Plant(timestep=0.004, **options))
    ticks = sum(options.get(name, 0) for name in ("delay", "sensor_delay", "jitter"))
    assert len(loop.A) == (2 + ("encoder_bits" in options) + ticks) * arm.n


@pytest.mark.parametrize(
    "options", [each for each in LATE_PLANTS if "encoder" in str(each)] + [{"delay": 1, "encoder_bits": 14}]
)
def test_torque_noise_of_a_delayed_loop_is_the_integral_of_its_spectrum(arm, options):
    loop = armctl.linearize(arm, "pd-gravity", arm.home, armctl.Plant(timestep=0.004, **options))
    angle = (np.arange(20000) + 0.5) * np.pi / 20000
    sigma = options.get("encoder_noise", 2 * np.pi / 2**14 / math.sqrt(12))
    position, velocity = np.hsplit(loop._law.D, 2)  # the law has no memory
    gain = position + velocity * ((1 - np.exp(-1j * angle)) / loop.dt)[:, None, None]
    torque = loop.sensitivity(angle / loop.dt) @ (sigma * gain)
    power = (np.abs(torque) ** 2).sum(axis=2) * (1.5 - 2 * np.cos(angle) + 0.5 * np.cos(2 * angle))[:, None]
    assert loop.chatter() == pytest.approx(np.sqrt(power.mean(axis=0)), rel=1e-6)

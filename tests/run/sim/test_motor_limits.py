"""The motors of every simulation obey the limits of the arm that it is given, and the log has their torque."""

from dataclasses import replace

import numpy as np
import pytest
from arms import arm_of
from motions import Still
from synthetic import limb, motors

import armctl
from armctl.cli.describe import describe, facts

INERTIA = 0.5  # kg m^2
OWN = 20.0  # N m, of the motor in the file
TURNTABLE = (
    f'<body><joint name="a" axis="0 0 1"/><inertial pos="0 0 0" mass="1" diaginertia="1 1 {INERTIA}"/>'
    '<geom size="0.1" contype="0" conaffinity="0"/><site name="tip" pos="0.3 0 0"/></body>'
)
PLANTS = {
    "nominal": armctl.Plant(),
    "late commands": armctl.Plant(delay=2),
    "jitter": armctl.Plant(jitter=3),
    "continuous": armctl.Plant(continuous=True),
    "windings": armctl.Plant(motor=0.001),
    "bristles": armctl.Plant(friction="lugre"),
}


def limited(arm: armctl.Arm, tau_max: float) -> armctl.Arm:
    return arm.with_limits(replace(arm.limits, tau_max=np.full(arm.n, tau_max)))


class Full:
    """Commands a thousand times what any motor here gives."""

    def torque(self, state: armctl.State, setpoint: armctl.Setpoint) -> np.ndarray:
        return np.full(len(state.q), 1e4)


@pytest.mark.parametrize("plant", PLANTS.values(), ids=PLANTS)
@pytest.mark.parametrize("tau_max", [0.7, 13.0, OWN, 35.0, np.inf])
@pytest.mark.parametrize("gear", [1.0, -4.0])
def test_a_turntable_accelerates_with_the_smaller_of_its_limit_and_its_motor(load, tau_max, plant, gear):
    motor = f'<motor name="m_a" joint="a" gear="{gear}" ctrlrange="-{OWN / abs(gear)} {OWN / abs(gear)}"/>'
    arm = limited(load(TURNTABLE, f'<option timestep="0.001"/><actuator>{motor}</actuator>'), tau_max)
    seconds = 0.1
    log = armctl.simulate(arm, Full(), Still(arm.home, seconds), plant, dwell=0.0)
    torque = min(tau_max, OWN)
    full = log.tau[-10:] / torque
    assert full == pytest.approx(np.ones_like(full), rel=1e-9)
    assert log.tau_max == pytest.approx([torque], rel=1e-12)
    gained = (log.v[-1, 0] - log.v[50, 0]) / (log.t[-1] - log.t[50])
    assert gained == pytest.approx(torque / INERTIA, rel=1e-6)


def test_all_ways_to_simulate_a_weakened_arm_clip_its_torques(load):
    arm = limited(load(limb("a b c"), motors("a b c")), 1.5)
    start = arm.home
    motion = armctl.move_j(limited(arm, np.inf), start, arm.limits.clamp(start + 0.6))
    simulation = armctl.Simulation(arm)
    simulation.run(motion)
    logs = {
        "simulate": armctl.simulate(arm, "computed-torque", motion),
        "simulate_many": armctl.simulate_many(arm, ["pd", "computed-torque"], motion, threads=2)[1],
        "Simulation": simulation.log,
        "in Python": armctl.simulate(arm, Full(), motion),
        "study": armctl.simulate(arm, "computed-torque", motion, armctl.Plant(mass_scale=1.3)),
    }
    for name, log in logs.items():
        assert np.abs(log.tau).max() == pytest.approx(1.5, rel=1e-9), name
        report = armctl.Report.from_log(log)
        assert report.peak_torque_ratio == pytest.approx(1.0, rel=1e-9), name
        is_clipped = (np.abs(log.tau_cmd) > 1.5 * (1 + 1e-9)).any(axis=1)
        assert report.saturated_fraction == is_clipped.mean(), name
        assert is_clipped.any(), name
        clipped = np.clip(log.tau_cmd, -1.5, 1.5)
        assert log.tau == pytest.approx(clipped, abs=1e-12), name
    model = armctl.Plant().model(arm)
    assert np.abs(model.actuator_forcerange[:3]).max() == 1.5


def test_two_arms_of_one_model_keep_their_own_limits():
    """A simulation of one arm does not change another one of the same model, in any order."""
    arm = arm_of("planar")
    motion = Still(arm.home, 0.02)
    peaks = []
    for share in (0.2, 1.0, 3.0, 0.2):
        weak = arm.with_limits(replace(arm.limits, tau_max=share * arm.limits.tau_max))
        log = armctl.simulate(weak, Full(), motion, dwell=0.0)
        peaks.append(np.abs(log.tau).max(axis=0) / arm.limits.tau_max)
    assert np.array(peaks) == pytest.approx(np.outer([0.2, 1.0, 1.0, 0.2], np.ones(arm.n)), rel=1e-9)


def test_environments_obey_the_limits_of_a_weakened_arm(load):
    arm = load(TURNTABLE, motors("a") + '<option timestep="0.001"/>')
    weak = limited(arm, 2.5)
    pytest.importorskip("gymnasium", reason="pip install -e '.[envs]'")
    from armctl.envs import ArmVectorEnv

    env = ArmVectorEnv(weak, "Track", "joint_delta", 2, ticks=20, contacts=False, randomize={"delay": armctl.Range(0, 2)})
    env.reset(seed=1)
    speeds = []
    for _ in range(4):
        env.step(np.ones((2, 1), np.float32))
        speeds.append([env.batch.rows.simulated.data(row).qvel[0] for row in range(2)])
    gained = np.abs(np.diff(speeds, axis=0)).max()
    assert gained <= 2.5 / INERTIA * 0.02 * (1 + 1e-9)


def test_the_description_of_an_arm_says_which_motors_are_weaker_than_its_limits(load):
    arm = load(limb("a b"), motors("a b"))
    strong = arm.with_limits(replace(arm.limits, tau_max=np.array([10.0, 50.0])))
    assert "note: the motor of b gives 20 N m in simulations, less than its tau_max" in describe(strong, facts(strong))
    assert "gives 20 N m" not in describe(arm, facts(arm))
    assert strong.motor_torque_limits == pytest.approx([10.0, 20.0])
    slightly = arm.with_limits(replace(arm.limits, tau_max=np.array([10.0, 20.1])))
    assert slightly.motor_torque_limits == pytest.approx([10.0, 20.0])

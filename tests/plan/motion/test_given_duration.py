"""Motions of a given duration: exact, on the same path, inside the limits, and never shorter than possible."""

from collections.abc import Callable

import numpy as np
import pytest
from arms import arm_of
from motion_check import violation

import armctl

Plan = Callable[..., armctl.JointTrajectory]


@pytest.fixture(scope="module")
def arm() -> armctl.Arm:
    return arm_of("robot_arm_3dof")


def rising(arm: armctl.Arm) -> np.ndarray:
    return arm.fk(arm.home).position + np.array([0.0, 0.05, 0.02])


def arc(arm: armctl.Arm) -> tuple[np.ndarray, np.ndarray]:
    start = arm.fk(arm.home).position
    return start + np.array([0.0, 0.03, 0.03]), start + np.array([0.0, 0.06, 0.0])


PLANS: dict[str, Callable[[armctl.Arm], Plan]] = {
    "move_j": lambda arm: lambda **more: armctl.move_j(arm, arm.home, arm.home + 0.4, **more),
    "move_j, each joint": lambda arm: (
        lambda **more: armctl.move_j(arm, arm.home, arm.home + np.array([0.4, 0.1, 0.0]), straight=False, **more)
    ),
    "move_through": lambda arm: (
        lambda **more: armctl.move_through(arm, [arm.home, armctl.Via(arm.home + 0.3, dwell=0.2), arm.home - 0.2], **more)
    ),
    "move_l": lambda arm: lambda **more: armctl.move_l(arm, arm.home, rising(arm), **more),
    "move_c": lambda arm: lambda **more: armctl.move_c(arm, arm.home, *arc(arm), **more),
    "move_path": lambda arm: lambda **more: armctl.move_path(arm, arm.home, [rising(arm), arc(arm)[0]], blend=0.01, **more),
    "move_sequence": lambda arm: (
        lambda **more: armctl.move_sequence(
            arm, [armctl.move_j(arm, arm.home, arm.home + 0.2), armctl.move_j(arm, arm.home + 0.2, arm.home)], **more
        )
    ),
    "move_free": lambda arm: lambda **more: armctl.move_free(arm, arm.home, arm.home + 0.3, **more),
    "time_path": lambda arm: (
        lambda **more: armctl.time_path(arm, arm.home + np.linspace(0, 0.4, 9)[:, None] ** [1, 2, 3], **more)
    ),
}


@pytest.mark.parametrize("name", PLANS)
def test_a_move_takes_exactly_the_duration_on_the_same_path_or_says_the_shortest(arm, name):
    plan = PLANS[name](arm)
    fastest = plan()
    for factor in (1.0, 1.3, 4.0):
        motion = plan(duration=factor * fastest.duration)
        assert motion.duration == pytest.approx(factor * fastest.duration, rel=1e-12)
        times = np.linspace(0.0, fastest.duration, 50)
        assert np.allclose(motion.sample(np.minimum(factor * times, motion.duration)).q, fastest.sample(times).q, atol=1e-9)
        assert not violation(motion, arm.limits)
        assert armctl.check_torque(arm, motion).ok
    with pytest.raises(
        armctl.PlanError, match=rf"duration: .* is too short, the motion takes at least {fastest.duration:.6g} s"
    ):
        plan(duration=0.99 * fastest.duration)
    for wrong in (0.0, -1.0, np.nan, "long"):
        with pytest.raises(armctl.InputError, match="duration: "):
            plan(duration=wrong)


@pytest.mark.parametrize("name", ["move_l", "move_free"])
@pytest.mark.parametrize("factor", [1.0, 1.05, 1.4, 3.0])
def test_a_move_from_a_moving_start_takes_exactly_the_duration(arm, name, factor):
    under_way = armctl.move_j(arm, arm.home - 0.2, arm.home + 0.2)
    now = under_way(0.5 * under_way.duration)
    plans = {
        "move_l": lambda **more: armctl.move_l(arm, now, rising(arm), **more),
        "move_free": lambda **more: armctl.move_free(arm, now, arm.home + 0.5, **more),
    }
    fastest = plans[name]()
    motion = plans[name](duration=factor * fastest.duration)
    assert motion.duration == pytest.approx(factor * fastest.duration, rel=1e-9)
    for value, wanted in zip(motion(0.0)[:3], now[:3], strict=True):
        assert np.allclose(value, wanted, atol=1e-9)
    assert np.allclose(motion(motion.duration).q, fastest(fastest.duration).q, atol=1e-9)
    assert np.abs(motion(motion.duration).v).max() < 1e-9
    assert not violation(motion, arm.limits)
    with pytest.raises(armctl.PlanError, match=r"duration: .* is too short"):
        plans[name](duration=0.98 * fastest.duration)


def test_a_goal_in_motion_is_met_at_a_given_time(arm):
    """A belt: at the time T it is at start + T v, and the arm has its position and velocity then."""
    v = np.array([0.3, 0.0, -0.2])
    for duration in (0.8, 1.0, 1.7):
        goal = armctl.Setpoint(arm.home + [-0.5, 0.2, 0.3] + duration * v, v, np.zeros(3))
        motion = armctl.move_j(arm, arm.home, goal, straight=False, duration=duration)
        assert motion.duration == pytest.approx(duration, rel=1e-9)
        assert np.allclose(motion(duration).q, goal.q, atol=1e-9)
        assert np.allclose(motion(duration).v, v, atol=1e-9)
        assert not violation(motion, arm.limits)


def test_a_duration_that_no_motion_between_moving_states_has_names_the_next_one(arm):
    """Faster than it must stop for: from 0.8 of the speed, a way of little more than the stop takes either 1 or 2 times."""
    v = 0.8 * arm.limits.v_max * [1.0, 0.0, 0.0]
    start = armctl.Setpoint(arm.home, v, np.zeros(3))
    stop = armctl.OnlineMotion(arm, start)
    stop.step(stop.time_left)
    goal = armctl.Setpoint(0.5 * (arm.home + stop.setpoint.q), v, np.zeros(3))
    fastest = armctl.move_j(arm, start, goal, straight=False)
    with pytest.raises(armctl.PlanError, match=r"the next longer one takes .* s; give this time, or leave it out") as info:
        armctl.move_j(arm, start, goal, straight=False, duration=3 * fastest.duration)
    longer = float(str(info.value).split("one takes ")[1].split()[0])
    assert longer > 3 * fastest.duration
    motion = armctl.move_j(arm, start, goal, straight=False, duration=longer + 1e-4)
    assert motion.duration == pytest.approx(longer + 1e-4)


def test_a_motion_that_goes_nowhere_lasts_as_long_as_it_should(arm):
    motion = armctl.move_j(arm, arm.home, arm.home, duration=2.0)
    assert motion.duration == 2.0
    assert np.array_equal(motion(1.0).q, arm.home)


def test_a_longer_motion_needs_no_more_torque_than_the_fastest_one_or_than_to_hold(arm):
    """The torque of a slower motion is between that of the faster one and that of holding still."""
    down = arm.home - np.array([0.0, 0.3, 0.0])
    fastest = armctl.move_j(arm, arm.home, down)
    ratio = armctl.check_torque(arm, fastest).ratio
    held = max(np.abs(arm.gravity(q) / arm.limits.tau_max).max() for q in (arm.home, down))
    assert ratio != held
    for duration in (1.1 * fastest.duration, 10.0):
        assert (
            armctl.check_torque(arm, armctl.move_j(arm, arm.home, down, duration=duration)).ratio <= max(ratio, held) * 1.0001
        )


def test_a_simulation_moves_in_the_given_time_and_refuses_a_shorter_one():
    sim = armctl.Simulation("robot_arm_3dof")
    result = sim.move_j(sim.arm.home + 0.3, duration=2.0)
    assert result.ok
    assert result.log.motion_duration == pytest.approx(2.0, abs=sim.dt)
    up = np.array([0.0, 0.0, 0.03])
    for move in (
        lambda: sim.move_j(sim.arm.home, duration=0.01),
        lambda: sim.move_to(sim.arm.fk(sim.arm.home), duration=0.01),
        lambda: sim.move_l(sim.tip.position + up, duration=0.01),
    ):
        refused = move()
        assert not refused.ok
        assert "duration: 0.01 s is too short, the motion takes at least" in refused.reason
    assert sim.move_l(sim.tip.position + up, duration=1.5).log.motion_duration == pytest.approx(1.5, abs=sim.dt)

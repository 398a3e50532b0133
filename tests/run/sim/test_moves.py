"""What an arm in a simulation can be told: lines, arcs, paths, and to follow."""

from pathlib import Path

import numpy as np
import pytest
from synthetic import BENT, serial_arm

import armctl
from armctl.plan.motion.move_cartesian import Arc, Line


@pytest.fixture(scope="module")
def seven_joints(tmp_path_factory: pytest.TempPathFactory) -> armctl.Arm:
    return serial_arm(Path(tmp_path_factory.mktemp("seven")), BENT["redundant"])


@pytest.fixture
def sim(seven_joints: armctl.Arm) -> armctl.Simulation:
    return armctl.Simulation(seven_joints)


class LooseLastJoint:
    """Computed torque, but a weak spring at the last joint, which still swings when the others rest."""

    def __init__(self, arm: armctl.Arm):
        self._exact = armctl.ComputedTorque(arm)
        self._inertia = float(arm.mass_matrix(arm.home)[-1, -1])

    def torque(self, state, setpoint):
        tau = self._exact.torque(state, setpoint)
        error = setpoint.q[-1] - state.q[-1]
        tau[-1] = self._inertia * (30.0**2 * error - 2.0 * 0.2 * 30.0 * state.v[-1])
        return tau


def moved(sim: armctl.Simulation, *way: float) -> armctl.Pose:
    return armctl.Pose(sim.tip.position + way, quat=sim.tip.quat)


def test_move_j_brings_the_joints_to_a_position(sim):
    goal = sim.arm.home + 0.2
    assert sim.move_j(goal)
    assert np.allclose(sim.state.q, goal, atol=1e-4)
    with pytest.raises(armctl.LimitError, match="q: j3"):
        sim.move_j([0.0, 0.5, 0.5, 2.1, 0.5, 0.0, 0.0])


def test_move_l_keeps_the_simulated_tip_on_its_line(sim):
    start, target = sim.tip.position, moved(sim, 0.0, 0.2, -0.1)
    result = sim.move_l(target)
    assert result, str(result)
    way = (target.position - start) / np.linalg.norm(target.position - start)
    away = sim.log.tip[:, :3] - start
    assert np.abs(away - (away @ way)[:, None] * way).max() < 5e-5


def test_a_line_that_cannot_be_is_refused_before_anything_moves(sim):
    before = sim.state
    result = sim.move_l(moved(sim, 0.8, 0.0, 0.0))
    assert not result
    assert "of the path, tip at" in result.reason
    assert np.array_equal(sim.state.q, before.q)


def test_arcs_circles_and_paths_end_where_they_should(sim):
    start = sim.tip
    assert sim.move_c(moved(sim, 0.0, 0.05, 0.05), moved(sim, 0.0, 0.1, 0.0))
    assert sim.move_c(moved(sim, 0.0, -0.05, 0.05), moved(sim, 0.0, -0.1, 0.0), angle=2 * np.pi)
    assert sim.tip.distance(start)[0] == pytest.approx(0.1, abs=1e-3)
    square = [
        moved(sim, 0.0, 0.0, -0.1),
        Line(moved(sim, 0.0, -0.1, -0.1)),
        Arc(moved(sim, 0, -0.12, -0.05), moved(sim, 0, -0.1, 0)),
    ]
    assert sim.move_path([*square, start], blend=0.01, tip_speed=0.3)
    assert sim.tip.distance(start)[0] < 1e-3
    with pytest.raises(armctl.InputError, match="it is empty"):
        sim.move_path([])


def test_it_follows_a_point_that_moves(sim):
    start = sim.tip.position

    def circling(t: float) -> np.ndarray:
        return start + 0.05 * np.array([0.0, np.sin(2 * t), 1 - np.cos(2 * t)])

    log = sim.follow(circling, duration=3.0)
    wanted = np.array([circling(t) for t in log.t])
    off = np.linalg.norm(log.tip[:, :3] - wanted, axis=1)
    assert off[500:].max() < 3e-4
    assert (np.abs(np.diff(log.q_ref, axis=0)) <= 1.001 * sim.dt * sim.arm.limits.v_max).all()
    assert np.abs(log.q - log.q_ref).max() < 1e-3


def test_a_stream_moves_the_arm_tick_by_tick_and_leaves_a_log(sim):
    begin = sim.data.time
    home = sim.state.q
    frame = 1 / 30  # no whole number of ticks
    with sim.streaming() as run:
        for k in range(60):
            times = run.stream.t + frame * np.arange(1, 9)
            run.stream.push_chunk(times, home + 0.1 * np.sin(2.0 * times)[:, None])
            assert run.advance(frame) == ""
            assert run.stream.t == pytest.approx((k + 1) * frame, abs=0.51 * sim.dt)
        with pytest.raises(armctl.InputError, match="duration: "):
            run.advance(-1.0)
    log = sim.log
    assert sim.data.time - begin == pytest.approx(2.0, abs=sim.dt)
    assert log.motion_duration == pytest.approx(2.0, abs=sim.dt)
    wanted = home + 0.1 * np.sin(2.0 * log.t)[:, None]
    assert np.abs(log.q - wanted)[500:].max() < 5e-3  # a frame late it would be 6.7e-3
    assert run.stream.report.refused == 0
    with pytest.raises(armctl.InputError, match="advance: nothing runs yet; use `with sim"):
        run.advance(frame)
    with sim.streaming() as run:
        run.stream.push(0.0, home)
        run.advance(2.0)
    assert sim.state.q == pytest.approx(home, abs=1e-4)


def test_it_follows_the_target_wherever_it_is_put(sim):
    body = sim.model.body("target").mocapid[0]
    sim.data.mocap_pos[body] = sim.tip.position + np.array([0.05, 0.1, -0.1])
    sim.follow("target", duration=2.0)
    assert np.linalg.norm(sim.tip.position - sim.target) < 1e-4
    with pytest.raises(armctl.UnknownNameError, match="unknown body 'tarket'; did you mean 'target'"):
        sim.follow("tarket")


def test_a_move_ends_only_when_all_joints_rest(seven_joints):
    sim = armctl.Simulation(seven_joints, LooseLastJoint(seven_joints))
    sim.reset(v=[0.0] * 6 + [1.0])
    target = seven_joints.fk(seven_joints.home + 0.1).position  # the last joint turns about the tip, which it does not move
    result = sim.move_to(target)
    assert result, str(result)
    moving = np.abs(result.log.v) > 1e-3
    last = [int(np.flatnonzero(joint)[-1]) for joint in moving.T]
    assert last[-1] > max(last[:-1]) + 100
    assert np.abs(sim.state.v).max() < 1e-3


def test_the_reason_of_a_failed_move_names_an_unstable_loop(bundled):
    result = armctl.Simulation(bundled, armctl.ComputedTorque(bundled, bandwidth=1000.0)).move_to([0.3, 0.2, 0.3])
    assert not result
    assert result.reason.endswith("the loop of computed-torque is unstable at its period of 2 ms: lower its gains")


def test_the_reason_of_a_failed_move_with_a_stable_loop_says_nothing_of_it(bundled):
    result = armctl.Simulation(bundled, armctl.PD(bundled, stiffness=100.0, damping=20.0)).move_to([0.3, 0.2, 0.3])
    assert not result
    assert "unstable" not in result.reason

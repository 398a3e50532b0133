"""Streams: whatever arrives, the setpoints keep all limits; what moves smoothly is followed without lag."""

import mujoco
import numpy as np
import pytest
from arms import arm_of, some_of
from hypothesis import given, settings
from hypothesis import strategies as st

import armctl
from armctl.core.trajectory import Setpoint
from armctl.plan.motion.trajectory.piecewise import sample
from armctl.plan.stream.timed_targets import TimedTargets

DT = 2e-3
RATE = 30.0


@pytest.fixture(scope="module")
def arm() -> armctl.Arm:
    return arm_of("robot_arm_3dof")


def assert_inside(arm: armctl.Arm, points: list[Setpoint]) -> None:
    """Limits by differences of the setpoints themselves, and torques by MuJoCo."""
    q, v, a = (np.array(x) for x in zip(*(point[:3] for point in points), strict=True))
    limits = arm.limits
    assert limits.contains(q, 1e-9)
    assert (np.abs(v) <= limits.v_max * (1 + 1e-6)).all()
    assert (np.abs(a) <= limits.a_max * (1 + 1e-6)).all()
    assert (np.abs(np.diff(a, axis=0)) <= (1 + 1e-6) * DT * limits.j_max).all()
    # Position and velocity belong together: a jerk below its limit leaves no more than this between them.
    assert (np.abs(np.diff(q, axis=0) - 0.5 * DT * (v[1:] + v[:-1])) <= DT**3 / 12 * limits.j_max * (1 + 1e-6) + 1e-12).all()
    data = mujoco.MjData(arm.model)
    free = limits.tau_max + arm.model.dof_frictionloss[arm.dof_adr]
    for k in range(0, len(q), 5):
        data.qpos[:] = arm.home_qpos
        data.qpos[arm.qpos_adr] = q[k]
        data.qvel[arm.dof_adr] = v[k]
        data.qacc[arm.dof_adr] = a[k]
        mujoco.mj_inverse(arm.model, data)
        torque = (data.qfrc_inverse + data.qfrc_constraint)[arm.dof_adr]
        assert (np.abs(torque) <= free).all()


def followed(arm: armctl.Arm, wanted, seconds: float, *, noise: float = 0.0, latency: float = 0.0, rate: float = RATE):
    """The greatest and the RMS distance from a moving target after one second, and the lag, s."""
    stream = armctl.Stream(arm, wanted(0.0))
    rng = np.random.default_rng(0)
    points = []
    errors = []
    speeds = []
    due = 0.0
    while stream.t < seconds:
        if stream.t >= due - 1e-9:
            due += 1 / rate
            t = stream.t - latency
            stream.push(t, wanted(t) + noise * rng.standard_normal(arm.n))
        points.append(stream.step(DT))
        if stream.t > 1.0:
            errors.append(wanted(stream.t) - points[-1].q)
            speeds.append((wanted(stream.t + 1e-4) - wanted(stream.t - 1e-4)) / 2e-4)
    assert_inside(arm, points)
    e, v = np.array(errors), np.array(speeds)
    return np.abs(e).max(), np.sqrt((e**2).mean()), (v * e).sum() / (v**2).sum()


def sine(arm: armctl.Arm, amplitude: float = 0.3, frequency: float = 0.3):
    middle = 0.5 * (arm.limits.q_min + arm.limits.q_max)
    return lambda t: middle + amplitude * np.sin(2 * np.pi * frequency * t + np.arange(arm.n))


def test_a_moving_target_is_followed_without_lag(arm):
    worst, rms, lag = followed(arm, sine(arm), 3.0)
    assert worst < 3e-3
    assert rms < 1e-3
    assert abs(lag) < 5e-3


def test_noise_of_the_targets_is_averaged(arm):
    _, rms, lag = followed(arm, sine(arm), 4.0, noise=5e-3)
    assert rms < 0.009  # stop to stop it is four times as much
    assert abs(lag) < 1 / RATE


def test_latency_is_predicted_away(arm):
    _, rms, lag = followed(arm, sine(arm), 3.0, latency=0.1)
    assert rms < 0.006
    assert abs(lag) < 0.02


@pytest.mark.parametrize("latency", [0.15, 0.2])
def test_slow_targets_that_are_late_and_noisy_are_followed_better_than_by_interpolation(arm, latency: float):
    """Interpolated, the arm is at the newest target a frame after it arrived; the fit is chosen for the age of the targets."""
    wanted = sine(arm, 0.2, 0.1)
    rate = 50.0
    rng = np.random.default_rng(0)
    times = np.arange(0.0, 5.0, 1 / rate) - latency
    targets = np.array([wanted(t) for t in times]) + 0.01 * rng.standard_normal((len(times), arm.n))
    interpolated = targets - np.array([wanted(t + latency + 1 / rate) for t in times])
    _, rms, _ = followed(arm, wanted, 5.0, noise=0.01, latency=latency, rate=rate)
    assert rms < 0.8 * np.sqrt(np.mean(interpolated[50:] ** 2))


def rest(t: float) -> float:
    return 0.0


def fast_sine(t: float) -> float:
    return 0.2 * np.sin(2 * np.pi * t)


def two_sines(t: float) -> float:
    return 0.15 * np.sin(2 * np.pi * 0.7 * t) + 0.1 * np.sin(2 * np.pi * 0.4 * t)


def triangle(t: float) -> float:
    return 0.2 * abs(2 * (t / 1.7 % 1.0) - 1)


def steps(t: float) -> float:
    return 0.25 * np.sin(7.0 * np.floor(t))


@pytest.mark.parametrize("wanted", [rest, fast_sine, two_sines, triangle, steps])
@pytest.mark.parametrize("latency", [0.0, 0.07, 0.2])
@pytest.mark.parametrize("rate", some_of([10.0, 30.0, 100.0], [10.0]))
def test_no_prediction_is_worse_than_the_better_one_of_holding_and_extrapolating_the_targets(
    wanted, latency: float, rate: float
):
    rng = np.random.default_rng(3)
    joints = np.array([0.0, 0.3, 0.9])
    targets = TimedTargets(np.array([wanted(-latency + s) for s in joints]), np.full(3, 2.0), np.full(3, 20.0))
    errors = {"predicted": [], "held": [], "extrapolated": []}
    last = []
    for noise in (0.0, 0.005, 0.015):
        for k in range(int(4 * rate)):
            now = targets.newest + latency + 1 / rate if last else 0.0
            t = now - latency
            last = [*last[-1:], np.array([wanted(t + s) for s in joints]) + noise * rng.standard_normal(3)]
            targets.push(t, last[-1], now)
            if k < 1.5 * rate:
                continue
            for ahead, predicted in enumerate(targets.knots(now).q[:2], start=1):
                true = np.array([wanted(now + ahead / rate + s) for s in joints])
                errors["predicted"].append(predicted - true)
                errors["held"].append(last[-1] - true)
                errors["extrapolated"].append(last[-1] + (latency * rate + ahead) * (last[-1] - last[0]) - true)
        rms = {name: np.sqrt(np.mean(np.square(each))) for name, each in errors.items()}
        assert rms["predicted"] <= 1.05 * min(rms["held"], rms["extrapolated"]) + 1e-3, f"{noise} rad of noise"
        for each in errors.values():
            each.clear()


def test_a_target_that_sets_off_at_half_the_arms_acceleration_is_no_jump(arm):
    """It is predicted, not taken for a new target at rest: 0.1 rad behind while it goes 0.22 rad in 0.3 s."""
    start = 0.5 * (arm.limits.q_min + arm.limits.q_max) - 0.3

    def wanted(t: float) -> np.ndarray:
        faster, slower = np.clip([t - 1.0, t - 1.15], 0.0, 0.15)
        return start + 0.5 * arm.limits.a_max * (0.5 * faster**2 + 0.15 * slower - 0.5 * slower**2)

    worst, _, _ = followed(arm, wanted, 2.0)
    assert worst < 0.12


def test_a_chunk_is_passed_at_its_times_and_the_arm_rests_at_its_end(arm):
    times = 0.2 + 0.05 * np.arange(20)
    rows = np.array([sine(arm, 0.2, 0.4)(t) for t in times])
    stream = armctl.Stream(arm, sine(arm, 0.2, 0.4)(0.0))
    stream.push_chunk(times, rows)
    points = []
    for time, row in zip(times[2:-1], rows[2:-1], strict=True):
        while stream.t < time - 1e-9:
            points.append(stream.step(DT))
        assert stream.setpoint.q == pytest.approx(row, abs=1e-9)
    while stream.time_left > 0.0:
        points.append(stream.step(DT))
    assert stream.setpoint.q == pytest.approx(rows[-1], abs=1e-7)
    assert_inside(arm, points)


def test_a_newer_chunk_replaces_the_older_one_from_its_first_time_on(arm):
    stream = armctl.Stream(arm, arm.home)
    stream.push_chunk(0.1 * np.arange(1, 11), arm.home + 0.02 * np.arange(1, 11)[:, None])
    stream.step(0.25)
    stream.push_chunk(0.1 * np.arange(5, 9), arm.home + 0.1 - 0.02 * np.arange(0, 4)[:, None])
    points = [stream.step(DT) for _ in range(int(2.0 / DT))]
    assert stream.setpoint.q == pytest.approx(arm.home + 0.04, abs=1e-7)
    assert_inside(arm, points)


@pytest.mark.full
@pytest.mark.parametrize("every", [0.1, 1 / RATE, 0.02, DT])
def test_a_chunk_that_is_replaced_often_is_followed_as_well(arm, every: float):
    wanted = sine(arm)
    stream = armctl.Stream(arm, wanted(0.0))
    errors = []
    due = 0.0
    while stream.t < 2.0:
        if stream.t >= due - 1e-9:
            due += every
            times = stream.t - 0.1 + np.arange(16) / RATE
            stream.push_chunk(times, [wanted(t) for t in times])
        point = stream.step(DT)
        if stream.t > 1.0:
            errors.append(wanted(stream.t) - point.q)
    assert np.abs(errors).max() < 1e-4


def test_a_single_step_of_the_target_is_reached_at_rest(arm):
    stream = armctl.Stream(arm, arm.home)
    goal = arm.limits.clamp(arm.home + np.array([0.8, 0.3, -0.4]))
    for _ in range(20):
        stream.push(stream.t, arm.home)
        stream.step(1 / RATE)
    stream.push(stream.t, goal)
    points = [stream.step(DT) for _ in range(int(2.0 / DT))]
    assert stream.setpoint.q == pytest.approx(goal, abs=1e-7)
    assert np.abs(stream.setpoint.v).max() < 1e-6
    assert_inside(arm, points)


@settings(max_examples=12, deadline=None)
@given(seed=st.integers(0, 10**6))
def test_random_chunks_jumps_and_gaps_break_no_limit(arm, seed: int):
    rng = np.random.default_rng(seed)
    limits = arm.limits
    stream = armctl.Stream(arm, arm.home)
    points = [stream.setpoint]
    for _ in range(25):
        q = points[-1].q
        match rng.integers(4):
            case 0:
                count = rng.integers(1, 30)
                times = stream.t + rng.uniform(-0.2, 0.2) + rng.uniform(0.005, 0.1) * np.arange(count)
                walk = rng.standard_normal((count, arm.n)) * rng.choice([0.001, 0.01, 0.1, 0.5])
                far = q + np.cumsum(walk, axis=0)
                stream.push_chunk(times, np.clip(far, limits.q_min - 3.0, limits.q_max + 3.0))
            case 1:
                far = q + rng.standard_normal(arm.n) * rng.choice([0.001, 0.1, 10.0])
                stream.push(stream.t - rng.uniform(0.0, 0.1), np.clip(far, limits.q_min - 3.0, limits.q_max + 3.0))
            case 2:
                stream.push(stream.t, rng.uniform(limits.q_min, limits.q_max))
            case 3:
                stream.stop()
        points += [stream.step(DT) for _ in range(1 + int(rng.exponential(0.1) / DT))]
    assert_inside(arm, points)
    points += [stream.step(DT) for _ in range(1 + int(stream.time_left / DT))]
    assert np.abs(points[-1].v).max() < 1e-6


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda s: s.push(0.0, [np.nan, 0.0, 0.0]), r"q: element \[0\] is nan"),
        (lambda s: s.push(np.nan, np.zeros(3)), "t: "),
        (lambda s: s.push(0.0, [0.0, 0.0]), "q: "),
        (lambda s: s.push(100.0, np.zeros(3)), "t: 100 s is more than 60 s ahead of the stream's time, 0 s"),
        (lambda s: s.push_chunk([0.1, 0.1], np.zeros((2, 3))), "times: they must increase"),
        (lambda s: s.push_chunk([0.1, 0.2], np.zeros((3, 3))), "q: 3 targets for 2 times"),
        (lambda s: s.push_chunk([], np.zeros((0, 3))), "times: a chunk has 1 to 1000 targets, got 0|q"),
        (lambda s: s.push_twist([np.inf, 0, 0]), "linear: "),
        (lambda s: s.push_pose(0.0, [1.0, 2.0]), "target: "),
        (lambda s: s.clutch([0, 0, 0]), "device: "),
        (lambda s: s.step(-1.0), "dt: "),
        (lambda s: s.restart(-1.0, np.zeros(3)), "t: "),
        (lambda s: s.restart(1.0, [90.0, 45.0, -30.0]), r"q: shoulder_yaw: 90 rad .*degrees\?"),
    ],
)
def test_bad_input_is_refused_in_one_sentence_and_changes_nothing(arm, call, message: str):
    stream = armctl.Stream(arm, arm.home)
    stream.push(0.0, arm.home + 0.1)
    before = stream.setpoint, stream.time_left
    with pytest.raises(armctl.InputError, match=message):
        call(stream)
    assert (stream.setpoint.q == before[0].q).all()
    assert stream.time_left == before[1]


def test_duplicates_and_reversed_times_are_dropped_and_counted(arm):
    stream = armctl.Stream(arm, arm.home)
    for t in (0.0, 0.0, -0.1):
        stream.push(t, arm.home + 0.1)
    report = stream.report
    assert (report.targets, report.dropped) == (1, 2)


def test_targets_outside_the_limits_are_moved_inside_and_counted(arm):
    stream = armctl.Stream(arm, arm.home)
    stream.push(0.0, arm.limits.q_max + 3.0)
    stream.step(5.0)
    assert stream.report.clamped == 1
    assert stream.setpoint.q == pytest.approx(arm.limits.q_max, abs=1e-7)


def test_a_twist_moves_the_tip_and_ends_when_it_is_not_renewed(arm):
    stream = armctl.Stream(arm, arm.home)
    start = arm.fk(arm.home).position
    points = []
    for _ in range(20):
        stream.push_twist([0.0, 0.0, -0.05])
        points += [stream.step(DT) for _ in range(25)]
    moved = arm.fk(stream.setpoint.q).position - start
    assert moved == pytest.approx([0.0, 0.0, -0.05], abs=0.01)
    points += [stream.step(DT) for _ in range(400)]
    assert stream.time_left == 0.0
    assert np.linalg.norm(arm.fk(stream.setpoint.q).position - start) < 0.07
    assert_inside(arm, points)


def test_a_clutch_moves_neither_hand_nor_arm():
    arm = arm_of("redundant")
    stream = armctl.Stream(arm, arm.home)
    start = arm.fk(arm.home)
    device = armctl.Pose([5.0, 6.0, 7.0], rpy=[0.1, 0.2, 0.3])
    stream.clutch(device)
    for k in range(40):
        offset = 0.002 * k
        stream.push_pose(stream.t, armctl.Pose(device.position + np.array([0.0, 0.0, offset]), device.quat))
        stream.step(1 / RATE)
    stream.step(2.0)
    end = arm.fk(stream.setpoint.q)
    assert end.position - start.position == pytest.approx([0.0, 0.0, 0.078], abs=1e-4)
    assert end.rotation == pytest.approx(start.rotation, abs=1e-4)


def test_the_report_tells_the_share_of_time_at_each_limit(arm):
    stream = armctl.Stream(arm, arm.limits.q_min)
    stream.push_chunk([stream.t + 1e-3], [arm.limits.q_max])
    points = [stream.step(1e-3) for _ in range(2000)]
    near = 1 - 1e-9
    at_velocity = np.mean([(np.abs(point.v) >= near * arm.limits.v_max).any() for point in points])
    at_acceleration = np.mean([(np.abs(point.a) >= near * arm.limits.a_max).any() for point in points])
    assert 0.05 < at_velocity < 0.95
    assert 0.01 < at_acceleration < 0.95
    assert stream.report.at_velocity_limit == pytest.approx(at_velocity, abs=0.02)
    assert stream.report.at_acceleration_limit == pytest.approx(at_acceleration, abs=0.02)


def test_the_rows_for_the_tick_loop_join_without_a_gap(arm):
    """Their velocity is the difference of positions, from the first row of the first call on."""
    stream = armctl.Stream(arm, arm.home)
    stream.push_chunk([0.5], [arm.home + 0.3])
    stream.step(0.1)
    rows = [stream.reference(ticks, DT) for ticks in (1, 5, 30)]
    v, v_tick, a_tick = (np.vstack([getattr(row, name) for row in rows]) for name in ("v", "v_tick", "a_tick"))
    assert np.abs(v).max() > 0.3
    assert v_tick == pytest.approx(v, abs=0.6 * DT * np.abs(arm.limits.a_max).max())
    assert v_tick[0] == pytest.approx(v[0], abs=1e-12)
    assert a_tick[:-1] == pytest.approx(np.diff(v_tick, axis=0) / DT, abs=1e-9)


def test_the_arm_stops_before_an_obstacle_and_the_report_names_it(arm_before_a_wall):
    arm = arm_before_a_wall
    stream = armctl.Stream(arm, arm.home, avoid=True)
    times = 0.05 * np.arange(1, 60)
    stream.push_chunk(times, arm.home + np.outer(np.linspace(0, 1, 59), [1.2, 0.0, 0.0]))
    points = [stream.step(DT) for _ in range(int(4.0 / DT))]
    assert "wall" in stream.report.obstacle
    assert np.abs(points[-1].v).max() < 1e-6
    assert points[-1].q[0] > arm.home[0] + 0.1, "it moves as far as it is free"
    assert_inside(arm, points)
    data = mujoco.MjData(arm.model)
    for point in points[::10]:
        data.qpos[:] = arm.home_qpos
        data.qpos[arm.qpos_adr] = point.q
        mujoco.mj_forward(arm.model, data)
        assert not any("wall" in {arm.model.geom(g).name for g in contact.geom} for contact in data.contact)


def test_a_motion_that_is_refused_becomes_shorter_until_it_is_not_and_the_report_says_why(arm):
    limit = arm.home[0] + 0.4
    asked = []

    def refusal(pieces) -> str:
        asked.append(pieces)
        times = np.linspace(0.0, pieces.knots[-1], 200)
        return "joint 0 would turn too far" if sample(pieces, times).q[:, 0].max() > limit else ""

    stream = armctl.Stream(arm, arm.home, refusal=refusal)
    points = []
    for k in range(90):
        stream.push(stream.t, arm.home + np.array([0.02 * k, 0.0, 0.0]))
        points += [stream.step(DT) for _ in range(16)]
    assert asked
    assert stream.report.obstacle == "joint 0 would turn too far"
    points += [stream.step(DT) for _ in range(1000)]
    assert limit - 0.05 < points[-1].q[0] <= max(point.q[0] for point in points) <= limit + 1e-9
    assert_inside(arm, points)
    stream.push(stream.t, arm.home)
    assert stream.report.obstacle == ""


def test_the_pieces_are_the_motion_from_now_on(arm):
    stream = armctl.Stream(arm, arm.home)
    assert stream.pieces.knots[-1] == 0.0
    stream.push(stream.t, arm.home + 0.2)
    stream.step(0.1)
    pieces = stream.pieces
    times = 0.01 * np.arange(1, 30)
    ahead = sample(pieces, times)
    points = [stream.step(0.01) for _ in times]
    assert ahead.q == pytest.approx(np.array([point.q for point in points]), abs=1e-9)
    assert ahead.v == pytest.approx(np.array([point.v for point in points]), abs=1e-9)
    with pytest.raises(armctl.InputError, match="refusal: expected a function of a motion's pieces, got 5"):
        armctl.Stream(arm, arm.home, refusal=5)


@pytest.fixture
def arm_before_a_wall(arm) -> armctl.Arm:
    ahead = arm.fk(arm.home + np.array([0.8, 0.0, 0.0])).position
    return armctl.load("robot_arm_3dof", scene=armctl.World().add("wall", armctl.Box([0.1, 0.1, 0.6]), ahead))


@pytest.mark.parametrize("far", [[400.0, 0.0, 0.0], [300.0, 100.0, 250.0], [0.0, 0.0, -1e9]])
def test_a_target_that_no_arm_reaches_is_refused_and_changes_nothing(bundled, far):
    stream = armctl.Stream(bundled, bundled.home)
    stream.push_pose(0.1, [0.3, 0.1, 0.3])
    with pytest.raises(armctl.LimitError, match="positions are in metres"):
        stream.push_pose(0.2, far)
    other = armctl.Stream(bundled, bundled.home)
    other.push_pose(0.1, [0.3, 0.1, 0.3])
    assert np.array_equal([stream.step(0.004).q for _ in range(200)], [other.step(0.004).q for _ in range(200)])

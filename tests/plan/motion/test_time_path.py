"""Given paths: the motion stays on them, keeps all limits, and is as fast as a closed form or the same path in another form."""

from dataclasses import replace

import numpy as np
import pytest
from arms import arm_of
from light_arms import light_arm, with_bounds
from motion_check import violation
from scipy.interpolate import BSpline, CubicSpline, PchipInterpolator, make_interp_spline

import armctl

N = 3


@pytest.fixture(scope="module")
def light(tmp_path_factory) -> armctl.Arm:
    return light_arm(tmp_path_factory.mktemp("arm"), N)


def random_spline(arm: armctl.Arm, seed: int) -> CubicSpline:
    rng = np.random.default_rng(seed)
    return CubicSpline(np.linspace(0.0, 1.0, 6), rng.uniform(-0.5, 0.5, (6, arm.n)))


def off_path(motion: armctl.JointTrajectory, spline) -> float:
    """rad, the largest distance of a sample of a motion from a path over [0, 1]."""
    coarse = np.linspace(0.0, 1.0, 2001)
    points = spline(coarse)
    worst = 0.0
    for row in motion.sample(np.linspace(0.0, motion.duration, 60)).q:
        near = coarse[np.linalg.norm(points - row, axis=1).argmin()]
        fine = spline(np.clip(near + np.linspace(-5e-4, 5e-4, 10_001), 0.0, 1.0))
        worst = max(worst, float(np.linalg.norm(fine - row, axis=1).min()))
    return worst


def circle(s: np.ndarray, order: int) -> np.ndarray:
    """Joints 0 and 1 on a circle of radius 1, over its angle."""
    turn = s + 0.5 * np.pi * order
    return np.column_stack([np.cos(turn), np.sin(turn), np.zeros_like(s)])


def test_a_circle_is_timed_as_its_closed_form(light):
    """At constant speed v the acceleration of each joint is at most v^2; ramps of jerk J and acceleration A cost v / A + A / J.

    So the time is 2 pi / v + ramps: the speed limit binds (0.5^2 < 1), and the ramps are a trapezoid of the acceleration that
    turns with the circle, which may be faster, since two joints share it.
    """
    v, a, j = 0.5, 1.0, 50.0
    arm = with_bounds(light, v, a, j)
    motion = armctl.time_path(arm, circle, (0.0, 4 * np.pi))
    # Both joints at their limits at once: the speed along the circle is v / max(|sin|, |cos|).
    s = np.linspace(0.0, 4 * np.pi, 100_001)
    at_speed = float(np.trapezoid(np.maximum(np.abs(np.sin(s)), np.abs(np.cos(s))) / v, s))
    assert at_speed < motion.duration < at_speed + v / a + a / j + 0.15 * at_speed
    q = motion.sample(np.linspace(0.0, motion.duration, 5000)).q
    assert np.abs(np.hypot(q[:, 0], q[:, 1]) - 1.0).max() < 1e-6
    assert np.abs(q[:, 2]).max() < 1e-12
    assert not violation(motion, arm.limits)


def test_a_line_takes_as_long_as_the_straight_move(light):
    """move_j has a closed form on a line; whatever the parameter is."""
    arm = with_bounds(light, 1.0, 4.0, 100.0)
    way = np.array([0.8, -0.4, 0.2])
    closed = armctl.move_j(arm, np.zeros(N), way).duration
    s = np.linspace(0.0, 1.0, 20)
    for parameter in (s, 10 * s, s + 0.3 * s**2):
        motion = armctl.time_path(arm, CubicSpline(parameter, s[:, None] * way))
        assert closed * (1 - 1e-9) <= motion.duration <= 1.005 * closed
        assert np.abs(motion.sample(np.linspace(0, motion.duration, 100)).q @ [0.5, 1.0, 0.0]).max() < 1e-9
        assert not violation(motion, arm.limits)


@pytest.mark.parametrize("seed", range(4))
def test_the_same_path_in_all_its_forms_takes_the_same_time(light, seed):
    arm = with_bounds(light, 1.5, 8.0, 200.0)
    spline = random_spline(arm, seed)
    x = np.linspace(0.0, 1.0, 201)
    as_spline = armctl.time_path(arm, spline)
    assert not violation(as_spline, arm.limits)
    assert off_path(as_spline, spline) < 1e-6
    forms = {
        "a function": armctl.time_path(arm, lambda s, order: spline(s, order), (0.0, 1.0)),
        "a B-spline": armctl.time_path(arm, make_interp_spline(x, spline(x), k=3)),
        "points with parameters": armctl.time_path(arm, spline(x), parameters=x),
        "points": armctl.time_path(arm, spline(x)),
        "points with derivatives": armctl.time_path(arm, spline(x), parameters=x, derivatives=spline(x, 1)),
        "its own motion": armctl.time_path(arm, as_spline),
        "a slow motion": armctl.time_path(arm, as_spline.scaled(0.1)),
    }
    for form, motion in forms.items():
        assert motion.duration == pytest.approx(as_spline.duration, rel=0.01), form
        assert off_path(motion, spline) < 2e-5, form
        assert not violation(motion, arm.limits), form


def test_no_point_of_the_path_could_be_passed_faster_without_jerk(light):
    """Where the jerk does not bind, some joint is always at its limit of speed or acceleration: the bang-bang principle."""
    arm = with_bounds(light, 1.5, 8.0, 1e5)
    motion = armctl.time_path(arm, random_spline(arm, 1))
    samples = motion.sample(np.linspace(0.0, motion.duration, 2000))
    share = np.maximum(np.abs(samples.v) / 1.5, np.abs(samples.a) / 8.0).max(axis=1)
    assert (share > 0.97).mean() > 0.93


def test_a_motion_that_is_given_is_sped_up_on_its_path_and_a_pause_in_it_is_refused(light):
    arm = with_bounds(light, 1.0, 4.0, 100.0)
    there, back = np.array([0.5, 0.2, 0.1]), np.array([0.1, 0.5, -0.3])
    slow = armctl.move_j(arm, np.zeros(N), there, speed=0.2)
    fast = armctl.time_path(arm, slow)
    assert fast.duration == pytest.approx(armctl.move_j(arm, np.zeros(N), there).duration, rel=0.005)
    with pytest.raises(armctl.InputError, match=f"stands still or turns back at {slow.duration:.4g}"):
        armctl.time_path(arm, slow.then(armctl.move_j(arm, there, back, speed=0.2)))


@pytest.mark.parametrize("size", [1.0, 1e-3, 1e-5])
def test_a_motion_that_is_given_is_never_slower_than_before(light, size):
    """Also where the whole way is micrometers, and where every joint's own profile is the fastest."""
    arm = with_bounds(light, 1.0, 4.0, 100.0)
    for motion in (
        armctl.move_j(arm, np.zeros(N), size * np.array([0.5, 0.2, 0.1]), straight=False),
        armctl.move_through(arm, size * np.random.default_rng(1).uniform(-1, 1, (4, N))),
        armctl.move_j(arm, np.zeros(N), size * np.array([0.5, 0.2, 0.1]), profile="quintic", duration=4.0),
    ):
        timed = armctl.time_path(arm, motion)
        assert timed.duration <= motion.duration * (1 + 1e-6)
        assert timed.check_limits().ok
        assert not violation(timed, arm.limits)


def test_speed_is_that_of_every_other_motion(light):
    arm = with_bounds(light, 1.5, 8.0, 200.0)
    spline = random_spline(arm, 3)
    assert armctl.time_path(arm, spline, speed=0.5).duration == pytest.approx(
        2 * armctl.time_path(arm, spline).duration, rel=2e-3
    )


def test_a_motor_that_is_too_weak_slows_the_motion_down():
    arm = arm_of("robot_arm_3dof")
    x = np.linspace(0.0, 1.0, 8)
    spline = CubicSpline(x, arm.home + 0.5 * np.sin(3 * x)[:, None] * [1.0, -0.5, 0.7])
    free = armctl.time_path(arm, spline)
    weak = arm.with_limits(
        replace(arm.limits, tau_max=0.9 * np.array(armctl.check_torque(arm, free).ratios) * arm.limits.tau_max)
    )
    motion = armctl.time_path(weak, spline)
    assert motion.slowed is not None
    assert motion.duration > free.duration
    assert armctl.check_torque(weak, motion).ok
    assert not violation(motion, arm.limits)


LINE = np.outer(np.linspace(0.0, 1.0, 5), np.ones(N))
ELBOW = [0.0, 0.0, 1.0]
MONOTONE = PchipInterpolator([0, 1, 2, 3], np.outer([0.0, 1.0, 1.5, 4.0], np.ones(N)))
CORNER = BSpline([0, 0, 0.5, 1, 1], [[0, 0, 0], [1, 0, 0], [1, 1, 0]], 1)
STANDING = CubicSpline([0, 1, 2], np.zeros((3, N)))
WRONG = {
    "first derivative jumps at 0.5": lambda arm: armctl.time_path(arm, CORNER),
    "second derivative jumps at 1": lambda arm: armctl.time_path(arm, MONOTONE),
    r"interval: .*give interval=\(start, end\)": lambda arm: armctl.time_path(arm, circle),
    "interval: its end, 1, is not above its start": lambda arm: armctl.time_path(arm, circle, (1.0, 1.0)),
    r"has shape \(\d+, 2\), expected": lambda arm: armctl.time_path(arm, lambda s, order: np.zeros((len(s), 2)), (0, 1)),
    r"path\(s, 0\) for an array of parameters failed with TypeError": lambda arm: armctl.time_path(arm, lambda s: s, (0, 1)),
    "is not finite": lambda arm: armctl.time_path(arm, lambda s, order: np.full((len(s), N), np.nan), (0, 1)),
    r"path\(s, 1\) of joint \d at .* differences of path\(s, 0\) give": lambda arm: armctl.time_path(
        arm, lambda s, order: 2.0**order * circle(s, order), (0, 3)
    ),
    "give a spline of SciPy": lambda arm: armctl.time_path(arm, "spline"),
    "at least two points that differ, got 1": lambda arm: armctl.time_path(arm, LINE[:1]),
    "it stays where it is": lambda arm: armctl.time_path(arm, STANDING),
    "path: .* outside": lambda arm: armctl.time_path(arm, 57.3 * LINE),
    "parameters: they must increase": lambda arm: armctl.time_path(arm, LINE, parameters=[0, 1, 1, 2, 3]),
    "derivatives: 5 rows for 5 points": lambda arm: armctl.time_path(arm, LINE, derivatives=LINE),
    "an interval belongs to a function": lambda arm: armctl.time_path(arm, LINE, (0, 1)),
    "but its range is": lambda arm: armctl.time_path(arm, arm.home + np.outer(np.linspace(0, 2, 5), ELBOW)),
}


@pytest.mark.parametrize("wrong", WRONG)
def test_what_is_no_path_is_refused_in_one_sentence(wrong):
    with pytest.raises(armctl.InputError, match=wrong) as info:
        WRONG[wrong](arm_of("robot_arm_3dof"))
    assert len(str(info.value)) <= 400


def test_a_motion_of_other_joints_is_refused(light):
    other = arm_of("redundant")
    with pytest.raises(armctl.InputError, match=r"path: it moves .*, but the arm has"):
        armctl.time_path(light, armctl.move_j(other, other.home, other.home + 0.1))


# Recordings


def test_a_motion_is_read_from_its_table_as_it_was(light, tmp_path):
    arm = with_bounds(light, 1.0, 4.0, 100.0)
    motion = armctl.time_path(arm, random_spline(arm, 2))
    read = armctl.JointTrajectory.from_csv(motion.to_csv(tmp_path / "motion.csv"), arm)
    times = np.linspace(0.0, motion.duration, 777)
    assert read.duration == pytest.approx(motion.duration, abs=1e-12)
    for a, b, tolerance in zip(read.sample(times)[:3], motion.sample(times)[:3], (1e-9, 1e-5, 0.05), strict=True):
        assert np.abs(a - b).max() < tolerance


def test_a_recording_plays_as_recorded_at_any_speed_inside_the_limits(tmp_path):
    arm = arm_of("robot_arm_3dof")
    t = np.linspace(5.0, 9.0, 81)
    q = arm.home + 0.2 * np.sin(t - 5.0)[:, None] * [1.0, 0.5, -0.5]
    names = list(reversed(arm.joint_names))
    file = tmp_path / "taught.csv"
    rows = [
        ";".join(["note", "t", *names]),
        *(";".join(map(repr, [1.0, *row])) for row in np.column_stack([t, q[:, ::-1]]).tolist()),
    ]
    file.write_text("\n".join(rows) + "\n", encoding="utf-8")
    played = armctl.JointTrajectory.from_csv(file, arm)
    assert played.duration == 4.0
    assert np.abs(played.sample(t - 5.0).q - q).max() < 1e-12
    slow = armctl.JointTrajectory.from_csv(file, arm, speed=0.5)
    assert slow.duration == 8.0
    assert np.abs(slow.sample(2 * (t - 5.0)).q - q).max() < 1e-12
    with pytest.raises(armctl.LimitError, match=r"speed: at 100, .* of its speed limit, .*; speed=([0-9.]+) keeps it") as info:
        armctl.JointTrajectory.from_csv(file, arm, speed=100.0)
    fitting = float(str(info.value).split("speed=")[1].split()[0])
    assert armctl.JointTrajectory.from_csv(file, arm, speed=0.99 * fitting).duration < 4.0
    sim = armctl.Simulation(arm)
    sim.move_j(played(0.0).q)
    assert sim.run(slow).t[-1] >= 8.0


def test_a_log_as_csv_is_a_motion(tmp_path):
    arm = arm_of("robot_arm_3dof")
    motion = armctl.move_j(arm, arm.home, arm.home + 0.2)
    log = armctl.simulate(arm, "pd-gravity", motion)
    read = armctl.JointTrajectory.from_csv(log.save(tmp_path / "log.csv"), arm)
    assert read.duration == pytest.approx(log.t[-1] - log.t[0])
    assert np.abs(read.sample(log.t - log.t[0]).q - log.q).max() < 1e-9


TABLES = {
    "time\n1\n": "there is no column 't' for the time",
    "t,q_shoulder_yaw\n0,1\n1,1\n": "there is no column 'q_shoulder_pitch'",
    "t,q_shoulder_yaw,q_shoulder_pitch,q_elbow\n0,0,0,0\n": "expected at least 2 rows, found 1",
    "t,q_shoulder_yaw,q_shoulder_pitch,q_elbow\n0,0,0,-1\n1,0,x,-1\n": "line 3: 'x' is not a number",
    "t,q_shoulder_yaw,q_shoulder_pitch,q_elbow\n0,0,0,-1\n1,0,0,-1\n1,0,0,-1\n": "row 3: its time, 1 s, is not after",
    "t,q_shoulder_yaw,q_shoulder_pitch,q_elbow\n0,0,0,-1\n1,90,45,-60\n": "path: positions: .* outside",
    "t,q_shoulder_yaw,q_shoulder_pitch,q_elbow\n0,0,0,-1\n1,0,0,0.5\n": "outside its range",
}


@pytest.mark.parametrize("text", TABLES, ids=range(len(TABLES)))
def test_a_table_that_is_no_motion_is_refused(text, tmp_path):
    arm = arm_of("robot_arm_3dof")
    assert arm.joint_names == ("shoulder_yaw", "shoulder_pitch", "elbow")
    file = tmp_path / "motion.csv"
    file.write_text(text, encoding="utf-8")
    with pytest.raises(armctl.InputError, match=TABLES[text]):
        armctl.JointTrajectory.from_csv(file, arm)
    with pytest.raises(armctl.InputError, match=r"ends in '.npz', expected"):
        armctl.JointTrajectory.from_csv(tmp_path / "motion.npz", arm)

"""A motion as a ROS JointTrajectory and back; messages of other programs, complete and incomplete."""

import json

import numpy as np
import pytest
from scipy.interpolate import CubicSpline

import armctl
from armctl import JointTrajectory


@pytest.fixture(scope="module")
def motion():
    arm = armctl.load("robot_arm_3dof")
    return armctl.move_j(arm, arm.home, arm.home + np.array([0.5, -0.3, 0.2]))


@pytest.mark.parametrize("ending", ["json", "yaml"])
def test_a_motion_is_the_same_after_a_message(bundled, motion, tmp_path, ending: str):
    again = JointTrajectory.from_ros(motion.to_ros(tmp_path / f"motion.{ending}", dt=0.005), bundled)
    times = np.linspace(0.0, motion.duration, 400)
    assert again.duration == pytest.approx(motion.duration, abs=1e-9)
    for had, has in zip(motion.sample(times)[:3], again.sample(times)[:3], strict=True):
        assert np.abs(had - has).max() < 0.02 * np.abs(had).max()
    assert np.abs(again.sample(times).q - motion.sample(times).q).max() < 1e-6


@pytest.mark.parametrize("left_out", [[], ["accelerations"], ["velocities", "accelerations"]])
def test_a_message_without_rates_gives_a_smooth_motion_through_its_points(bundled, motion, tmp_path, left_out: list[str]):
    message = json.loads(motion.to_ros(tmp_path / "motion.json", dt=0.02).read_text())
    for point in message["points"]:
        for kind in left_out:
            point[kind] = []
    again = JointTrajectory.from_ros(message, bundled)
    knots = again.knots[1:-1]
    assert again.sample(knots).q == pytest.approx(motion.sample(knots).q, abs=1e-12)
    for before, after in zip(again.sample(knots - 1e-9)[:3], again.sample(knots + 1e-9)[:3], strict=True):
        assert after == pytest.approx(before, abs=2e-5)
    assert np.abs(again.sample([0.0, again.duration]).v).max() < 1e-9
    assert np.abs(again.sample(motion.knots).q - motion.sample(motion.knots).q).max() < 1e-3


def test_the_order_of_joints_in_a_message_is_arbitrary(bundled, motion, tmp_path):
    message = json.loads(motion.to_ros(tmp_path / "motion.json").read_text())
    message["joint_names"].reverse()
    for point in message["points"]:
        for kind in ("positions", "velocities", "accelerations"):
            point[kind].reverse()
    assert JointTrajectory.from_ros(message, bundled)(0.3).q == pytest.approx(motion(0.3).q, abs=1e-5)


NAMES = ["shoulder_yaw", "shoulder_pitch", "elbow"]
POINT = {"positions": [0.0, 0.0, 0.0], "time_from_start": {"sec": 0, "nanosec": 0}}
LATER = {"positions": [0.1, 0.1, 0.1], "time_from_start": {"sec": 1, "nanosec": 0}}
WRONG = {
    "no message": ([], "it is not a JointTrajectory, since it has no list of joint_names"),
    "no points": ({"joint_names": NAMES, "points": []}, "it has no points"),
    "other joints": ({"joint_names": ["a", "b", "c"], "points": [POINT]}, "it is for the joints a, b, c"),
    "one joint twice": ({"joint_names": [NAMES[0]] * 3, "points": [POINT]}, "a name is given twice"),
    "too few": (
        {"joint_names": NAMES, "points": [POINT | {"positions": [1.0]}]},
        "point 0: positions: expected 3 numbers, got 1",
    ),
    "text": ({"joint_names": NAMES, "points": [POINT | {"positions": "abc"}]}, "is not an array of numbers"),
    "no time": (
        {"joint_names": NAMES, "points": [{"positions": [0.0] * 3}]},
        "expected seconds, or a stamp with sec and nanosec",
    ),
    "absurd": (
        {"joint_names": NAMES, "points": [POINT, LATER | {"positions": [0.0, -1e308, 0.0]}]},
        r"positions: a number is above 1e\+09",
    ),
    "backwards": ({"joint_names": NAMES, "points": [LATER, POINT]}, "point 1: its time_from_start, 0 s, is not after"),
    "some rates": (
        {"joint_names": NAMES, "points": [POINT, LATER | {"velocities": [0.0] * 3}]},
        "velocities: expected 3 numbers, got 0",
    ),
}


@pytest.mark.parametrize(("message", "reason"), WRONG.values(), ids=WRONG)
def test_what_is_no_message_for_the_arm_is_refused(bundled, tmp_path, message, reason: str):
    path = tmp_path / "message.json"
    path.write_text(json.dumps(message))
    with pytest.raises(armctl.InputError, match=reason):
        JointTrajectory.from_ros(path, bundled)


@pytest.mark.parametrize("content", [b"\xff\xfe", b"{", b"[" * 5000, b"a: [1", b"\x00"])
@pytest.mark.parametrize("ending", ["json", "yaml"])
def test_a_damaged_message_is_refused_in_one_sentence(bundled, tmp_path, content: bytes, ending: str):
    path = tmp_path / f"message.{ending}"
    path.write_bytes(content)
    with pytest.raises(armctl.InputError) as error:
        JointTrajectory.from_ros(path, bundled)
    assert "\n" not in str(error.value)


def test_a_yaml_whose_aliases_stand_for_billions_of_numbers_is_refused(bundled, tmp_path):
    lines = ["a0: &a0 [1, 1, 1, 1, 1, 1, 1, 1, 1]"]
    lines += [f"a{k}: &a{k} [{', '.join([f'*a{k - 1}'] * 9)}]" for k in range(1, 10)]
    path = tmp_path / "bomb.yaml"
    path.write_text("\n".join([*lines, "joint_names: [a, b, c]", "points: [{positions: *a9}]"]))
    with pytest.raises(armctl.InputError, match="no YAML: it has an alias"):
        JointTrajectory.from_ros(path, bundled)


def point(t: object, q: list[float], v: list[float] | None = None) -> dict:
    return {"positions": q, "velocities": v or [], "time_from_start": t}


TIMED = [point(0.0, [0.0, 0.0, 0.0]), point(0.5, [0.1, -0.2, 0.1]), point(1, [0.2, 0.1, 0.3])]
STAMPS = [{"sec": 0, "nanosec": 0}, {"sec": 0, "nanosec": 500_000_000}, {"sec": 1, "nanosec": 0}]
STAMPED = [{**p, "time_from_start": stamp} for p, stamp in zip(TIMED, STAMPS, strict=True)]
LATE = [{**p, "time_from_start": 3.0 + p["time_from_start"]} for p in TIMED]
WITH_FINGER = [{**p, "positions": [*p["positions"], t]} for t, p in enumerate(STAMPED)]
ROBOT = {"joint_trajectory": {"joint_names": NAMES, "points": STAMPED}}
MESSAGE = {"joint_names": NAMES, "points": STAMPED}
FLOATING = {"joint_names": [], "points": []}
AS_THEY_OCCUR = {
    "times as numbers": {"joint_names": NAMES, "points": TIMED},
    "a RobotTrajectory": {"joint_trajectory": MESSAGE, "multi_dof_joint_trajectory": FLOATING},
    "a DisplayTrajectory": {
        "model_id": "arm",
        "trajectory": [ROBOT],
        "trajectory_start": {"is_diff": 0},
    },
    "a goal of an action": {"goal": {"trajectory": MESSAGE, "goal_tolerance": []}},
    "a service's response": {"motion_plan_response": {"trajectory": {"joint_trajectory": MESSAGE}, "error_code": {"val": 1}}},
    "a doubled last point": {"joint_names": NAMES, "points": [*STAMPED, STAMPED[-1]]},
    "a doubled first point": {"joint_names": NAMES, "points": [STAMPED[0], *STAMPED]},
    "a gripper's joint that stands": {
        "joint_names": ["finger", *NAMES],
        "points": [{**p, "positions": [0.04, *p["positions"]]} for p in STAMPED],
    },
    "an offset of all times": {"joint_names": NAMES, "points": LATE},
    "rates that are null": {
        "joint_names": NAMES,
        "points": [{**p, "velocities": None, "accelerations": None} for p in STAMPED],
    },
    "arrays of NumPy": {
        "joint_names": np.array(NAMES),
        "points": [{**p, "positions": np.array(p["positions"]), "velocities": np.array([])} for p in STAMPED],
    },
    "stamps with nsec": {
        "joint_names": NAMES,
        "points": [
            {**p, "time_from_start": {"sec": t["sec"], "nsec": t["nanosec"]}} for p, t in zip(TIMED, STAMPS, strict=True)
        ],
    },
    "a point that is repeated a rounding later": {
        "joint_names": NAMES,
        "points": [TIMED[0], TIMED[1], {**TIMED[1], "time_from_start": 0.5 + 1e-12}, TIMED[2]],
    },
}


@pytest.mark.parametrize("name", AS_THEY_OCCUR)
def test_messages_as_they_occur_are_the_same_motion(bundled, name: str):
    motion = armctl.JointTrajectory.from_ros(AS_THEY_OCCUR[name], bundled)
    spline = CubicSpline([0.0, 0.5, 1.0], [p["positions"] for p in TIMED], bc_type="clamped")
    times = np.linspace(0.0, 1.0, 41)
    assert motion.duration == pytest.approx(1.0, abs=1e-12)
    assert np.abs(motion.sample(times).q - spline(times)).max() <= 1e-12


REFUSED = {
    "a gripper's joint that moves": (
        {"joint_names": [*NAMES, "finger"], "points": WITH_FINGER},
        r"finger is no joint of the arm, and it moves by 2; remove it",
    ),
    "two trajectories": (
        {"trajectory": [ROBOT, ROBOT]},
        "it has 2 trajectories",
    ),
    "a floating base": (
        {"joint_trajectory": MESSAGE, "multi_dof_joint_trajectory": {"joint_names": ["base"], "points": [{}]}},
        "several degrees of freedom",
    ),
    "a prefix": ({"joint_names": [f"left_{name}" for name in NAMES], "points": STAMPED}, "remove the prefix 'left_'"),
    "no times": ({"joint_names": NAMES, "points": [{**p, "time_from_start": 0} for p in STAMPED]}, "armctl.move_through"),
    "two places at one time": (
        {"joint_names": NAMES, "points": [*STAMPED, {**STAMPED[-1], "positions": [0.0, 0.0, 0.0]}]},
        "point 3: its time_from_start, 1 s, is not after .* remove one of the two",
    ),
    "a stamp with another word": (
        {"joint_names": NAMES, "points": [{**p, "time_from_start": {"sec": 2 * k, "ns": 5}} for k, p in enumerate(STAMPED)]},
        "point 0: time_from_start: expected sec and nanosec, got 'ns'",
    ),
    "an empty stamp": ({"joint_names": NAMES, "points": [{**STAMPED[0], "time_from_start": {}}]}, "got an empty table"),
    "a time of bool": ({"joint_names": NAMES, "points": [{**STAMPED[0], "time_from_start": True}]}, "is not a number"),
    "a time of NaN": ({"joint_names": NAMES, "points": [{**STAMPED[0], "time_from_start": float("nan")}]}, "finite"),
    "degrees": (
        {"joint_names": NAMES, "points": [STAMPED[0], {**STAMPED[1], "positions": [90.0, 0.0, -45.0]}]},
        r"message: positions: .*: 90 rad is outside .*; degrees\? messages of ROS have rad",
    ),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_is_not_safe_is_refused_with_the_remedy(bundled, name: str):
    content, sentence = REFUSED[name]
    with pytest.raises(armctl.InputError, match=sentence) as caught:
        armctl.JointTrajectory.from_ros(content, bundled)
    assert len(str(caught.value)) <= 400


AMPLITUDE = np.array([0.8, -0.4, 0.3])


def sampled(count: int, rate: float = 3.0) -> list[dict]:
    """Points of sines, with their derivatives."""
    times = np.linspace(0.0, 2.0, count)
    phase = rate * times[:, None]
    columns = {
        "positions": AMPLITUDE * np.sin(phase) - [0.0, 0.0, 1.0],
        "velocities": AMPLITUDE * rate * np.cos(phase),
        "accelerations": -AMPLITUDE * rate**2 * np.sin(phase),
    }
    return [{"time_from_start": float(t), **{name: column[k] for name, column in columns.items()}} for k, t in enumerate(times)]


OTHER_UNITS = {
    "velocities in degrees": ({"velocities": 57.3}, "its velocities add up to"),
    "accelerations in degrees": ({"accelerations": 57.3}, "its accelerations add up to"),
    "rates in degrees": ({"velocities": 57.3, "accelerations": 57.3}, "its velocities add up to"),
    "times in milliseconds": ({"time_from_start": 1000.0}, "degrees or milliseconds"),
    "small positions in degrees": ({"velocities": 1 / 57.3, "accelerations": 1 / 57.3}, "are they degrees"),
}


@pytest.mark.parametrize("count", [5, 12, 100, 1000])
@pytest.mark.parametrize("form", OTHER_UNITS)
def test_rates_and_positions_in_different_units_are_refused(bundled, form: str, count: int):
    factors, sentence = OTHER_UNITS[form]
    points = [{name: value * factors.get(name, 1.0) for name, value in point.items()} for point in sampled(count)]
    with pytest.raises(armctl.InputError, match=sentence) as caught:
        armctl.JointTrajectory.from_ros({"joint_names": NAMES, "points": points}, bundled)
    assert len(str(caught.value)) <= 400


@pytest.mark.parametrize("rate", [0.5, 3.0, 8.0])
@pytest.mark.parametrize("count", [3, 5, 12, 100])
def test_rates_that_belong_to_the_positions_are_taken_at_any_density(bundled, count: int, rate: float):
    points = sampled(count, rate)
    motion = armctl.JointTrajectory.from_ros({"joint_names": NAMES, "points": points}, bundled)
    for point in points:
        assert motion(point["time_from_start"]).v == pytest.approx(point["velocities"], abs=1e-9)


def test_points_at_which_the_arm_stands_may_be_far_apart(bundled):
    points = [{**point, "velocities": [0.0] * 3, "accelerations": [0.0] * 3} for point in sampled(12)]
    motion = armctl.JointTrajectory.from_ros({"joint_names": NAMES, "points": points}, bundled)
    assert np.abs(motion.sample(motion.knots).v).max() < 1e-12


class Message:
    """As rosidl makes it."""

    joint_names = NAMES
    points = STAMPED

    def get_fields_and_field_types(self) -> dict[str, str]:
        return {"joint_names": "sequence<string>", "points": "sequence<trajectory_msgs/JointTrajectoryPoint>"}


def test_an_object_of_rclpy_is_refused_with_the_function_that_makes_a_dict_of_it(bundled):
    with pytest.raises(armctl.InputError, match=r"expected a dict, .*message_to_ordereddict") as caught:
        armctl.JointTrajectory.from_ros(Message(), bundled)
    assert len(str(caught.value)) <= 400

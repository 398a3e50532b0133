"""The tip on lines, arcs and blended paths: on the path, inside the caps, slow where the joints have far to go, or refused."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from arms import arm_of
from synthetic import BENT, serial_arm

import armctl
from armctl.core.pose import Pose, rotation_vector
from armctl.plan.motion.move_cartesian import Arc, Line
from armctl.plan.motion.path import joint_path
from armctl.plan.motion.path.path_segments import Blend, Straight, Turn
from armctl.plan.motion.path.tip_caps import TipCaps

UM = 1e-6


@pytest.fixture(scope="module")
def panda() -> armctl.Arm:
    arm = arm_of("panda")
    return arm.with_limits(replace(arm.limits, tau_max=np.full(7, np.inf)))


def moved(arm, *way) -> armctl.Pose:
    """The pose at home, moved by so many metres."""
    home = arm.fk(arm.home)
    return armctl.Pose(home.position + way, quat=home.quat)


def tips(arm, motion, count=1500):
    return arm.fk_many(motion.sample(np.linspace(0.0, motion.duration, count)).q)


def test_a_line_is_straight_and_turns_evenly_along(panda):
    target = moved(panda, 0.0, 0.2, -0.1) @ armctl.Pose([0, 0, 0], rpy=[0.4, 0.2, -0.3])
    motion = armctl.move_l(panda, panda.home, target)
    start, angle = panda.fk(panda.home), panda.fk(panda.home).distance(target)[1]
    position, rotation = tips(panda, motion)
    way = target.position - start.position
    share = (position - start.position) @ way / (way @ way)
    assert np.abs(position - start.position - share[:, None] * way).max() < 5 * UM
    for k in range(0, 1500, 100):
        turned = start.distance(armctl.Pose.from_rotation(position[k], rotation[k]))[1]
        assert turned == pytest.approx(share[k] * angle, abs=1e-5)
    assert panda.fk(motion(motion.duration).q).distance(target)[0] < UM
    assert motion.check_limits().ok


def test_a_line_from_a_pose_takes_the_branch_with_the_shortest_motion(tmp_path):
    arm = serial_arm(tmp_path, replace(BENT["six joints"], range="-3 3"))
    start = arm.fk(arm.home)
    end = armctl.Pose(np.add(start.position, [-0.1, 0.1, -0.1]), quat=start.quat)
    motion = armctl.move_l(arm, start, end)
    durations = []
    for q in armctl.solve_ik_all(arm, start).q:
        try:
            durations.append(armctl.move_l(arm, q, end).duration)
        except armctl.PlanError:
            continue
    assert max(arm.fk(motion(0.0).q).distance(start)) < 1e-5
    assert max(arm.fk(motion(motion.duration).q).distance(end)) < 1e-5
    assert min(durations) < 0.9 * max(durations)
    assert motion.duration == pytest.approx(min(durations))
    with pytest.raises(armctl.PlanError, match=r"^q_start: the pose cannot be reached: out of reach by"):
        armctl.move_l(arm, armctl.Pose([3.0, 0.0, 0.0]), end)


def test_a_line_can_turn_on_the_spot(panda):
    target = panda.fk(panda.home) @ armctl.Pose([0, 0, 0], rpy=[0.5, 0.0, 0.3])
    position, _ = tips(panda, armctl.move_l(panda, panda.home, target))
    assert np.abs(position - target.position).max() < 5 * UM


def test_a_point_leaves_the_orientation_free():
    arm = arm_of("so_arm100")
    target = arm.fk(arm.home).position + np.array([0.03, 0.02, 0.04])
    position, _ = tips(arm, armctl.move_l(arm, arm.home, target))
    assert np.allclose(position[-1], target, atol=UM)


@pytest.mark.parametrize("angle", [None, 2 * np.pi, 4.0])
def test_an_arc_keeps_its_distance_from_its_centre(panda, angle):
    start = panda.fk(panda.home).position
    via, target = moved(panda, 0.0, 0.1, 0.1), moved(panda, 0.0, 0.2, 0.0)
    motion = armctl.move_c(panda, panda.home, via, target, angle=angle)
    position, _ = tips(panda, motion)
    center = start + np.array([0.0, 0.1, 0.0])
    assert np.abs(np.linalg.norm(position - center, axis=1) - 0.1).max() < 5 * UM
    assert np.abs(position[:, 0] - start[0]).max() < 5 * UM
    if angle is None:
        assert np.allclose(position[-1], target.position, atol=UM)
        assert np.linalg.norm(position - via.position, axis=1).min() < 1e-3
    elif angle > 6:
        assert np.allclose(position[-1], start, atol=UM)
        assert np.linalg.norm(position - target.position, axis=1).min() < 1e-3
    assert motion.check_limits().ok


def test_three_points_on_a_line_make_no_arc(panda):
    with pytest.raises(armctl.InputError, match="on one line and define no circle; give three points apart"):
        armctl.move_c(panda, panda.home, moved(panda, 0, 0.1, 0), moved(panda, 0, 0.2, 0))


def test_corners_are_rounded_inside_their_radius_only(panda):
    corners = [moved(panda, 0, 0.1, 0), moved(panda, 0, 0.1, -0.1), moved(panda, 0, 0, -0.1), moved(panda, 0, 0, 0)]
    motion = armctl.move_path(panda, panda.home, corners, blend=0.02)
    position, _ = tips(panda, motion, 4000)
    points = [panda.fk(panda.home).position, *(corner.position for corner in corners)]
    sides = [to_segment(position, a, b) for a, b in pairwise(points)]
    off = np.min(sides, axis=0)
    near = np.min([np.linalg.norm(position - corner, axis=1) for corner in points[1:-1]], axis=0)
    assert off[near > 0.02 + UM].max() < 5 * UM
    assert 1e-3 < off.max() < 0.02
    speed = np.linalg.norm(np.diff(position, axis=0), axis=1) * 3999 / motion.duration
    assert speed[200:-200].min() > 0.02
    assert motion.duration < armctl.move_path(panda, panda.home, corners).duration
    assert motion.check_limits().ok


def to_segment(points, a, b):
    share = np.clip((points - a) @ (b - a) / ((b - a) @ (b - a)), 0.0, 1.0)
    return np.linalg.norm(points - a - share[:, None] * (b - a), axis=1)


def test_without_a_blend_the_tip_goes_into_every_corner(panda):
    corners = [moved(panda, 0, 0.1, 0), moved(panda, 0, 0.1, -0.1)]
    position, _ = tips(panda, armctl.move_path(panda, panda.home, corners), 4000)
    assert np.linalg.norm(position - corners[0].position, axis=1).min() < 5 * UM


def test_lines_and_arcs_blend_too(panda):
    path = [
        Line(moved(panda, 0, 0.1, 0), blend=0.01),
        Arc(moved(panda, 0.0, 0.15, -0.05), moved(panda, 0, 0.1, -0.1), blend=0.02),
        moved(panda, 0, 0, -0.1),
    ]
    motion = armctl.move_path(panda, panda.home, path)
    assert motion.check_limits().ok
    assert np.allclose(panda.fk(motion(motion.duration).q).position, moved(panda, 0, 0, -0.1).position, atol=UM)


def test_a_blend_longer_than_half_a_side_is_refused(panda):
    with pytest.raises(armctl.InputError, match=r"blend: 0\.06 m at corner 1 is more than half"):
        armctl.move_path(panda, panda.home, [moved(panda, 0, 0.1, 0), moved(panda, 0, 0.1, -0.1)], blend=0.06)


def test_points_and_poses_do_not_mix(panda):
    with pytest.raises(armctl.InputError, match="some targets are poses and some are points"):
        armctl.move_path(panda, panda.home, [moved(panda, 0, 0.1, 0), [0.5, 0.0, 0.4]])
    with pytest.raises(armctl.InputError, match="it is empty"):
        armctl.move_path(panda, panda.home, [])


def test_caps_on_the_tip_are_kept_and_reached(panda):
    target = moved(panda, 0.0, 0.2, -0.1) @ armctl.Pose([0, 0, 0], rpy=[0.4, 0.2, -0.3])
    for caps in ({"tip_speed": 0.1}, {"tip_angular_speed": 0.2}):
        motion = armctl.move_l(panda, panda.home, target, **caps)
        times = np.linspace(0.0, motion.duration, 800)
        q, v = motion.sample(times)[:2]
        twists = np.array([panda.jacobian(a) @ b for a, b in zip(q, v, strict=True)])
        speed = np.linalg.norm(twists[:, :3] if "tip_speed" in caps else twists[:, 3:], axis=1).max()
        cap = next(iter(caps.values()))
        assert 0.99 * cap < speed < cap * (1 + 1e-9)
    with pytest.raises(armctl.InputError, match="tip_speed"):
        armctl.move_l(panda, panda.home, target, tip_speed=-1.0)


@pytest.mark.parametrize("caps", [{"tip_speed": 0.25}, {"tip_angular_speed": 0.4}])
@pytest.mark.parametrize("oriented", [True, False])
def test_caps_on_the_tip_hold_over_the_whole_of_a_path_with_rounded_corners(panda, caps, oriented):
    targets = [moved(panda, 0, 0.1, 0), moved(panda, 0.02, 0.1, -0.1), moved(panda, 0.02, 0.0, -0.2)]
    path = [target @ armctl.Pose([0, 0, 0], rpy=[0.2 * i, 0, -0.3 * i]) for i, target in enumerate(targets)]
    motion = armctl.move_path(panda, panda.home, path if oriented else [each.position for each in path], blend=0.045, **caps)
    q, v = motion.sample(np.linspace(0.0, motion.duration, 6000))[:2]
    twists = np.array([panda.jacobian(a) @ b for a, b in zip(q, v, strict=True)])
    speeds = np.linalg.norm(twists[:, :3] if "tip_speed" in caps else twists[:, 3:], axis=1)
    cap = next(iter(caps.values()))
    assert 0.99 * cap < speeds.max() < cap * (1 + 1e-9)


def test_the_tip_speed_of_a_slow_line_is_checked_at_no_more_places_than_that_of_a_fast_one(bundled, monkeypatch):
    line = armctl.move_l(bundled, bundled.home, moved(bundled, 0.0, 0.05, 0.02).position)
    places = []
    twists = TipCaps._twists
    monkeypatch.setattr(TipCaps, "_twists", lambda caps, q, v: places.append(len(q)) or twists(caps, q, v))
    fast = TipCaps(bundled, None, (bundled.tip,), linear=1e-3, angular=np.inf).overshoot(line.pieces).max()
    slow = TipCaps(bundled, None, (bundled.tip,), linear=1e-6, angular=np.inf).overshoot(line.scaled(1e-3).pieces).max()
    assert slow == pytest.approx(fast, rel=1e-8)
    assert fast > 1
    assert places[1] == places[0]


def test_near_a_singularity_it_slows_down():
    arm = arm_of("ur5e")
    arm = arm.with_limits(replace(arm.limits, tau_max=np.full(6, np.inf)))
    q = np.array([0.3, -1.2, 1.6, -1.9, 0.08, 0.2])  # the wrist is almost straight
    way = arm.jacobian(q)[:, 4]
    start = arm.fk(q)
    target = armctl.Pose(start.position + 0.15 * np.cross([0, 0, 1.0], way[3:]) + [0.0, 0.0, 0.05], quat=start.quat)
    motion = armctl.move_l(arm, q, target)
    assert motion.check_limits().ok
    position, _ = tips(arm, motion)
    line = (target.position - start.position) / np.linalg.norm(target.position - start.position)
    away = position - start.position
    assert np.abs(away - (away @ line)[:, None] * line).max() < 5 * UM


def test_a_line_out_of_reach_says_where_and_what_helps(panda):
    with pytest.raises(
        armctl.PlanError, match=r"move_l: at \d+\.\d % of the path, tip at \[.*\] m, the arm can follow no further"
    ):
        armctl.move_l(panda, panda.home, moved(panda, 0.6, 0.2, 0.1))


@pytest.mark.parametrize(
    ("name", "stop"), [("robot_arm_3dof", "can follow no further"), ("gantry", "x would leave its limits")]
)
def test_a_line_to_a_point_that_the_tip_cannot_reach_says_so(name: str, stop: str):
    arm = arm_of(name)
    with pytest.raises(armctl.PlanError, match=rf"{stop}.*; the end of the path: out of reach by \d\.\d+ m"):
        armctl.move_l(arm, arm.home, [9.0, 0.1, 0.6])


@pytest.mark.parametrize("far", [1e160, -1e300])
def test_a_point_whose_distance_overflows_is_refused(far: float):
    arm = arm_of("robot_arm_3dof")
    with pytest.raises(armctl.InputError, match=r"target: a coordinate of 1e\+\d{3} m; use at most 1e\+09 m"):
        armctl.move_l(arm, arm.home, [far, 0.1, 0.6])
    with pytest.raises(armctl.InputError, match="via: a coordinate of"):
        armctl.move_c(arm, arm.home, [far, 0.1, 0.6], [0.3, 0.1, 0.6])
    with pytest.raises(armctl.InputError, match="target: a coordinate of"):
        armctl.move_path(arm, arm.home, [[0.3, 0.1, 0.6], [0.3, far, 0.6]])


def test_a_line_out_of_a_joint_range_names_the_joint():
    arm = arm_of("robot_arm_3dof")
    q = np.array([3.0, -0.5, -1.0])
    tip = arm.fk(q).position
    with pytest.raises(armctl.PlanError, match=r"shoulder_yaw would leave its limits \[-3.140, 3.140\] rad"):
        armctl.move_l(arm, q, [tip[0], -tip[1] - 0.1, tip[2]])


def test_a_line_that_leaves_a_joint_range_between_two_steps_of_its_inverse_kinematics_is_refused():
    arm = arm_of("planar")
    q = [0.5478467492858172, 0.7205094416569017, 0.0]  # the slide is at its limit, and passes it by 0.05 mm later
    with pytest.raises(
        armctl.PlanError, match=r"move_l: with the tip at .* position of extension would exceed its limit 0 m by"
    ):
        armctl.move_l(arm, q, [-0.8012030031755373, -0.16241188922336824, 0.3329439841281119])


def test_a_bad_start_is_refused(panda):
    with pytest.raises(armctl.LimitError, match="q_start: joint4"):
        armctl.move_l(panda, np.zeros(7) + 0.5, [0.5, 0.0, 0.5])
    with pytest.raises(armctl.InputError, match="target"):
        armctl.move_l(panda, panda.home, [0.5, 0.0])


def column(joints: int) -> str:
    """An arm that stands upright at home, stretched out: its joints turn about z, y and y in turns."""
    rod = '<geom type="capsule" size="0.02" fromto="0 0 0 0 0 {0}"/>'
    link = '<body pos="0 0 {0}"><joint axis="{1}" range="-2.5 2.5" name="j{2}"/>' + rod
    links = "".join(link.format(1.2 / joints, "0 1 0" if k % 3 else "0 0 1", k) for k in range(joints))
    motors = "".join(f'<motor joint="j{k}" ctrlrange="-99 99"/>' for k in range(joints))
    world = f"{links}<site name='tip' pos='0 0 0.1'/>{'</body>' * joints}"
    return f"<mujoco><compiler angle='radian'/><worldbody>{world}</worldbody><actuator>{motors}</actuator></mujoco>"


def test_surplus_joints_keep_the_others_inside_their_ranges_where_the_least_motion_would_not(tmp_path, monkeypatch):
    path = tmp_path / "column.xml"
    path.write_text(column(6))
    arm = armctl.load(path)
    q = np.array([1.4, -0.1, -0.4, 1.9, -2.1, 1.0])
    start = arm.fk(q).position
    target = np.array([0.49, 0.13, 0.72])
    motion = armctl.move_l(arm, q, target)
    assert motion.check_limits().ok
    offset = tips(arm, motion)[0] - start
    way = (target - start) / np.linalg.norm(target - start)
    assert np.linalg.norm(offset - np.outer(offset @ way, way), axis=1).max() < UM
    np.testing.assert_allclose(offset[-1], target - start, atol=UM)
    monkeypatch.setattr(joint_path, "_CENTERINGS", (0.0,))
    with pytest.raises(armctl.PlanError, match="would leave its limits"):
        armctl.move_l(arm, q, target)


@pytest.mark.parametrize("joints", [6, 7, 9, 12])
@pytest.mark.parametrize("ask", ["a line", "an arc", "a path", "a pose"])
def test_out_of_a_stretched_pose_a_path_keeps_the_limits_or_says_where_it_stops(tmp_path, joints: int, ask: str):
    path = tmp_path / "column.xml"
    path.write_text(column(joints))
    arm = armctl.load(path)
    via, target = arm.fk(arm.home + 0.05).position, arm.fk(arm.home + 0.1)
    try:
        assert (
            {
                "a line": lambda: armctl.move_l(arm, arm.home, target.position),
                "an arc": lambda: armctl.move_c(arm, arm.home, via, target),
                "a path": lambda: armctl.move_path(arm, arm.home, [via, target.position], blend=0.005),
                "a pose": lambda: armctl.move_l(arm, arm.home, target),
            }[ask]()
            .check_limits()
            .ok
        )
    except armctl.PlanError as error:
        where = str(error)
        assert "the arm can follow no further" in where or "would leave its limits" in where


def test_the_twist_in_a_rounded_corner_is_how_its_pose_changes():
    turns = [Pose([0, 0, 0], rpy=rpy).rotation for rpy in ([0.2, 0.1, -0.3], [1.0, -0.4, 0.3], [-0.2, 0.6, 1.4])]
    places = np.array([[0.1, 0.2, 0.3], [0.4, 0.2, 0.2], [0.3, 0.5, 0.4]])
    before = Straight(places[0], places[1], Turn.between(turns[0], turns[1]))
    after = Straight(places[1], places[2], Turn.between(turns[1], turns[2]))
    corner = Blend(before, after, 0.1)
    step = 1e-6
    for s in np.linspace(0.01, 0.19, 7):
        earlier, later = corner.at(s - step), corner.at(s + step)
        here = corner.at(s)
        assert here.twist[:3] == pytest.approx((later.position - earlier.position) / (2 * step), abs=1e-6)
        turned = rotation_vector(later.rotation @ earlier.rotation.T) / (2 * step)
        assert here.twist[3:] == pytest.approx(turned, abs=1e-6)


@pytest.fixture
def slides(tmp_path) -> armctl.Arm:
    """A ball on two slides without torque limits: 0.5 m/s, 4 m/s^2 and 80 m/s^3 along x and y."""
    path = tmp_path / "slides.xml"
    path.write_text(
        '<mujoco><worldbody><body><joint name="x" type="slide" axis="1 0 0" range="-1 1"/>'
        '<inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/><body><joint name="y" type="slide" axis="0 1 0" range="-1 1"/>'
        '<geom size="0.02" mass="1"/><site name="tip"/></body></body></worldbody>'
        '<actuator><motor joint="x" ctrlrange="-9 9"/><motor joint="y" ctrlrange="-9 9"/></actuator></mujoco>'
    )
    arm = armctl.load(path)
    both = np.ones(2)
    limits = replace(arm.limits, v_max=0.5 * both, a_max=4 * both, j_max=80 * both, tau_max=np.inf * both)
    return arm.with_limits(limits)


@pytest.mark.parametrize("diagonal", [False, True])
@pytest.mark.parametrize(
    ("way", "least"),
    [
        (1.0, 1.0 / 0.5 + 0.5 / 4 + 4 / 80),  # at full speed for a while
        (0.05, 4 / 80 + np.sqrt((4 / 80) ** 2 + 4 * 0.05 / 4)),  # at full acceleration for a while
        (0.01, np.cbrt(32 * 0.01 / 80)),  # at full jerk all the time
    ],
)
def test_a_line_along_slides_takes_the_least_time_that_speed_acceleration_and_jerk_permit(slides, way, least, diagonal):
    start = np.array([-0.5 * way, -0.5 * way if diagonal else 0.2])
    motion = armctl.move_l(slides, start, [*(start + way * np.array([1.0, float(diagonal)])), 0.0])
    assert motion.check_limits().ok
    assert least * (1 - 1e-9) < motion.duration < 1.01 * least


def test_a_section_begins_in_the_middle_of_its_rounded_corner(slides):
    """A path that is its own mirror image takes as long from either end, whichever half of it is slow."""
    start, corner, end = [-0.3, 0.0, 0.0], [0.0, 0.0, 0.0], [0.0, 0.3, 0.0]
    forward = armctl.move_path(slides, start[:2], [Line(corner), Line(end, speed=0.3)], blend=0.1)
    backward = armctl.move_path(slides, end[:2], [Line(corner, speed=0.3), Line(start)], blend=0.1)
    assert forward.duration == pytest.approx(backward.duration, rel=1e-4)
    assert forward.duration > 1.5 * armctl.move_path(slides, start[:2], [corner, end], blend=0.1).duration


@pytest.mark.parametrize("angle", [45, 90, 120, 150, 170, 180])
@pytest.mark.parametrize("radius", [0.005, 0.02, 0.05])
@pytest.mark.parametrize("legs", [0.1, 0.3])
def test_a_rounded_corner_never_takes_longer_than_a_stop(slides, angle, radius, legs):
    turned = np.deg2rad(angle)
    corner = np.array([legs, 0.0, 0.0])
    path = [corner, corner + legs * np.array([np.cos(turned), np.sin(turned), 0.0])]
    plain = armctl.move_path(slides, [0.0, 0.0], path)
    motion = armctl.move_path(slides, [0.0, 0.0], path, blend=radius)
    assert motion.duration <= plain.duration * (1 + 1e-9)
    assert angle > 45 or motion.duration < 0.98 * plain.duration
    assert motion.check_limits().ok
    position, _ = tips(slides, motion, 4000)
    sides = [to_segment(position, a, b) for a, b in pairwise([np.zeros(3), *path])]
    away = np.linalg.norm(position - corner, axis=1)
    assert np.min(sides, axis=0)[away > radius + UM].max() < 5 * UM
    assert away.min() < radius
    assert np.allclose(position[-1], path[-1], atol=UM)


@pytest.mark.parametrize("name", ["six joints", "redundant"])
def test_blends_of_a_path_there_and_back_never_take_longer_than_none(tmp_path, name):
    arm = serial_arm(tmp_path, replace(BENT[name], range="-3 3"))
    home = arm.fk(arm.home)
    away = armctl.Pose(np.add(home.position, [-0.06, 0.04, -0.05]), quat=home.quat)
    path = [away, home, away, home]
    plain = armctl.move_path(arm, arm.home, path).duration
    for radius in (0.002, 0.01, 0.03):
        motion = armctl.move_path(arm, arm.home, path, blend=radius)
        assert motion.duration <= plain * (1 + 1e-9)
        assert motion.check_limits().ok
        assert armctl.check_torque(arm, motion).ok


def test_a_path_stops_at_its_sharp_corners_only(slides):
    """Three right angles and, between them, a way into a slot and back."""
    corners = [[0.3, 0.0, 0.0], [0.3, 0.3, 0.0], [0.3, 0.31, 0.0], [0.3, 0.3, 0.0], [0.0, 0.3, 0.0], [0.0, 0.0, 0.0]]
    path = [Line(corner, blend=0.0 if k in (1, 3) else 0.005) for k, corner in enumerate(corners)]
    motion = armctl.move_path(slides, [0.0, 0.0], path)
    position, _ = tips(slides, motion, 20_000)
    speed = np.linalg.norm(np.diff(position, axis=0), axis=1)
    slot = np.linalg.norm(position - corners[2], axis=1)
    first = np.linalg.norm(position - corners[0], axis=1)
    assert slot.min() < UM
    assert speed[int(slot.argmin()) - 1 : int(slot.argmin()) + 1].max() < 1e-3 * speed.max()
    assert first.min() > 1e-4
    assert speed[int(first.argmin())] > 0.05 * speed.max()
    assert motion.duration < armctl.move_path(slides, [0.0, 0.0], corners).duration

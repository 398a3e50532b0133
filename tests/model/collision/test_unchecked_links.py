"""Links that carry mass and have no collision shape: no contact of the arm is excluded until they get one."""

import math
import warnings
from pathlib import Path

import mujoco
import numpy as np
import pytest
from arms import ARMS_WITH_SHAPES, arm_of, some_of
from collidable import mjcf as collidable
from synthetic import limb, mjcf, motors

import armctl
from armctl.lab.diagnose import diagnose
from armctl.model.loading.link_shapes import is_inside

AXES = ("0 0 1", "0 1 0", "0 1 0", "0 0 1", "0 1 0", "0 0 1")
INERTIAL = (
    '<inertial><origin xyz="0 0 0.1"/><mass value="{mass}"/>'
    '<inertia ixx="0.02" iyy="0.02" izz="0.004" ixy="0" ixz="0" iyz="0"/></inertial>'
)
GEOMETRY = '<{0}><origin xyz="0 0 0.1"/><geometry><cylinder radius="0.04" length="0.2"/></geometry></{0}>'
LOST = '<collision><geometry><mesh filename="package://robot/meshes/{}.{}"/></geometry></collision>'


def write_urdf(path: Path, shapes: list[str], mass: float = 2.0) -> Path:
    """An arm of six links in series, 0.2 m each, with a line of shapes for each link; no inertials if the mass is 0."""
    inertial = INERTIAL.format(mass=mass) if mass else ""
    text = '<link name="base"/>'
    below = "base"
    for i, (axis, shape) in enumerate(zip(AXES, shapes, strict=True)):
        text += (
            f'<link name="link{i}">{inertial}{shape}</link><joint name="j{i}" type="revolute"><parent link="{below}"/>'
            f'<child link="link{i}"/><origin xyz="0 0 0.2"/><axis xyz="{axis}"/>'
            '<limit lower="-2.5" upper="2.5" effort="150" velocity="2"/></joint>'
        )
        below = f"link{i}"
    tool = f'<link name="tool0"/><joint name="t" type="fixed"><parent link="{below}"/><child link="tool0"/>'
    path.write_text(f'<robot name="r">{text}{tool}<origin xyz="0 0 0.2"/></joint></robot>')
    return path


def quietly(*arguments, **options) -> armctl.Arm:
    with warnings.catch_warnings(action="ignore", category=armctl.ArmctlWarning):
        return armctl.load(*arguments, **options)


def table() -> armctl.World:
    return armctl.World().add("table", armctl.Box([0.6, 0.6, 0.02]), [0.5, 0, 0.3])


def test_an_arm_whose_meshes_are_all_missing_is_nowhere_proved(tmp_path):
    path = write_urdf(tmp_path / "r.urdf", [LOST.format(i, "stl") for i in range(6)])
    with pytest.warns(armctl.MissingShapeWarning, match='no collision shape for link0, .* 2 more.*shapes="capsules"'):
        arm = quietly_but_shapes(path, scene=table())
    assert arm.unchecked_links == tuple(f"link{i}" for i in range(6))
    check = armctl.check_clearance(arm, armctl.move_j(arm, arm.home, arm.home + 0.2))
    assert not check.ok
    assert "link0" in check.reason
    assert math.isnan(check.distance)
    below = armctl.Simulation(arm).move_to([0.5, 0.1, 0.1])
    assert not below.ok
    assert below.reason.startswith("not checkable: link0")
    with pytest.raises(armctl.ModelError, match="not checkable: link0"):
        armctl.move_free(arm, arm.home, arm.home + 0.2)
    with pytest.raises(armctl.ModelError, match="not checkable: link0"):
        armctl.solve_ik(arm, [0.5, 0.1, 0.5], avoid=True)
    with pytest.raises(armctl.ModelError, match="not checkable: link0"):
        armctl.Stream(arm, arm.home, avoid=True)
    for design in (lambda: armctl.excitation(arm, for_="frequency"), lambda: armctl.calibration_poses(arm)):
        with pytest.raises(armctl.ModelError, match="not checkable: link0"):
            design()
    with pytest.raises(armctl.ModelError, match=r"not checkable: link0.*allow_contact=True"):
        armctl.Robot(arm, armctl.DryRun(armctl.links.PlantLink(arm)))


def quietly_but_shapes(*arguments, **options) -> armctl.Arm:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", armctl.ArmctlWarning)
        warnings.simplefilter("always", armctl.MissingShapeWarning)
        return armctl.load(*arguments, **options)


def test_a_robot_that_may_touch_moves_an_arm_without_shapes_only_if_nothing_is_to_be_avoided(tmp_path, capsys):
    arm = quietly(write_urdf(tmp_path / "r.urdf", [""] * 6))
    with armctl.Robot(arm, armctl.DryRun(armctl.links.PlantLink(arm)), allow_contact=True) as robot:
        assert not robot.move_j(arm.home + 0.2)
        result = robot.move_j(arm.home + 0.2, avoid=False)
    assert result.ok
    assert "contacts are not checkable" in capsys.readouterr().out


def test_nothing_is_proved_of_a_design_for_an_arm_without_shapes_that_is_alone(tmp_path):
    arm = quietly(write_urdf(tmp_path / "r.urdf", [""] * 6))
    assert math.isnan(armctl.excitation(arm, for_="frequency").clearance)
    assert math.isnan(armctl.calibration_poses(arm).clearance)


@pytest.mark.parametrize("missing", [(0,), (5,), (1, 3), (0, 1, 2, 3)])
@pytest.mark.parametrize("lost", [LOST.format("x", "stl"), LOST.format("x", "dae"), "", GEOMETRY.format("visual")])
def test_some_links_without_a_shape_are_named(tmp_path, missing, lost):
    shapes = [lost if i in missing else GEOMETRY.format("collision") for i in range(6)]
    arm = quietly(write_urdf(tmp_path / "r.urdf", shapes))
    assert arm.unchecked_links == tuple(f"link{i}" for i in missing)
    check = armctl.check_clearance(arm, armctl.move_j(arm, arm.home, arm.home + 0.1))
    assert not check.ok
    assert all(f"link{i}" in check.reason for i in missing)


def test_a_link_that_lost_one_of_two_meshes_is_named(tmp_path):
    both = GEOMETRY.format("collision") + LOST.format("half", "stl")
    arm = quietly(write_urdf(tmp_path / "r.urdf", [both, *[GEOMETRY.format("collision")] * 5]))
    assert arm.unchecked_links == ("link0",)


@pytest.mark.parametrize("shape", [LOST.format("x", "stl"), GEOMETRY.format("visual")])
def test_a_link_without_a_mass_in_the_file_is_named_if_the_file_draws_it(tmp_path, shape):
    shapes = [shape, *[GEOMETRY.format("collision")] * 5]
    assert quietly(write_urdf(tmp_path / "r.urdf", shapes, mass=0.0)).unchecked_links == ("link0",)


def test_a_frame_without_mass_needs_no_shape(tmp_path):
    shapes = ["", "", *[GEOMETRY.format("collision")] * 4]
    assert quietly(write_urdf(tmp_path / "r.urdf", shapes, mass=0.0)).unchecked_links == ()


BITS = 'contype="0" conaffinity="0"'
CAPSULE = f'<geom type="capsule" fromto="0 0 0 0.1 0 0.1" size="0.02" mass="0.5" {BITS}/>'
MASS = '<inertial pos="0.05 0 0.05" mass="1" diaginertia="0.01 0.01 0.01"/>'
THREE = limb("a b c")
FORMS = {
    "no geoms": mjcf(THREE.replace(CAPSULE, MASS), motors("a b c")),
    "no bits": mjcf(THREE, motors("a b c")),
    "no contacts": mjcf(THREE.replace(BITS, ""), motors("a b c") + '<option><flag contact="disable"/></option>'),
    "no constraints": mjcf(THREE.replace(BITS, ""), motors("a b c") + '<option><flag constraint="disable"/></option>'),
}


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("kind", ["file", "spec", "model"])
def test_all_forms_of_an_mjcf_without_shapes_are_refused(tmp_path, form, kind):
    robot = tmp_path / "r.xml"
    robot.write_text(FORMS[form])
    if kind == "spec":
        robot = mujoco.MjSpec.from_file(str(robot))
    elif kind == "model":
        robot = mujoco.MjModel.from_xml_path(str(robot))
    arm = quietly(robot)
    assert arm.unchecked_links == ("A", "B", "C")
    assert not armctl.check_clearance(arm, armctl.move_j(arm, arm.home, arm.home + 0.1))
    diagnosis = diagnose(robot)
    assert not diagnosis.ok
    assert "no collision shape for A, B and C" in diagnosis.reason


def test_a_hand_without_a_shape_at_the_last_link_is_named(tmp_path):
    path = tmp_path / "r.xml"
    box = '<geom type="box" size="0.05 0.05 0.05" mass="0.5" contype="0" conaffinity="0"/>'
    hand = f'<body name="hand" pos="0 0 0.15">{box}</body>'
    path.write_text(collidable().replace('<site name="tip"', hand + '<site name="tip"'))
    arm = quietly(path)
    assert arm.unchecked_links == ("hand",)
    assert "hand has no collision shape" in armctl.check_clearance(arm, armctl.move_j(arm, arm.home, arm.home + 0.1)).reason


@pytest.mark.parametrize(("radius", "outside"), [(0.035, ()), (0.05, ("inner",))])
def test_a_link_needs_no_shape_if_its_gyration_is_inside_of_its_neighbors(tmp_path, radius, outside):
    """A ball inside a ball of 25 mm, 4 mm off its center: the standard deviation is radius / sqrt(5), 15.7 and 22.4 mm."""
    text = (
        '<body name="outer"><joint name="a" axis="0 0 1" range="-2 2"/><geom size="0.025" mass="1"/>'
        '<body name="inner"><joint name="b" axis="1 0 0" range="-2 2"/>'
        f'<geom size="{radius}" pos="0 0 0.004" mass="0.3" contype="0" conaffinity="0"/>'
        '<body name="last"><joint name="c" axis="0 1 0" range="-2 2"/><geom size="0.01" pos="0 0 0.2" mass="1"/></body>'
        "</body></body>"
    )
    path = tmp_path / "r.xml"
    path.write_text(mjcf(text, motors("a b c")))
    assert quietly(path).unchecked_links == outside


def test_the_inside_of_each_shape_is_where_a_small_ball_of_mujoco_overlaps_it(tmp_path):
    """MuJoCo's distance between a tiny ball and a geom is not positive where the ball's center is inside."""
    things = (
        '<geom type="box" size="0.3 0.2 0.1"/><geom type="cylinder" size="0.2 0.3"/><geom type="ellipsoid" size="0.3 0.2 0.1"/>'
        '<geom type="sphere" size="0.25"/><geom type="capsule" size="0.15 0.2"/><geom type="mesh" mesh="rock"/>'
    )
    rng = np.random.default_rng(3)
    rock = " ".join(f"{x:.4f}" for x in rng.uniform(-0.3, 0.3, 3 * 40))
    probe = '<body name="probe" mocap="true"><geom name="probe" size="1e-6"/></body>'
    model = mujoco.MjModel.from_xml_string(
        f'<mujoco><asset><mesh name="rock" vertex="{rock}"/></asset><worldbody>{things}{probe}</worldbody></mujoco>'
    )
    data = mujoco.MjData(model)
    ball = model.geom("probe").id
    line = np.zeros(6)
    points = rng.uniform(-0.35, 0.35, (300, 3))
    found = {geom: [] for geom in range(6)}
    for point in points:
        data.mocap_pos[0] = point
        mujoco.mj_kinematics(model, data)
        for geom in found:
            found[geom].append(mujoco.mj_geomDistance(model, data, geom, ball, 1.0, line) <= 0.0)
    for geom, overlaps in found.items():
        local = (points - data.geom_xpos[geom]) @ data.geom_xmat[geom].reshape(3, 3)
        assert is_inside(model, geom, local).tolist() == overlaps
        assert 5 < sum(overlaps) < 200


def test_capsules_along_the_links_reach_from_joint_to_joint(tmp_path):
    path = write_urdf(tmp_path / "r.urdf", [LOST.format(i, "stl") for i in range(6)])
    arm = quietly(path, shapes="capsules", scene=table())
    assert any(note.startswith("capsules along link0, link1") for note in arm.notes)
    assert arm.unchecked_links == ()
    bare = quietly(path)
    data = mujoco.MjData(arm.model)
    data.qpos[:] = arm.home_qpos
    mujoco.mj_forward(arm.model, data)
    for i in range(6):
        geoms = np.flatnonzero(arm.model.geom_bodyid == arm.model.body(f"link{i}").id)
        assert len(geoms) > 0
        above = arm.model.body(f"link{i + 1}").id if i < 5 else arm.model.body("tool0").id
        for place in (data.body(f"link{i}").xpos, data.xpos[above]):
            local = [(place - data.geom_xpos[g]) @ data.geom_xmat[g].reshape(3, 3) for g in geoms]
            assert any(is_inside(arm.model, int(g), x[None])[0] for g, x in zip(geoms, local, strict=True))
    assert arm.mass_matrix(arm.home) == pytest.approx(bare.mass_matrix(bare.home), rel=1e-12)
    result = armctl.Simulation(arm).move_to([0.5, 0.1, 0.3])  # the middle of the table
    assert not result.ok
    assert "inside table" in result.reason
    free = armctl.move_free(arm, arm.home, arm.home + np.array([1.0, -0.3, 0.2, 0.1, 0.1, 0.1]))
    assert armctl.check_clearance(arm, free).ok


def test_visual_geoms_serve_where_the_shapes_for_collisions_cannot_be_read(tmp_path):
    shapes = [LOST.format(i, "stl") + GEOMETRY.format("visual") for i in range(6)]
    path = write_urdf(tmp_path / "r.urdf", shapes)
    with pytest.warns(armctl.MissingShapeWarning, match='shapes="visual" takes their visual geoms'):
        quietly_but_shapes(path)
    arm = quietly(path, shapes="visual")
    assert arm.unchecked_links == ()
    assert (arm.model.geom_type == int(mujoco.mjtGeom.mjGEOM_CYLINDER)).sum() == 6
    given = quietly(write_urdf(tmp_path / "given.urdf", [GEOMETRY.format("collision")] * 6))
    motion = armctl.move_j(arm, arm.home, arm.home + 0.3)
    assert armctl.check_clearance(arm, motion).distance == armctl.check_clearance(given, motion).distance


def test_visual_geoms_that_are_not_there_leave_the_arm_unchecked(tmp_path):
    arm = quietly(write_urdf(tmp_path / "r.urdf", [""] * 6), shapes="visual")
    assert len(arm.unchecked_links) == 6


def test_shapes_are_added_by_name_only(tmp_path):
    path = write_urdf(tmp_path / "r.urdf", [""] * 6)
    with pytest.raises(armctl.InputError, match="shapes: expected one of capsules, visual, got 'boxes'"):
        armctl.load(path, shapes="boxes")
    path = tmp_path / "r.xml"
    path.write_text(FORMS["no bits"])
    with pytest.raises(armctl.InputError, match="shapes: a compiled MjModel cannot be changed"):
        armctl.load(mujoco.MjModel.from_xml_path(str(path)), shapes="capsules")


def test_a_simulation_without_obstacles_moves_an_arm_without_shapes_and_says_so(tmp_path):
    path = tmp_path / "r.xml"
    path.write_text(FORMS["no bits"])
    arm = quietly(path)
    result = armctl.Simulation(arm).move_j(arm.home + 0.1)
    assert result.ok
    assert result.unchecked_links == ("A", "B", "C")
    assert "contacts not checkable, no collision shape for A, B and C" in str(result)
    floor = quietly(path, scene=armctl.World().add("floor", armctl.Box([1, 1, 0.1]), [0, 0, -1]))
    assert "not checkable" in armctl.Simulation(floor).move_j(arm.home + 0.1).reason


def test_a_payload_needs_no_shape(tmp_path):
    path = tmp_path / "r.xml"
    path.write_text(collidable())
    assert quietly(path).with_payload(1.0, [0, 0, 0.3]).unchecked_links == ()


def test_things_of_a_scene_collide_with_shapes_of_other_bits(tmp_path):
    """Links with contype 2 meet no geom of MuJoCo's default bits; MuJoCo finds the contact with a thing of a Scene."""
    path = tmp_path / "r.xml"
    path.write_text(collidable("").replace('mass="1"/>', 'mass="1" contype="2" conaffinity="2"/>'))
    arm = quietly(path, scene=armctl.World().add("wall", armctl.Box([0.2, 0.2, 0.2]), [0, 0, 0.9]))
    data = mujoco.MjData(arm.model)
    data.qpos[:] = arm.qpos(np.zeros(6))
    mujoco.mj_forward(arm.model, data)
    wall = arm.model.body("wall").id
    assert any(wall in arm.model.geom_bodyid[contact.geom] for contact in data.contact)
    assert not armctl.check_clearance(arm, armctl.move_j(arm, np.zeros(6), np.full(6, 0.1)))


@pytest.mark.parametrize("name", some_of(ARMS_WITH_SHAPES))
def test_the_links_of_an_installed_arm_have_shapes(name):
    assert arm_of(name).unchecked_links == ()

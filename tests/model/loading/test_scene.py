"""Scenes: what stands and lies around a robot, known to the simulation and to inverse kinematics."""

import warnings
from pathlib import Path

import mujoco
import numpy as np
import pytest
from synthetic import limb, mjcf, motors

import armctl


def test_what_has_a_mass_is_loose_and_the_rest_stands(load):
    scene = (
        armctl.World()
        .add("table", armctl.Box([1, 1, 0.1]), [0, 0, -0.05])
        .add("ball", armctl.Ball(0.03), [0.3, 0.2, 0.5], mass=0.2)
    )
    scene.add("can", armctl.Cylinder(0.03, 0.1), armctl.Pose([-0.3, 0.2, 0.3], rpy=[0, 0, 1]), mass=0.3)
    arm = load(limb("a b"), motors("a b"), scene=scene)
    assert arm.n == 2
    assert arm.model.body("ball").mass == pytest.approx([0.2])
    assert arm.model.geom("can").size == pytest.approx([0.03, 0.05, 0])
    sim = armctl.Simulation(arm)
    sim.run(armctl.move_j(arm, arm.home, arm.home), dwell=1.0)
    assert sim.data.body("ball").xpos[2] == pytest.approx(0.03, abs=1e-3)
    assert sim.data.body("can").xpos[2] == pytest.approx(0.05, abs=1e-3)


def test_a_scene_changes_nothing_about_the_arm(load):
    rest = motors("a b") + '<keyframe><key name="home" qpos="0.3 0.4" ctrl="1 2"/></keyframe>'
    alone = load(limb("a b"), rest)
    arm = load(limb("a b"), rest, scene=armctl.World().add("ball", armctl.Ball(0.03), [2, 0, 1], mass=0.2))
    assert np.array_equal(arm.home, alone.home)
    assert arm.limits.tau_max == pytest.approx(alone.limits.tau_max)
    assert np.allclose(arm.jacobian(arm.home), alone.jacobian(alone.home))
    log = armctl.simulate(arm, "computed-torque", armctl.move_j(arm, arm.home, arm.home + 0.3))
    assert np.abs(log.q - log.q_ref).max() < 1e-9


def test_inverse_kinematics_keeps_clear_of_the_scene(bundled: armctl.Arm):
    target = bundled.fk([0.4, 0.5, -0.6]).position
    wall = armctl.World().add("wall", armctl.Box([0.06, 0.06, 0.06]), target)
    arm = armctl.load(bundled.name, scene=wall)
    assert armctl.solve_ik(arm, target).ok
    assert not armctl.solve_ik(arm, target, avoid=True).ok


WRONG = {
    "no name": (lambda s: s.add("", armctl.Box([1, 1, 1]), [0, 0, 0]), "name: '' is empty; give the body a name"),
    "flat": (
        lambda s: s.add("a", armctl.Box([1, 0, 1]), [0, 0, 0]),
        "size: expected a length from 1e-06 m to 10000 m, got 0",
    ),
    "no radius": (
        lambda s: s.add("a", armctl.Ball(-1), [0, 0, 0]),
        "radius: expected a length from 1e-06 m to 10000 m, got -1",
    ),
    "weightless": (lambda s: s.add("a", armctl.Ball(1), [0, 0, 0], mass=0), "mass: expected a number at least 1e-06, got 0"),
    "nowhere": (lambda s: s.add("a", armctl.Ball(1), [0, 0]), "at: expected 3 numbers, got 2"),
}


@pytest.mark.parametrize("what", WRONG)
def test_a_wrong_thing_is_refused(what: str):
    add, sentence = WRONG[what]
    with pytest.raises(armctl.InputError, match=sentence):
        add(armctl.World())


def test_a_name_of_the_robot_is_taken(load):
    with pytest.raises(armctl.InputError, match="scene: the model has a body 'A' already; choose another name"):
        load(limb("a b"), motors("a b"), scene=armctl.World().add("A", armctl.Box([1, 1, 1]), [5, 0, 0]))
    with pytest.raises(armctl.InputError, match="scene: the model has a geom 'floor' already; choose another name"):
        load(
            limb("a b") + '<geom name="floor" type="plane" size="1 1 1" pos="0 0 -1"/>',
            motors("a b"),
            scene=armctl.World().add("floor", armctl.Box([1, 1, 1]), [5, 0, 0]),
        )


def test_a_scene_can_be_used_twice(load):
    scene = armctl.World().add("box", armctl.Box([0.1, 0.1, 0.1]), [1, 0, 0])
    models = [load(limb("a b"), motors("a b"), scene=scene).model for _ in range(2)]
    assert [mujoco.mj_name2id(m, mujoco.mjtObj.mjOBJ_BODY, "box") > 0 for m in models] == [True, True]


CELL = """<mujoco model="cell"><compiler angle="degree"/><option timestep="0.01" gravity="0 0 -5"/>
<default><default class="red"><geom rgba="1 0 0 1"/></default></default>
<asset><texture name="grid" type="2d" builtin="checker" width="9" height="9"/><material name="grid" texture="grid"/></asset>
<worldbody><geom name="floor" type="plane" size="1 1 1" material="grid"/>
<body name="table" pos="0.6 0 0.1"><geom name="top" type="box" size="0.2 0.2 0.1"/></body>
<body name="cube" pos="0.6 0 0.22" euler="0 0 90"><freejoint/>
<geom class="red" type="box" size="0.02 0.02 0.02" mass="0.1"/></body>
<body name="door" pos="2 0 1"><joint name="hinge" range="0 45"/>
<geom name="panel" type="box" size="0.5 0.02 1"/></body></worldbody>
<contact><exclude body1="table" body2="door"/><pair geom1="panel" geom2="top"/></contact>
<equality><joint joint1="hinge"/></equality><sensor><jointpos joint="hinge"/></sensor>
<keyframe><key name="home" qpos="9 9 9 1 0 0 0 0"/></keyframe></mujoco>"""
ROOM = '<geom name="floor" type="plane" size="1 1 1" material="grid" pos="0 0 -1"/>' + limb("a b")
ASSETS = (
    '<asset><texture name="grid" type="2d" builtin="flat" width="9" height="9"/><material name="grid" texture="grid"/></asset>'
    '<default><default class="red"><geom rgba="0 1 0 1"/></default></default>'
)


@pytest.fixture
def cell(tmp_path: Path) -> Path:
    """A table with a cube on it and a door, as a file."""
    path = tmp_path / "cell.xml"
    path.write_text(CELL)
    return path


def test_a_scene_can_be_a_file(load, cell: Path):
    model = load(ROOM, ASSETS + motors("a b"), scene=cell).model
    assert model.body("cube").pos == pytest.approx([0.6, 0, 0.22])
    assert model.body("cube").quat == pytest.approx([0.5**0.5, 0, 0, 0.5**0.5])
    assert model.joint("hinge").range == pytest.approx([0, np.pi / 4])
    assert (model.nexclude, model.npair, model.neq, model.nsensor, model.nkey) == (1, 1, 1, 0, 0)
    assert model.opt.gravity[2] == -9.81
    assert model.opt.timestep == 1e-3  # something is loose
    assert model.geom("floor").pos[2] == -1  # the robot's own keeps its name
    assert model.geom("cell/floor").pos[2] == 0


def test_a_file_and_the_same_things_added_hold_the_same_scene(load, cell: Path):
    added = armctl.World().add("table", armctl.Box([0.4, 0.4, 0.2]), [0.6, 0, 0.1])
    added.add("cube", armctl.Box([0.04] * 3), armctl.Pose([0.6, 0, 0.22], rpy=[0, 0, np.pi / 2]), mass=0.1)
    mine = load(limb("a b"), motors("a b"), scene=added).model
    theirs = load(limb("a b"), motors("a b"), scene=cell).model
    for body in ("table", "cube"):
        first = mine.body(body)
        second = theirs.body(body)
        assert np.allclose([*first.pos, *first.quat, *first.inertia], [*second.pos, *second.quat, *second.inertia])
        one = int(mine.body_geomadr[mine.body(body).id])
        other = int(theirs.body_geomadr[theirs.body(body).id])
        for what in ("geom_size", "geom_solref", "geom_solimp", "geom_condim", "geom_priority"):
            assert np.array_equal(getattr(mine, what)[one], getattr(theirs, what)[other]), what
    assert (mine.opt.cone, mine.opt.impratio) == (theirs.opt.cone, theirs.opt.impratio)


def test_more_can_be_added_to_a_file_and_it_can_be_used_twice(load, cell: Path):
    scene = [cell, armctl.World().add("post", armctl.Box([0.1, 0.1, 1]), [1, 1, 0.5])]
    for _ in range(2):
        model = load(limb("a b"), motors("a b"), scene=scene).model
        assert {"table", "cube", "post"} <= {model.body(i).name for i in range(model.nbody)}
    with pytest.raises(armctl.InputError, match="scene: the model has a body 'cube' already; choose another name"):
        load(limb("a b"), motors("a b"), scene=[cell, armctl.World().add("cube", armctl.Box([1, 1, 1]), [5, 0, 0])])
    with pytest.raises(armctl.InputError, match="scene: the model has a body 'table' already; choose another name"):
        load(limb("a b").replace('name="A"', 'name="table"'), motors("a b"), scene=cell)


def test_inverse_kinematics_keeps_clear_of_a_file(bundled: armctl.Arm, tmp_path: Path):
    target = bundled.fk([0.4, 0.5, -0.6]).position
    place = " ".join(map(str, target))
    (tmp_path / "wall.xml").write_text(
        f'<mujoco><worldbody><body pos="{place}"><geom type="box" size="0.03 0.03 0.03"/></body></worldbody></mujoco>'
    )
    arm = armctl.load(bundled.name, scene=tmp_path / "wall.xml")
    assert armctl.solve_ik(arm, target).ok
    assert not armctl.solve_ik(arm, target, avoid=True).ok


FILES = {
    "a robot": (
        '<mujoco><worldbody><body><joint name="a"/><geom size="1"/></body></worldbody>'
        '<actuator><motor name="m" joint="a"/></actuator></mujoco>',
        "a robot.xml has the actuator 'm', so it is a robot; a scene has only bodies, geoms and joints",
    ),
    "no MJCF": ("not XML at all", r"no MJCF\.xml: MuJoCo cannot read it: no well-formed XML"),
    "nonsense": (
        '<mujoco><worldbody><geom type="blob"/></worldbody></mujoco>',
        "MuJoCo cannot read it: .*invalid keyword: 'blob'",
    ),
}


@pytest.mark.parametrize("what", FILES)
def test_a_file_that_is_no_scene_says_why(bundled: armctl.Arm, tmp_path: Path, what: str):
    text, sentence = FILES[what]
    path = tmp_path / f"{what}.xml"
    path.write_text(text)
    with pytest.raises(armctl.ModelError, match=sentence):
        armctl.load(bundled.name, scene=path)
    with pytest.raises(armctl.ModelError, match=r"scene: .*nowhere\.xml: no such file"):
        armctl.load(bundled.name, scene=tmp_path / "nowhere.xml")


HALL = (
    '<mujoco model="hall"><worldbody><geom name="floor" type="plane" size="3 3 0.1" pos="0 0 {height}"/></worldbody></mujoco>'
)
TURRET = """<mujoco><compiler angle="radian"/><worldbody><body name="base"><geom type="box" size="0.1 0.1 0.02" mass="1"/>
<body name="turret"><joint name="pan" axis="0 0 1" range="-2 2" damping="1"/><geom type="sphere" size="0.08" pos="0.2 0 0.06"/>
<body name="arm" pos="0 0 0.1"><joint name="lift" axis="0 1 0" range="-1 0.6" damping="1"/>
<geom type="capsule" fromto="0 0 0 0.5 0 0" size="0.03"/></body></body></body></worldbody>
<actuator><motor joint="pan" ctrlrange="-50 50"/><motor joint="lift" ctrlrange="-50 50"/></actuator></mujoco>"""


def in_hall(tmp_path, scene):
    path = tmp_path / "turret.xml"
    path.write_text(TURRET)
    return armctl.load(path, scene=scene)


def test_a_table_under_the_base_that_a_link_cuts_wherever_the_arm_is_gives_a_warning_and_no_force(tmp_path):
    table = armctl.World().add("table", armctl.Box([1.0, 1.0, 0.1]), at=[0.0, 0.0, -0.05])
    with pytest.warns(armctl.ArmctlWarning, match="table overlaps with turret wherever the arm is; their contact is left out"):
        in_hall(tmp_path, table)


def test_an_object_above_the_base_keeps_its_contact_though_no_motion_avoids_it(tmp_path):
    crate = armctl.World().add("crate", armctl.Box([1.0, 1.0, 0.2]), at=[0.0, 0.0, 0.05])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        arm = in_hall(tmp_path, crate)
    log = armctl.simulate(arm, "pd", armctl.move_j(arm, [0, 0], [0, 0]))
    assert "turret" in {contact.body for contact in log.contacts}


def test_a_floor_that_a_link_cuts_wherever_the_arm_is_gives_a_warning_and_no_force(tmp_path):
    scene = tmp_path / "hall.xml"
    scene.write_text(HALL.format(height=0))
    with pytest.warns(armctl.ArmctlWarning, match="world overlaps with turret wherever the arm is; their contact is left out"):
        arm = in_hall(tmp_path, scene)
    down = armctl.move_j(arm, arm.home, [0.5, 0.5])
    log = armctl.simulate(arm, "computed-torque", down)
    assert {contact.body for contact in log.contacts} == {"arm"}  # the other link still meets the floor


def test_a_box_that_only_some_configurations_cut_keeps_its_contact(tmp_path):
    scene = armctl.World().add("box", armctl.Box([0.1, 0.1, 0.1]), at=[0.2, 0.0, 0.05])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        arm = in_hall(tmp_path, scene)
    log = armctl.simulate(arm, "pd", armctl.move_j(arm, [0, 0], [0, 0]))
    assert "turret" in {contact.body for contact in log.contacts}


@pytest.mark.full
@pytest.mark.parametrize("count", [1500, 4000, pytest.param(10_000, marks=pytest.mark.nightly)])
def test_an_arm_among_thousands_of_things_loads_and_mujoco_steps_it(tmp_path, count):
    """MuJoCo reserves memory for all pairs of bodies; the default is too little from 1900 on."""
    scene = armctl.World()
    for i in range(count):
        scene.add(f"ball{i}", armctl.Ball(0.01), [1.0 + 0.03 * (i % 100), 0.03 * (i // 100), 0.5])
    path = tmp_path / "r.xml"
    path.write_text(mjcf(limb("a b").replace('contype="0" conaffinity="0"', ""), motors("a b")))
    arm = armctl.load(path, scene=scene)
    assert arm.model.ngeom == count + 3  # two links and the target
    data = mujoco.MjData(arm.model)
    mujoco.mj_step(arm.model, data)
    assert data.maxuse_arena < arm.model.narena


def test_a_compiled_model_with_too_little_memory_is_refused_in_one_sentence():
    spec = mujoco.MjSpec.from_string(mjcf(limb("a b").replace('contype="0" conaffinity="0"', ""), motors("a b")))
    for i in range(4000):
        spec.worldbody.add_body(pos=[1.0 + i, 0, 0]).add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[0.01, 0, 0])
    with pytest.raises(armctl.ModelError, match=r'400[0-9] bodies and .* MB of memory.*<size memory="7[0-9]M"/>'):
        armctl.load(spec.compile())

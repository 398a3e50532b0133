"""Scenes: what stands and lies around a robot, known to the simulation and to inverse kinematics."""

import mujoco
import numpy as np
import pytest
from test_chain import limb, load, motors  # noqa: F401

import armctl


def test_what_has_a_mass_is_loose_and_the_rest_stands(load):  # noqa: F811
    scene = armctl.Scene().add_box("table", [1, 1, 0.1], [0, 0, -0.05]).add_ball("ball", 0.03, [0.3, 0.2, 0.5], mass=0.2)
    scene.add_cylinder("can", 0.03, 0.1, armctl.Pose([-0.3, 0.2, 0.3], rpy=[0, 0, 1]), mass=0.3)
    arm = load(limb("a b"), motors("a b"), scene=scene)
    assert arm.n == 2
    assert arm.model.body("ball").mass == pytest.approx([0.2])
    assert arm.model.geom("can").size == pytest.approx([0.03, 0.05, 0])
    sim = armctl.Simulation(arm)
    sim.run(armctl.move_j(arm, arm.home, arm.home), settle=1.0)
    assert sim.data.body("ball").xpos[2] == pytest.approx(0.03, abs=1e-3)
    assert sim.data.body("can").xpos[2] == pytest.approx(0.05, abs=1e-3)


def test_a_scene_changes_nothing_about_the_arm(load):  # noqa: F811
    rest = motors("a b") + '<keyframe><key name="home" qpos="0.3 0.4" ctrl="1 2"/></keyframe>'
    alone = load(limb("a b"), rest)
    arm = load(limb("a b"), rest, scene=armctl.Scene().add_ball("ball", 0.03, [2, 0, 1], mass=0.2))
    assert np.array_equal(arm.home, alone.home)
    assert arm.limits.tau_max == pytest.approx(alone.limits.tau_max)
    assert np.allclose(arm.jacobian(arm.home), alone.jacobian(alone.home))
    log = armctl.simulate(arm, "computed-torque", armctl.move_j(arm, arm.home, arm.home + 0.3))
    assert np.abs(log.q - log.q_ref).max() < 1e-9


def test_inverse_kinematics_keeps_clear_of_the_scene(bundled: armctl.Arm):
    target = bundled.fk([0.4, 0.5, -0.6]).position
    wall = armctl.Scene().add_box("wall", [0.06, 0.06, 0.06], target)
    arm = armctl.load(bundled.name, scene=wall)
    assert armctl.solve_ik(arm, target).ok
    assert not armctl.solve_ik(arm, target, avoid_collisions=True).ok


WRONG = {
    "twice": (
        lambda s: s.add_box("a", [1, 1, 1], [0, 0, 0]).add_ball("a", 1, [0, 0, 0]),
        "'a' is empty or in the scene already",
    ),
    "no name": (lambda s: s.add_box("", [1, 1, 1], [0, 0, 0]), "'' is empty or in the scene"),
    "flat": (lambda s: s.add_box("a", [1, 0, 1], [0, 0, 0]), r"size: \[1.0, 0.0, 1.0\] given, lengths above 0 m wanted"),
    "no radius": (lambda s: s.add_ball("a", -1, [0, 0, 0]), r"radius: \[-1.0\] given, lengths above 0 m wanted"),
    "weightless": (lambda s: s.add_ball("a", 1, [0, 0, 0], mass=0), "mass: 0 given, a number at least 1e-06 wanted"),
    "nowhere": (lambda s: s.add_ball("a", 1, [0, 0]), "at: 2 numbers given, 3 wanted"),
}


@pytest.mark.parametrize("what", WRONG)
def test_a_wrong_thing_is_refused(what: str):
    add, sentence = WRONG[what]
    with pytest.raises(armctl.InputError, match=sentence):
        add(armctl.Scene())


def test_a_name_of_the_robot_is_taken(load):  # noqa: F811
    with pytest.raises(armctl.InputError, match="scene: the model has a body 'A' already; choose another name"):
        load(limb("a b"), motors("a b"), scene=armctl.Scene().add_box("A", [1, 1, 1], [5, 0, 0]))


def test_a_scene_can_be_used_twice(load):  # noqa: F811
    scene = armctl.Scene().add_box("box", [0.1, 0.1, 0.1], [1, 0, 0])
    models = [load(limb("a b"), motors("a b"), scene=scene).model for _ in range(2)]
    assert [mujoco.mj_name2id(m, mujoco.mjtObj.mjOBJ_BODY, "box") > 0 for m in models] == [True, True]

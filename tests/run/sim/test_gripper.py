"""Grippers: found in the model, whatever moves their fingers, and what they say about what they hold."""

import copy
from pathlib import Path

import numpy as np
import pytest
from arms import arm_of, at_hand, some_of
from synthetic import limb, mjcf, motors

import armctl
from armctl.model.gripper.gripper_model import find_gripper_model, make_servos
from armctl.run.sim.gripper.gripper import Gripper

PAD = '<geom name="{0}" type="box" size="0.01 0.004 0.02" pos="0 {1} 0.06" mass="0.02" solref="0.004 1"/>'


def finger(name: str, side: int) -> str:
    """A finger that slides 0..40 mm away from the middle; closed, its pad's face is in the middle."""
    return (
        f'<body name="{name}"><joint name="{name}" type="slide" axis="0 {side} 0" range="0 0.04" armature="0.05" damping="1"/>'
        f"{PAD.format(f'{name}_pad', 0.004 * side)}</body>"
    )


TWO = finger("left", 1) + finger("right", -1)
TOGETHER = '<equality><joint joint1="left" joint2="right" polycoef="0 1 0 0 0" solref="0.005 1"/></equality>'
SPLIT = '<tendon><fixed name="split"><joint joint="left" coef="0.5"/><joint joint="right" coef="0.5"/></fixed></tendon>'
SERVO = '<position name="grip" {} kp="{}" kv="{}" ctrlrange="{}" forcerange="-40 40"/>'
JAW = (
    '<geom name="fixed" type="box" size="0.01 0.004 0.02" pos="0 -0.004 0.06" mass="0.02"/>'
    '<body name="moving_jaw" pos="0 0.04 0">'
    '<joint name="jaw" axis="-1 0 0" range="0 1" armature="0.01" damping="0.1"/>'
    '<geom name="moving" type="box" size="0.01 0.004 0.02" pos="0 -0.036 0.06" mass="0.02"/></body>'
)

# What is behind the tip, what drives it, its greatest width in m.
GRIPPERS = {
    "tendon": (TWO, SPLIT + motors("a b grip", grip=SERVO.format('tendon="split"', 200, 20, "0 0.04")) + TOGETHER, 0.08),
    "tendon, 0 to 255": (
        TWO,
        SPLIT
        + motors(
            "a b grip",
            grip='<general name="grip" tendon="split" ctrlrange="0 255" forcerange="-40 40" gainprm="0.031372549"'
            ' biastype="affine" biasprm="0 -200 -20"/>',
        )
        + TOGETHER,
        0.08,
    ),
    "one leads": (TWO, motors("a b grip", grip=SERVO.format('joint="left"', 200, 20, "0 0.04")) + TOGETHER, 0.08),
    "one leads, geared backwards": (
        TWO,
        motors("a b grip", grip='<position joint="left" gear="-2" kp="200" kv="20" ctrlrange="-0.08 0" forcerange="-20 20"/>')
        + TOGETHER,
        0.08,
    ),
    "one each": (
        TWO,
        motors(
            "a b l r",
            l=SERVO.format('joint="left"', 200, 20, "0 0.04"),
            r=SERVO.format('joint="right"', 200, 20, "0 0.04").replace('name="grip"', ""),
        ),
        0.08,
    ),
    "a motor": (TWO, motors("a b grip", grip='<motor name="grip" joint="left" ctrlrange="-20 20"/>') + TOGETHER, 0.08),
    "a jaw": (JAW, motors("a b grip", grip='<position name="grip" joint="jaw" kp="20" kv="1" forcerange="-4 4"/>'), 0.05),
}


@pytest.fixture
def gripper_arm(tmp_path: Path):
    def loaded(kind: str, scene: armctl.World | None = None) -> armctl.Arm:
        inside, rest, _ = GRIPPERS[kind]
        rest = '<option gravity="0 0 0"/>' + rest
        path = tmp_path / "arm.xml"
        path.write_text(mjcf(limb("a b", inside + '<site name="grasp" pos="0 0 0.06"/>'), rest))
        return armctl.load(path, scene=scene)

    return loaded


@pytest.mark.parametrize("kind", GRIPPERS)
def test_a_gripper_is_found_and_goes_where_it_is_told(gripper_arm, kind: str):
    sim = armctl.Simulation(gripper_arm(kind))
    assert sim.gripper.width_max == pytest.approx(GRIPPERS[kind][2], abs=5e-3)
    for share in (1.0, 0.3, 0.7):
        result = sim.gripper.move(share * sim.gripper.width_max)
        assert result.ok, result
        assert result.width == pytest.approx(share * sim.gripper.width_max, abs=1e-3)
        assert not result.grasped
    assert sim.gripper.open().ok
    assert np.abs(sim.state.q - sim.arm.home).max() < 1e-3


@pytest.mark.parametrize("kind", GRIPPERS)
def test_closed_on_nothing_is_said(gripper_arm, kind: str):
    result = armctl.Simulation(gripper_arm(kind)).gripper.close()
    assert not result.ok
    assert not result.grasped
    assert str(result) == "closed on nothing"


@pytest.mark.parametrize("kind", [kind for kind in GRIPPERS if kind != "a jaw"])
def test_a_grasp_presses_as_asked_and_holds(gripper_arm, kind: str):
    at = gripper_arm(kind).fk([0, 0])
    arm = gripper_arm(kind, armctl.World().add("block", armctl.Box([0.018, 0.03, 0.03]), at, mass=0.05))
    sim = armctl.Simulation(arm)
    sim.gripper.open()
    sim.data.joint("block").qpos[:3] = at.position
    sim.data.joint("block").qpos[3:] = at.quat
    sim.data.joint("block").qvel[:] = 0.0
    result = sim.gripper.grasp(8.0)
    assert result.ok, result
    assert result.held == "block"
    assert result.width == pytest.approx(0.03, abs=1.5e-3)
    assert result.force == pytest.approx(8.0, rel=0.25)
    assert sim.run(armctl.move_j(arm, arm.home, arm.home + 0.4)).failure == ""
    assert np.linalg.norm(sim.data.body("block").xpos - sim.tip.position) < 5e-3
    released = sim.gripper.open()
    assert released.ok
    assert not released.grasped


def test_a_body_that_cannot_move_is_not_held(gripper_arm):
    at = gripper_arm("tendon").fk([0, 0])
    sim = armctl.Simulation(gripper_arm("tendon", armctl.World().add("post", armctl.Box([0.018, 0.03, 0.03]), at)))
    result = sim.gripper.grasp(8.0)
    assert len(sim.data.contact) > 0
    assert not result.ok
    assert result.held == sim.gripper.held == ""


def test_until_it_is_used_a_gripper_is_rigid_and_after_reset_again(gripper_arm):
    arm = gripper_arm("one leads")
    sim, trajectory = armctl.Simulation(arm), armctl.move_j(arm, arm.home, arm.home + 0.3)
    first = sim.run(trajectory)
    assert np.abs(first.q - first.q_ref).max() < 1e-9
    sim.gripper.close()
    sim.reset()
    again = sim.run(trajectory)
    assert np.array_equal(first.q, again.q)


def test_wrong_widths_and_forces_are_refused(gripper_arm):
    gripper = armctl.Simulation(gripper_arm("tendon")).gripper
    with pytest.raises(armctl.InputError, match=r"width: expected a number in \[0, 0.0[78].*, got 0.2"):
        gripper.move(0.2)
    with pytest.raises(armctl.InputError, match="force: 500 N is more than the maximum of this gripper, 20 N"):
        gripper.grasp(500)
    with pytest.raises(armctl.InputError, match=r"force: expected .*got -1"):
        gripper.grasp(-1)


NO_GRIPPER = {
    "nothing": ("", motors("a b"), "no actuator moves anything behind the tip"),
    "a hand": (
        limb("f") + limb("g") + limb("h"),
        motors("a b c d f g h"),
        "3 actuators move what is behind the tip 'D': a hand, not a gripper",
    ),
}


@pytest.mark.parametrize("what", NO_GRIPPER)
def test_no_gripper_says_why(tmp_path: Path, what: str):
    inside, rest, sentence = NO_GRIPPER[what]
    path = tmp_path / "arm.xml"
    path.write_text(mjcf(limb("a b c d" if inside else "a b", inside), rest))
    with pytest.raises(armctl.ModelError, match=sentence):
        find_gripper_model(armctl.load(path))


# Widths by the makers' data: Franka hand 80 mm, Robotiq 2F-85 85 mm, xArm gripper 84 mm.
AT_HAND = {
    "panda": ({}, 0.080),
    "ur5e": ({"tool": "robotiq_2f85"}, 0.085),
    "xarm7": ({}, 0.084),
    "aloha": ({"tip": "left/gripper"}, None),
    "so_arm100": ({}, None),
}


@pytest.mark.parametrize("robot", some_of(AT_HAND))
def test_grippers_at_hand(robot: str):
    arm_of(f"{robot}:{AT_HAND[robot][0].get('tip', '')}" if robot == "aloha" else robot)  # skips where it is not at hand
    arm = armctl.load(robot, **AT_HAND[robot][0])
    gripper: Gripper = armctl.Simulation(arm).gripper
    if AT_HAND[robot][1] is not None:
        assert gripper.width_max == pytest.approx(AT_HAND[robot][1], abs=3e-3)
    for width in (gripper.width_max, 0.5 * gripper.width_max):
        result = gripper.move(width)
        assert result.ok, result
    assert str(gripper.close()) == "closed on nothing"


@pytest.mark.skipif(not (at_hand("ur5e") and at_hand("robotiq_2f85")), reason="ur5e: its model is not installed")
def test_the_controller_knows_the_mass_of_a_tool():
    bare, arm = armctl.load("ur5e"), armctl.load("ur5e", tool="robotiq_2f85")
    assert arm.tip == "robotiq_2f85/pinch"
    added = [sum(i.mass for i in a.pinocchio_model.pin_model.inertias) for a in (bare, arm)]
    assert 0.8 < added[1] - added[0] < 1.2  # the data sheet says 0.9 kg, the model has 1.05
    log = armctl.simulate(arm, "computed-torque", armctl.move_j(arm, arm.home, arm.home + 0.3))
    assert np.abs(log.q - log.q_ref).max() < 1e-9
    target = arm.fk(arm.home + 0.2)
    assert armctl.solve_ik(arm, target).ok


@pytest.mark.parametrize("gear", [1.0, -5.0])
def test_a_motor_becomes_a_servo_that_is_critically_damped_at_the_joint(tmp_path, gear: float):
    drive = f'<motor name="grip" joint="left" gear="{gear}" ctrlrange="{-10 / abs(gear)} {10 / abs(gear)}"/>'
    path = tmp_path / "arm.xml"
    path.write_text(mjcf(limb("a b", TWO + '<site name="grasp" pos="0 0 0.06"/>'), motors("a b grip", grip=drive) + TOGETHER))
    arm = armctl.load(path)
    found = find_gripper_model(arm)
    model = copy.copy(arm.model)
    make_servos(model, found.actuators, found.inertia)
    _, stiffness, damping = -model.actuator_biasprm[found.actuators[0], :3] * gear**2
    assert found.inertia == pytest.approx([2 * (0.05 + 0.02)], rel=1e-3)
    assert damping == pytest.approx(2 * np.sqrt(stiffness * found.inertia[0]))
    assert stiffness == pytest.approx(min(10 / (0.1 * 0.04), found.inertia[0] * (0.2 / arm.dt) ** 2))

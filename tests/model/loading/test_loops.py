"""Closed loops of links: no arm is returned whose motion breaks one. MuJoCo's constraint residuals judge."""

import mujoco
import numpy as np
import pytest
from synthetic import limb, mjcf, motors

import armctl

pytestmark = pytest.mark.filterwarnings("ignore::armctl.ArmctlWarning")

CAPSULE = '<geom type="capsule" fromto="0 0 0 {x} 0 {z}" size="0.02" mass="1" contype="0" conaffinity="0"/>'
HINGE = '<joint name="{name}" axis="0 1 0" range="-1 1"/>'


def link(name, place, x, z, inside=""):
    return f'<body name="{name.upper()}" pos="{place}">{HINGE.format(name=name)}{CAPSULE.format(x=x, z=z)}{inside}</body>'


# A parallel link arm: a lever beside the shoulder moves the forearm through a rod.
LEVER = link("drive", "0 0 0", -0.1, 0.0, link("rod", "-0.1 0 0", 0.0, 0.4))
FOREARM = link("elbow", "0 0 0.4", 0.4, 0.0, '<site name="tcp" pos="0.4 0 0"/>')
TURRET = (
    f'<body name="TURRET"><joint name="turn" axis="0 0 1" range="-3 3"/>{CAPSULE.format(x=0.0, z=0.1)}'
    f"{link('shoulder', '0 0 0', 0.0, 0.4, FOREARM)}{LEVER}</body>"
)
LOOP = '<equality><connect name="parallelogram" body1="ROD" body2="ELBOW" anchor="0 0 0.4"/></equality>'


def load(bodies, rest, **options):
    return armctl.load(mujoco.MjSpec.from_string(mjcf(bodies, rest)), **options)


def largest_residual(arm):
    """The largest distance, m, between the points that a loop holds together, at random configurations of an arm."""
    data = mujoco.MjData(arm.model)
    worst = 0.0
    for q in arm.limits.random(arm.home, 20, np.random.default_rng(0)):
        data.qpos[:] = arm.qpos(q)
        mujoco.mj_fwdPosition(arm.model, data)
        worst = max(worst, np.abs(data.efc_pos[data.efc_type == mujoco.mjtConstraint.mjCNSTR_EQUALITY]).max(initial=0.0))
    return worst


@pytest.mark.parametrize("driven", ["turn shoulder drive", "turn shoulder elbow", "turn shoulder elbow drive rod", ""])
@pytest.mark.parametrize("options", [{}, {"tip": "tcp"}, {"tip": "DRIVE"}, {"tip": "tcp", "base": "TURRET"}])
def test_an_arm_in_a_loop_is_refused_with_the_name_of_the_loop(driven, options):
    rest = (motors(driven) if driven else "") + LOOP
    with pytest.raises(armctl.ModelError, match="the equality 'parallelogram' closes a loop over joint"):
        load(TURRET, rest, **options)
    compiled = mujoco.MjSpec.from_string(mjcf(TURRET, motors("turn shoulder drive") + LOOP)).compile()
    with pytest.raises(armctl.ModelError, match="'parallelogram' closes a loop"):
        armctl.load(compiled, **options)


def test_joints_before_a_loop_move_it_as_a_whole():
    arm = load(TURRET, motors("turn shoulder drive") + LOOP, tip="TURRET")
    assert arm.joint_names == ("turn",)
    assert largest_residual(arm) < 1e-12


def test_a_gripper_with_a_loop_that_a_tendon_drives_is_refused_by_the_loop():
    fingers = limb("a b") + limb("c d")
    tendon = '<tendon><fixed name="split"><joint joint="a" coef="0.5"/><joint joint="c" coef="0.5"/></fixed></tendon>'
    motor = '<actuator><general tendon="split"/></actuator>'
    loop = '<equality><connect name="jaw" body1="B" body2="D" anchor="0 0 0"/></equality>'
    with pytest.raises(armctl.ModelError, match="no arm: the equality 'jaw' closes a loop over joint 'a'"):
        load(fingers, tendon + motor + loop)


@pytest.mark.parametrize("kind", ["planar", "free"])
def test_a_base_that_a_loop_holds_cannot_move(kind):
    trunk = f'<body name="trunk" pos="0 0 1"><geom size="0.1"/>{limb("a b")}{limb("c d")}</body>'
    pinned = '<equality><connect name="pin" body1="trunk" anchor="0 0 0"/></equality>'
    with pytest.raises(armctl.ModelError, match="the equality 'pin' closes a loop over joint 'base x'"):
        load(trunk, motors("a b c d") + pinned, base=kind)
    arm = load(trunk, motors("a b c d") + pinned)
    assert arm.n == 4
    assert largest_residual(arm) < 1e-12


def test_a_loop_that_is_open_at_home_is_noted():
    wrist = limb("a b c", link("jaw", "0.1 0 0", 0.1, 0.0) + link("pad", "0.1 0 0.1", 0.1, 0.0))
    rest = motors("a b c") + '<equality><connect name="grip" body1="JAW" body2="PAD" anchor="0.1 0 0"/></equality>'
    closed = load(wrist, rest)
    assert closed.n == 3
    assert largest_residual(closed) < 1e-12
    assert not any("open by" in note for note in closed.notes)
    opened = load(wrist, rest + '<keyframe><key name="home" qpos="0 0 0 0.5 -0.2"/></keyframe>')
    gap = 1e3 * largest_residual(opened)
    assert gap > 1.0
    note = next(note for note in opened.notes if "open by" in note)
    assert "the loop of the equality 'grip'" in note
    inactive = rest.replace('<connect name="grip"', '<connect name="grip" active="false"')
    assert not any(
        "open by" in note
        for note in load(wrist, inactive + '<keyframe><key name="home" qpos="0 0 0 0.5 -0.2"/></keyframe>').notes
    )


def test_a_limb_that_is_left_out_because_of_a_loop_is_noted():
    rest = motors("a b c d") + '<equality><connect name="foot" body1="B" anchor="0 0 0"/></equality>'
    trunk = f'<body name="trunk" pos="0 0 1"><geom size="0.1"/>{limb("a b")}{limb("c d")}</body>'
    arm = load(trunk, rest)
    assert arm.joint_names == ("c", "d")
    assert "held at home: a and b; the equality 'foot' closes a loop over joint 'a'" in arm.notes
    assert not any("held at home" in note for note in load(trunk, rest, tip="D").notes)

"""Closed loops of links: they stay closed wherever the arm moves, or it is refused. MuJoCo's constraint residuals judge."""

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
    drawn = arm.limits.random(arm.home, 20, np.random.default_rng(0))
    closure = arm.joint_map.closure
    for q in drawn if closure is None else closure.inward(arm.home, drawn):
        data.qpos[:] = arm.qpos(q)
        mujoco.mj_fwdPosition(arm.model, data)
        worst = max(worst, np.abs(data.efc_pos[data.efc_type == mujoco.mjtConstraint.mjCNSTR_EQUALITY]).max(initial=0.0))
    return worst


ENDS = [{}, {"tip": "tcp"}, {"tip": "DRIVE"}, {"tip": "tcp", "base": "TURRET"}]


@pytest.mark.parametrize(
    ("driven", "options", "joints", "passive"),
    [
        ("turn shoulder drive", ENDS[0], "turn shoulder drive", "elbow rod"),
        ("turn shoulder drive", ENDS[1], "turn shoulder drive", "elbow rod"),
        ("turn shoulder drive", ENDS[2], "turn drive shoulder", "elbow rod"),
        ("turn shoulder drive", ENDS[3], "shoulder drive", "elbow rod"),
        ("turn shoulder elbow", ENDS[0], "turn shoulder elbow", "drive rod"),
        ("turn shoulder elbow", ENDS[2], "turn shoulder elbow", "drive rod"),
        ("turn rod drive", ENDS[1], "turn drive rod", "shoulder elbow"),
    ],
)
@pytest.mark.parametrize("kind", ["connect", "weld", "sites"])
def test_an_arm_moves_with_its_loop_closed(driven, options, joints, passive, kind):
    place = 'site name="{}" pos="{}" size="0.01"'
    bodies = TURRET
    if kind == "connect":
        loop = LOOP
    elif kind == "weld":  # of a plate that turns on the rod, as the elbow does
        bodies = TURRET.replace('axis="0 1 0" range="-1 1"/>', 'axis="0 1 0" range="-1 1"/>')
        pin = '<body name="PLATE" pos="0 0 0.4"><joint name="plate" axis="0 1 0"/><geom size="0.01" mass="0.1"/></body>'
        rod = link("rod", "-0.1 0 0", 0.0, 0.4)
        bodies = TURRET.replace(rod, link("rod", "-0.1 0 0", 0.0, 0.4, pin))
        loop = '<equality><weld name="parallelogram" body1="PLATE" body2="ELBOW"/></equality>'
        passive = f"{passive} plate"
    else:
        rod = link("rod", "-0.1 0 0", 0.0, 0.4)
        marked = link("rod", "-0.1 0 0", 0.0, 0.4, f"<{place.format('end', '0 0 0.4')}/>")
        bodies = TURRET.replace(rod, marked).replace(
            '<site name="tcp"', f'<{place.format("eye", "-0.1 0 0")}/><site name="tcp"'
        )
        loop = '<equality><connect name="parallelogram" site1="end" site2="eye"/></equality>'
    arm = load(bodies, motors(driven) + loop, **options)
    assert arm.joint_names == tuple(joints.split())
    assert sorted(arm.joint_map.closure.names) == sorted(passive.split())
    assert arm.tips == (options.get("tip", "tcp"),)
    assert largest_residual(arm) < 1e-9
    assert any("closed loops: " in note for note in arm.notes)
    compiled = armctl.load(mujoco.MjSpec.from_string(mjcf(bodies, motors(driven) + loop)).compile(), **options)
    assert largest_residual(compiled) < 1e-9


@pytest.mark.parametrize(
    ("driven", "why"),
    [
        ("turn shoulder elbow drive rod", "all of its joints have motors"),
        ("", "all of its joints have motors"),
        ("turn shoulder elbow drive", "it has more motors .* than it can move independently"),
        ("turn shoulder", "the motors of shoulder do not determine where elbow, drive and rod are"),
    ],
)
@pytest.mark.parametrize("options", ENDS)
def test_an_arm_whose_motors_do_not_determine_a_loop_is_refused_with_the_name_of_the_loop(driven, why, options):
    rest = (motors(driven) if driven else "") + LOOP
    with pytest.raises(armctl.ModelError, match=f"the equality 'parallelogram' closes a loop over joint .*, and {why}"):
        load(TURRET, rest, **options)


def test_a_base_inside_a_loop_is_refused():
    with pytest.raises(armctl.ModelError, match="joint 'elbow' is in a closed loop with 'shoulder', which carries the base"):
        load(TURRET, motors("turn shoulder drive") + LOOP, tip="tcp", base="SHOULDER")


def test_a_home_at_which_a_loop_cannot_be_closed_is_moved_or_refused():
    key = '<keyframe><key name="home" qpos="0 {} 0 {} 0"/></keyframe>'
    shut = load(TURRET, motors("turn shoulder drive") + LOOP + key.format("0.9", "-0.9"), tip="tcp")
    assert shut.joint_map.positions(shut.home).tolist() == pytest.approx([0, 0, 0, 0, 0])  # the elbow would be at 1.8
    flat = TURRET.replace('name="elbow" axis="0 1 0" range="-1 1"', 'name="elbow" axis="0 1 0" range="0.5 1"')
    with pytest.raises(armctl.ModelError, match=r"the passive joint elbow would be at .*; write a keyframe 'home' in which"):
        load(flat, motors("turn shoulder drive") + LOOP, tip="tcp")


def test_a_loop_that_is_stretched_at_home_is_refused_by_name():
    arm_of_two = link("a", "0 0 0", 0.4, 0.0, link("b", "0.4 0 0", 0.4, 0.0))
    slide = '<joint name="cart" type="slide" axis="1 0 0" range="-1 1"/>'
    rail = f'<body name="CART" pos="0.8 0 0">{slide}<geom size="0.02" mass="1"/></body>'
    pinned = '<equality><connect name="pin" body1="B" body2="CART" anchor="0.4 0 0"/></equality>'
    with pytest.raises(armctl.ModelError, match=r"the equality 'pin' closes a loop .* where a and b are at home"):
        load(arm_of_two + rail, motors("cart") + pinned, tip="CART")


def test_passive_joints_that_are_tied_to_each_other_follow_too():
    rest = motors("turn shoulder drive") + LOOP.replace(
        "</equality>", '<joint joint1="flap" joint2="elbow" polycoef="0.1 0.5 0 0 0"/></equality>'
    )
    flap = link("flap", "0.4 0 0", 0.1, 0.0)
    arm = load(TURRET.replace('<site name="tcp"', f'{flap}<site name="tcp"'), rest, tip="FLAP")
    q = np.array([0.2, 0.4, -0.1])
    at = arm.qpos(q)
    assert at[arm.model.joint("flap").qposadr[0]] == pytest.approx(0.1 + 0.5 * at[arm.model.joint("elbow").qposadr[0]])
    assert largest_residual(arm) < 1e-9


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
    with pytest.raises(armctl.ModelError, match=r"the equality 'pin' closes a loop over joint 'base x'"):
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
    assert any("held at home: a and b; the equality 'foot' closes a loop over joint 'a'" in note for note in arm.notes)
    assert not any("held at home" in note for note in load(trunk, rest, tip="D").notes)

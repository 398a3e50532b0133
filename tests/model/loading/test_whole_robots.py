"""Robots with several limbs, and bases that are held or move. MuJoCo and SciPy judge."""

import mujoco
import numpy as np
import pytest
from arms import MISSING, at_hand, some_of
from scipy.spatial.transform import Rotation
from synthetic import limb, mjcf, motors

import armctl

pytestmark = pytest.mark.filterwarnings("ignore::armctl.ArmctlWarning")

FLOOR = '<geom name="floor" type="plane" size="5 5 0.1" contype="0" conaffinity="0"/>'
LEGS = limb("a b c") + limb("d e f")
WALKER = (
    f'{FLOOR}<body name="trunk" pos="0 0 1" euler="0.3 0 0"><freejoint name="root"/>'
    f'<geom size="0.1" mass="5" contype="0" conaffinity="0"/>{LEGS}</body>'
)
STANDING = '<keyframe><key name="home" qpos="0.1 0.2 0.6 0.8 0 0.6 0 0.3 -0.4 0.1 0.2 0.3 0.4"/></keyframe>'
CART = (
    '<body name="cart" pos="0.2 0 0.3" euler="0 0 0.5"><geom size="0.1" mass="5" contype="0" conaffinity="0"/>'
    f"{limb('a b c')}</body>"
)
AT_HOME = '<keyframe><key name="home" qpos="0.3 -0.4 0.1"/></keyframe>'


def load(bodies, rest, **options):
    return armctl.load(mujoco.MjSpec.from_string(mjcf(bodies, rest)), **options)


def tip_matrices(arm, q):
    data = mujoco.MjData(arm.model)
    data.qpos[:] = arm.qpos(q)
    mujoco.mj_kinematics(arm.model, data)
    matrices = []
    for frame in arm.tip_frames:
        T = np.eye(4)
        T[:3, :3] = data.xmat[frame.body].reshape(3, 3)
        T[:3, 3] = data.xpos[frame.body]
        matrices.append(T @ frame.T_body_tip.matrix)
    return matrices


def test_a_robot_with_several_limbs_is_all_of_them():
    arm = load(WALKER, motors("a b c d e f") + STANDING)
    assert arm.joint_names == ("a", "b", "c", "d", "e", "f")
    assert len(arm.tips) == 2
    assert arm.base == "fixed"
    assert arm.home == pytest.approx([0.3, -0.4, 0.1, 0.2, 0.3, 0.4])
    assert armctl.Simulation(arm).arm is arm


def test_an_arm_with_a_short_second_limb_is_an_arm():
    """A head, a wheel: today's arm, as before."""
    arm = load(limb("a b c d e") + limb("h k"), motors("a b c d e h k"))
    assert arm.joint_names == ("a", "b", "c", "d", "e")
    whole = load(limb("a b c d e") + limb("h k m"), motors("a b c d e h k m"))
    assert len(whole.tips) == 2
    assert whole.n == 8


def test_fingers_that_branch_off_a_wrist_are_a_hand():
    hand = limb("w x", limb("a b c") + limb("d e f") + limb("g h i"))
    arm = load(hand, motors("w x a b c d e f g h i"))
    assert arm.n == 11
    assert len(arm.tips) == 3


@pytest.mark.parametrize("kind", ["planar", "free"])
@pytest.mark.parametrize("text", ["walker", "cart"])
def test_a_moving_base_moves_all_tips_as_a_rigid_body(text, kind):
    bodies, names, key = (WALKER, "a b c d e f", STANDING) if text == "walker" else (CART, "a b c", AT_HOME)
    held = load(bodies, motors(names) + key)
    arm = load(bodies, motors(names) + key, base=kind)
    assert arm.base == kind
    moving = arm.n - held.n
    assert moving == (3 if kind == "planar" else 6)
    assert arm.joint_names[moving:] == held.joint_names
    assert arm.home == pytest.approx([*np.zeros(moving), *held.home])
    assert arm.tips == held.tips
    data = mujoco.MjData(held.model)
    data.qpos[:] = held.home_qpos
    mujoco.mj_kinematics(held.model, data)
    origin = data.body("trunk" if text == "walker" else "cart").xpos
    rng = np.random.default_rng(0)
    for q in held.limits.random(held.home, 5, rng):
        base = rng.uniform(-1.0, 1.0, moving)
        x, y, z, yaw, pitch, roll = base if kind == "free" else (*base[:2], 0.0, base[2], 0.0, 0.0)
        turn = Rotation.from_euler("ZYX", [yaw, pitch, roll]).as_matrix()
        moved = np.eye(4)
        moved[:3, :3] = turn
        moved[:3, 3] = origin + np.array([x, y, z]) - turn @ origin
        for T, T_held in zip(tip_matrices(arm, np.concatenate([base, q])), tip_matrices(held, q), strict=True):
            assert pytest.approx(moved @ T_held, abs=1e-12) == T


def test_data_sheets_hold_behind_a_moving_base():
    if not at_hand("universal_robots_ur5e"):
        pytest.skip(f"universal_robots_ur5e: {MISSING}")
    held = armctl.load("ur5e")
    arm = armctl.load("ur5e", base="planar")
    assert arm.limits.v_max[3:].tolist() == held.limits.v_max.tolist()
    assert arm.limits.tau_max[3:].tolist() == held.limits.tau_max.tolist()
    assert np.isfinite(arm.limits.tau_max).all()
    assert np.isfinite(arm.limits.a_max).all()


def test_a_planar_base_is_simulated_and_a_free_one_is_not():
    arm = load(CART, motors("a b c") + AT_HOME, base="planar")
    goal = arm.limits.clamp(arm.home + np.array([0.5, -0.2, 0.4, 0.1, 0.1, 0.1]))
    motion = armctl.move_j(arm, arm.home, goal)
    assert not armctl.simulate(arm, "computed-torque", motion).failure
    free = load(CART, motors("a b c") + AT_HOME, base="free")
    assert armctl.move_j(free, free.home, free.home + 0.1).duration > 0
    for call in (
        lambda: armctl.Simulation(free),
        lambda: armctl.simulate(free, "pd", armctl.move_j(free, free.home, free.home + 0.1)),
        lambda: armctl.margins(free, "computed-torque"),
    ):
        with pytest.raises(armctl.InputError, match="no motor holds the free base"):
            call()


def test_targets_beyond_the_arms_own_reach_are_reached_with_a_planar_base():
    arm = load(CART, motors("a b c") + AT_HOME, base="planar")
    tip = arm.fk(arm.home)
    for angle in np.linspace(0.0, 6.0, 20):
        target = tip.position + 3.0 * np.array([np.cos(angle), np.sin(angle), 0.0])
        found = armctl.solve_ik(arm, target, arm.home)
        assert found
        assert np.linalg.norm(tip_matrices(arm, found.q)[0][:3, 3] - target) < 1e-5


@pytest.mark.parametrize(
    ("bodies", "names", "text"),
    [
        (CART + CART.replace("cart", "other").replace('name="', 'name="o'), "a b c oa ob oc", "stand on the world"),
        (limb("a b c"), "a b c", "has joints of its own"),
    ],
)
def test_bases_that_cannot_move_are_one_sentence(bodies, names, text):
    with pytest.raises(armctl.ModelError, match=text):
        load(bodies, motors(names), base="planar")


WHOLE = {
    "aloha": (12, 2),
    "anybotics_anymal_c": (12, 4),
    "shadow_hand": (16, 5),
    "unitree_go1": (12, 4),
    "unitree_go2": (12, 4),
    "unitree_h1": (19, 4),
    "wonik_allegro": (16, 4),
}


@pytest.mark.parametrize("name", some_of(WHOLE, ["unitree_h1"]))
def test_robots_of_menagerie_load_whole_and_stand_where_their_keyframe_puts_them(name):
    if not at_hand(name):
        pytest.skip(f"{name}: {MISSING}")
    arm = armctl.load(name)
    n, tips = WHOLE[name]
    assert arm.n == n
    assert len(set(arm.tips)) == tips
    for T, tip in zip(tip_matrices(arm, arm.home), arm.tips, strict=True):
        assert arm.fk(arm.home, tip).matrix == pytest.approx(T, abs=1e-12)
    assert armctl.solve_ik(arm, {tip: arm.fk(arm.home + 0.01, tip).position for tip in arm.tips})


def test_a_short_neck_is_a_limb_where_long_arms_leave_the_same_torso():
    """Fingers are fewer joints than come before them on every branch; of a torso with two arms the neck is none."""
    robot = load(
        limb("t u v", limb("n m") + limb("a b c d") + limb("e f g h")) + limb("k l o p"),
        motors("t u v n m a b c d e f g h k l o p"),
    )
    assert robot.n == 17
    assert len(robot.tips) == 4
    gripper = load(limb("a b c d", limb("e f") + limb("g h")), motors("a b c d e f g h"))
    assert gripper.joint_names == ("a", "b", "c", "d")


WHEEL = (
    '<body pos="{x} 0.3 0"><joint name="{name}" axis="0 1 0"/>'
    '<geom type="cylinder" size="0.05 0.02" euler="90 0 0" mass="1"/></body>'
)


def test_wheels_are_no_limbs_of_a_robot_with_arms_and_are_named_as_held():
    wheels = "".join(WHEEL.format(x=x, name=name) for x, name in ((0.2, "left"), (-0.2, "right")))
    arms = limb("a b c") + limb("d e f")
    base = f'<body name="cart" pos="0 0 0.3"><geom size="0.1" mass="5" contype="0" conaffinity="0"/>{arms}{wheels}</body>'
    robot = load(base, motors("a b c d e f left right"))
    assert robot.joint_names == ("a", "b", "c", "d", "e", "f")
    assert "held at home: left and right" in robot.notes
    limited = base.replace('axis="0 1 0"/>', 'axis="0 1 0" range="-1 1"/>')
    assert load(limited, motors("a b c d e f left right")).n == 8
    one_arm = base.replace(limb("d e f"), "")
    assert load(one_arm, motors("a b c left right")).joint_names == ("a", "b", "c")
    short = one_arm.replace(limb("a b c"), limb("a"))
    assert load(short, motors("a left right")).n == 3
    bent = base.replace('size="0.05 0.02"', 'size="0.05 0.02" pos="0.2 0 0"')
    assert load(bent, motors("a b c d e f left right")).n == 8


PLANAR = (
    '<body name="trunk" pos="0 0 0.8"><joint name="x" type="slide" axis="1 0 0"/><joint name="z" type="slide" axis="0 0 1"/>'
    f'<joint name="y" axis="0 1 0"/><geom size="0.1" mass="5" contype="0" conaffinity="0"/>{LEGS}</body>'
)


@pytest.mark.parametrize("key", ["", '<keyframe><key name="home" qpos="0.1 0.2 0.3 0.3 -0.4 0.1 0.2 0.3 0.4"/></keyframe>'])
def test_the_base_of_a_planar_walker_is_held_where_its_keyframe_puts_it(key):
    rest = motors("a b c d e f") + key
    arm = load(PLANAR, rest)
    assert arm.joint_names == ("a", "b", "c", "d", "e", "f")
    original = mujoco.MjSpec.from_string(mjcf(PLANAR, rest)).compile()
    data = mujoco.MjData(original)
    if key:
        mujoco.mj_resetDataKeyframe(original, data, 0)
        assert arm.home == pytest.approx(data.qpos[3:])
    for q in arm.limits.random(arm.home, 3, np.random.default_rng(0)):
        data.qpos[3:] = q
        mujoco.mj_kinematics(original, data)
        for tip in arm.tips:
            assert arm.fk(q, tip).position == pytest.approx(data.body(tip).xpos, abs=1e-12)
    moved = load(PLANAR, rest, base="planar")
    assert moved.home == pytest.approx([0.0, 0.0, 0.0, *arm.home])
    assert moved.fk(moved.home).matrix == pytest.approx(arm.fk(arm.home).matrix, abs=1e-12)


@pytest.mark.parametrize(
    ("change", "rest"),
    [
        ('name="x" type="slide" range="-1 1"', ""),
        ('name="x" type="slide"', '<tendon><fixed name="rope"><joint joint="x" coef="1"/></fixed></tendon>'),
        ('name="x" type="slide"', '<equality><joint joint1="x"/></equality>'),
    ],
)
def test_slides_with_limits_or_couplings_are_no_floating_base(change, rest):
    with pytest.raises(armctl.ModelError, match="'x'"):
        load(PLANAR.replace('name="x" type="slide"', change), motors("a b c d e f") + rest)


def test_of_equally_long_chains_that_cannot_be_driven_the_reason_is_given():
    bodies = limb("a b") + limb("c d")
    rest = (
        motors("a b c d") + '<tendon><fixed name="left"><joint joint="b" coef="1"/><joint joint="a" coef="2"/></fixed>'
        '<fixed name="right"><joint joint="c" coef="1"/><joint joint="d" coef="2"/></fixed></tendon>'
        '<equality><tendon name="tied" tendon1="left"/><tendon name="bound" tendon1="right"/></equality>'
    )
    with pytest.raises(armctl.ModelError, match="coupled to another by the equality 'tied'"):
        load(bodies, rest)

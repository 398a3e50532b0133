"""Small synthetic robots, written as text: MJCF from bodies and actuators, URDF from joints; and serial arms by their shape."""

from dataclasses import dataclass
from pathlib import Path

import armctl


def limb(names: str, inside: str = "", joint: str = "", extra: str = "") -> str:
    """Bodies in series, one a hinge: "a b" makes body A with joint a, and on it body B with joint b and what is `inside`."""
    first, *rest = names.split()
    turned = 'axis="0 1 0"' if len(rest) % 2 else 'axis="0 0 1"'
    deeper = limb(" ".join(rest), inside, joint, extra) if rest else inside + extra
    return (
        f'<body name="{first.upper()}" pos="0.1 0 0.1"><joint name="{first}" {turned} range="-2 2" {joint}/>'
        f'<geom type="capsule" fromto="0 0 0 0.1 0 0.1" size="0.02" mass="0.5" contype="0" conaffinity="0"/>{deeper}</body>'
    )


def mjcf(bodies: str, rest: str = "") -> str:
    return f'<mujoco model="trap"><compiler angle="radian" autolimits="true"/><worldbody>{bodies}</worldbody>{rest}</mujoco>'


def motors(names: str, **more: str) -> str:
    """One motor a joint; `more` holds actuators instead, such as c='<position joint="c" kp="50"/>'."""
    lines = [more.get(name, f'<motor name="m_{name}" joint="{name}" ctrlrange="-20 20"/>') for name in names.split()]
    return f"<actuator>{''.join(lines)}</actuator>"


def rotor_spring_link(names: str, stiffness: float, damping: float = 0.5, inertia: float = 0.1) -> str:
    """Elastic joints in series: for joint a of the motor a rotor Ra, a spring sa and a link La."""
    first, *rest = names.split()
    axis = 'axis="0 1 0"'
    deeper = rotor_spring_link(" ".join(rest), stiffness, damping, inertia) if rest else ""
    return (
        f'<body name="R{first}" pos="0.1 0 0.1"><joint name="{first}" {axis} range="-2 2" armature="{inertia}"/>'
        '<geom size="0.02" mass="0.1" contype="0" conaffinity="0"/>'
        f'<body name="L{first}"><joint name="s{first}" {axis} stiffness="{stiffness}" damping="{damping}"/>'
        f'<geom type="capsule" fromto="0 0 0 0.1 0 0.1" size="0.02" mass="0.5" contype="0" conaffinity="0"/>'
        f"{deeper}</body></body>"
    )


RIGID = 'solref="0.002 1" solimp="0.9999 0.9999 0.001 0.5 2"'
FAST = '<option timestep="0.001" integrator="implicitfast"/>'
FINGERS = limb("left", joint='armature="0.01" damping="0.1"') + limb("right", joint='armature="0.02" stiffness="0.5"')


def ties(*pairs: str) -> str:
    """Equalities: "c b 0.1 -0.5" makes c = 0.1 - 0.5 b."""
    lines = []
    for pair in pairs:
        first, second, offset, ratio = pair.split()
        lines.append(f'<joint joint1="{first}" joint2="{second}" polycoef="{offset} {ratio} 0 0 0" {RIGID}/>')
    return f"<equality>{''.join(lines)}</equality>{FAST}"


def tendon(**coefficients: float) -> str:
    joints = "".join(f'<joint joint="{joint}" coef="{coef}"/>' for joint, coef in coefficients.items())
    return f'<tendon><fixed name="cable">{joints}</fixed></tendon>'


PULL = '<motor name="m" tendon="cable" gear="3" ctrlrange="-20 20"/>'
HAND = limb("a b", FINGERS)
PAIR = limb("a b c") + limb("d e f").replace('pos="0.1 0 0.1"', 'pos="-0.5 0 0.1"', 1)  # two arms beside each other
UPPER_LINK = '<geom type="capsule" fromto="0.06 0 0 0.26 0 0" size="0.02" mass="0.5"/>'


def standing(side: str, y: float) -> str:
    """An arm of four joints on a base, whose links can touch."""
    joint = '<joint name="{0}{1}" axis="{2}" range="-2.6 2.6"/>'
    wrist = f'<body pos="0.3 0 0">{joint.format(side, 4, "0 0 1")}{UPPER_LINK}<site name="{side}" pos="0.3 0 0"/></body>'
    fore = f'<body pos="0.3 0 0">{joint.format(side, 3, "0 1 0")}{UPPER_LINK}{wrist}</body>'
    upper = f'<body pos="0 0 0.1">{joint.format(side, 2, "0 1 0")}{UPPER_LINK}{fore}</body>'
    shoulder = f'{joint.format(side, 1, "0 0 1")}<geom size="0.03" mass="0.5"/>{upper}'
    return f'<body name="base_{side}" pos="0 {y} 0.4">{shoulder}</body>'


_BOTH = standing("l", 0.25) + standing("r", -0.25)
_TURN = '<joint name="turn" axis="0 0 1" range="-2 2"/><geom size="0.03" mass="2" contype="0" conaffinity="0"/>'
_BOTH_MOTORS = "l1 l2 l3 l4 r1 r2 r3 r4"
TWO_ARMS = mjcf(_BOTH, motors(_BOTH_MOTORS) + '<option timestep="0.001"/>')
ON_A_TORSO = mjcf(f'<body name="torso">{_TURN}{_BOTH}</body>', motors(f"turn {_BOTH_MOTORS}") + '<option timestep="0.001"/>')
GEARED = limb("a", limb("b c") + limb("drive"))
SLIDES = limb("a s t u b").replace('name="s" axis="0 1 0"', 'name="s" type="slide" axis="1 0 0"')
SLIDES = SLIDES.replace('name="t" axis="0 0 1"', 'name="t" type="slide" axis="1 0 0"')
SLIDES = SLIDES.replace('name="u" axis="0 1 0"', 'name="u" axis="0 1 0" stiffness="2" springref="0.3" damping="0.5"')

# What is tied to what, what moves it, and how it is loaded: bodies, rest, keywords, the arm's joints.
TIED = {
    "a follower in the chain": (limb("a b c d"), ties("c b 0.1 -0.5") + motors("a b d"), {}, "a b d"),
    "the motor at the joint nearer the tip": (limb("a b c d"), ties("b c 0.1 -0.5") + motors("a c d"), {}, "a b d"),
    "one leads several": (limb("a b c d"), ties("c b 0 0.5", "d c 0.1 -1.5") + motors("a b"), {}, "a b"),
    "a finger beside the chain": (HAND, ties("right left 0 -1") + motors("a b left"), {"tip": "LEFT"}, "a b left"),
    "the finger without the motor": (HAND, ties("right left 0.2 2") + motors("left"), {"base": "B", "tip": "RIGHT"}, "right"),
    "a gear beside the arm": (GEARED, ties("b drive 0 -0.8") + motors("a drive c"), {"tip": "C"}, "a b c"),
    "a tendon on a tied pair": (limb("a b c"), ties("c b 0 2") + tendon(b=0.5, c=0.25) + motors("a c", c=PULL), {}, "a b"),
    "a tendon on one joint": (limb("a b"), FAST + tendon(b=0.5) + motors("a b", b=PULL), {}, "a b"),
    "a telescope, and a hinge tied to it": (SLIDES, ties("t s 0 1", "u s 0.2 3") + motors("a s b"), {}, "a s b"),
}


LINK = '<link name="{}"><inertial><origin xyz="0 0 0.1"/><mass value="1"/>{}</inertial>{}</link>'

INERTIA = '<inertia ixx="0.01" iyy="0.01" izz="0.01" ixy="0" ixz="0" iyz="0"/>'

JOINT = (
    '<joint name="{0}" type="{1}"><parent link="{2}"/><child link="{3}"/><origin xyz="0 0 0.3"/><axis xyz="0 1 0"/>{4}</joint>'
)

LIMIT = '<limit lower="-1" upper="1.5" effort="40" velocity="2.5"/>'

MESH = '<collision><geometry><mesh filename="{}"/></geometry></collision>'


def urdf(*joints: str, shapes: str = "") -> str:
    links = "".join(LINK.format(name, INERTIA, shapes if name == "one" else "") for name in ("one", "two", "three"))
    return f'<robot name="r"><link name="base"/>{links}<link name="tool0"/>{"".join(joints)}</robot>'


FIRST = JOINT.format("j1", "revolute", "base", "one", LIMIT)
SECOND = JOINT.format("j2", "revolute", "one", "two", LIMIT)

THIRD = JOINT.format("j3", "fixed", "two", "three", "")
TOOL = JOINT.format("mount", "fixed", "three", "tool0", "")


AXES = ("0 0 1", "0 1 0", "0 1 0", "0 0 1", "0 1 0", "0 0 1", "0 1 0")
SERIAL_LINK = """<body pos="0 0 {below:g}"><joint name="j{i}" type="{kind}" axis="{axis}" range="{range}" {joint}/>
<geom type="capsule" fromto="0 0 0 0 0 {length:g}" size="{radius:g}" mass="{mass:g}" contype="0" conaffinity="0"/>"""
SERIAL_MOTOR = '<motor joint="j{i}" gear="{gear:g}" ctrlrange="-{torque:g} {torque:g}"/>'
SERIAL_ARM = """<mujoco><compiler angle="radian"/><option integrator="{integrator}"/>
<worldbody>{links}<site name="tip" pos="0 0 {length:g}"/>{ends}</worldbody><actuator>{motors}</actuator>{home}</mujoco>"""


@dataclass(frozen=True)
class Shape:
    """A serial arm of capsules: length m, mass kg and motor torque N m of its first link; links shrink by `taper`."""

    length: float
    mass: float
    torque: float
    taper: float = 1.0
    gear: float = 1.0
    joint: str = ""
    slides: int = 0
    joints: int = 6
    home: str = ""
    range: str = "-2 2"


SHAPES = {
    "light": Shape(0.02, 0.003, 0.05),  # 1e-8 to 1e-5 kg m^2
    "heavy": Shape(2.0, 200.0, 2e6),  # 1 to 1e4 kg m^2
    "tapering": Shape(0.4, 12.0, 400.0, taper=0.6),  # 1e-7 kg m^2 behind 0.1
    "damped": Shape(0.3, 2.0, 300.0, joint='damping="10"'),
    "geared": Shape(0.3, 2.0, 300.0, gear=-100.0, joint='damping="1" armature="5" frictionloss="3"'),
    "sliding": Shape(0.3, 20.0, 2000.0, taper=0.6, slides=2),
}
# Arms for the laws of controllers: home is away from singularities.
BENT = {
    "planar": Shape(0.3, 2.0, 100.0, joints=3, joint='damping="0.5"', home="0.2 0.5 0.9"),
    "six joints": Shape(0.3, 4.0, 200.0, taper=0.8, joint='armature="0.1" damping="1"', home="0.2 0.4 0.9 -0.3 0.8 0.4"),
    "redundant": Shape(0.25, 4.0, 200.0, taper=0.85, joints=7, joint='armature="0.1"', home="0.2 0.4 0.9 -0.3 0.8 0.4 0.6"),
    "rubbing": Shape(0.3, 4.0, 200.0, joint='armature="0.2" frictionloss="1"', home="0.2 0.4 0.9 -0.3 0.8 0.4"),
}


def serial_arm(folder: Path, shape: Shape, integrator: str = "implicitfast", shapes: str | None = None) -> armctl.Arm:
    links = ""
    motors = ""
    below = 0.0
    for i, axis in enumerate(AXES[: shape.joints]):
        size = shape.taper**i
        length = shape.length * size
        links += SERIAL_LINK.format(
            i=i,
            kind="slide" if i < shape.slides else "hinge",
            axis=axis,
            range=shape.range,
            joint=shape.joint,
            below=below,
            length=length,
            radius=0.1 * length,
            mass=shape.mass * size**3,
        )
        motors += SERIAL_MOTOR.format(i=i, gear=shape.gear, torque=shape.torque * size**4 / abs(shape.gear))
        below = length
    home = f'<keyframe><key name="home" qpos="{shape.home}"/></keyframe>' if shape.home else ""
    ends = "</body>" * shape.joints
    text = SERIAL_ARM.format(integrator=integrator, links=links, length=below, ends=ends, motors=motors, home=home)
    path = folder / "serial.xml"
    path.write_text(text)
    return armctl.load(path, shapes=shapes)


def arm_with_gripper(folder: Path) -> Path:
    """A file: an arm of five joints that points down over a table, with a gripper of two fingers on one actuator."""
    right = '<joint name="right" type="slide" axis="0 -1 0" range="-0.03 0" damping="5"/>'
    tie = '<equality><joint joint1="right" joint2="left" polycoef="0 1 0 0 0"/></equality>'
    return _gripping(folder, (0.3, 0.3, 0.3, 0.06, 0.04), (0.035, right), (0.03, 0.1), "0 0.2 1.7 1.24 0 0 0", tie)


def short_arm_with_jaw(folder: Path) -> Path:
    """A file: a short arm, on a table, whose long tool cannot point straight down over another. One of its two jaws moves."""
    path = _gripping(folder, (0.09, 0.12, 0.12, 0.03, 0.03), (0.012, ""), (0.05, 0.0), "0 0 1.57 1.57 0 0", "", 0.02)
    own_table = '<worldbody><geom name="table" type="box" size="0.2 0.2 0.01" pos="0 0 -0.5"/>'
    path.write_text(path.read_text(encoding="utf-8").replace("<worldbody>", own_table), encoding="utf-8")
    return path


def _gripping(
    folder: Path, lengths: tuple, right: tuple[float, str], fingers: tuple[float, float], home: str, tie: str, base: float = 0.0
) -> Path:
    """An arm with a gripper: place and joint of its right finger; half the length of both, and the height of the tip."""
    axes = ("0 0 1", "0 1 0", "0 1 0", "0 1 0", "0 0 1")
    ranges = ("-3 3", "-1.5 2.5", "-0.2 2.7", "-1 3", "-3 3")
    half, tip = fingers
    bodies = ""
    for k, (axis, bounds) in enumerate(zip(axes, ranges, strict=True)):
        height = base if k == 0 else lengths[k - 1]
        bodies += (
            f'<body pos="0 0 {height}"><joint name="j{k}" axis="{axis}" range="{bounds}" damping="0.5" armature="0.05"/>'
            f'<geom type="capsule" fromto="0 0 0 0 0 {lengths[k]}" size="0.03" mass="1" contype="0" conaffinity="0"/>'
        )
    left = '<joint name="left" type="slide" axis="0 1 0" range="-0.03 0" damping="5"/>'
    for place, joint in ((0.035, left), (-right[0], right[1])):
        bodies += (
            f'<body pos="0 {place} 0.06">{joint}<geom type="box" size="0.01 0.005 {half}" pos="0 0 {half}" mass="0.05"/></body>'
        )
    bodies += f'<site name="tip" pos="0 0 {tip}"/>' + len(axes) * "</body>"
    drives = "".join(f'<motor joint="j{k}" ctrlrange="-80 80"/>' for k in range(len(axes)))
    drives += '<position name="grip" joint="left" kp="1000" ctrlrange="-0.03 0" forcerange="-40 40"/>'
    path = folder / "gripping.xml"
    path.write_text(
        '<mujoco><compiler angle="radian"/><option timestep="0.002" integrator="implicitfast"/>'
        f"<worldbody>{bodies}</worldbody><actuator>{drives}</actuator>{tie}"
        f'<keyframe><key name="home" qpos="{home}"/></keyframe></mujoco>',
        encoding="utf-8",
    )
    return path

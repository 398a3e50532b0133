"""Small synthetic robots, written as text: MJCF from bodies and actuators, URDF from joints."""


def limb(names: str, inside: str = "", joint: str = "", extra: str = "") -> str:
    """Bodies in series, one a hinge: "a b" makes body A with joint a, and on it body B with joint b and what is `inside`."""
    first, *rest = names.split()
    turned = 'axis="0 1 0"' if len(rest) % 2 else 'axis="0 0 1"'
    deeper = limb(" ".join(rest), inside, joint, extra) if rest else inside + extra
    return (
        f'<body name="{first.upper()}" pos="0.1 0 0.1"><joint name="{first}" {turned} range="-2 2" {joint}/>'
        f'<geom type="capsule" fromto="0 0 0 0.1 0 0.1" size="0.02" mass="0.5" contype="0" conaffinity="0"/>{deeper}</body>'
    )


def motors(names: str, **more: str) -> str:
    """One motor a joint; `more` holds actuators instead, such as c='<position joint="c" kp="50"/>'."""
    lines = [more.get(name, f'<motor name="m_{name}" joint="{name}" ctrlrange="-20 20"/>') for name in names.split()]
    return f"<actuator>{''.join(lines)}</actuator>"


def mjcf(bodies: str, rest: str = "") -> str:
    return f'<mujoco model="trap"><compiler angle="radian" autolimits="true"/><worldbody>{bodies}</worldbody>{rest}</mujoco>'


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

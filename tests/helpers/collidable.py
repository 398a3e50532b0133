"""A synthetic arm of six hinges whose links collide, with things of every shape around it."""

import mujoco
import numpy as np

import armctl

LINK = '<geom type="capsule" fromto="0 0 0 0 0 {length}" size="0.04" mass="1"/>'
SHAPES = """
<geom name="plate" type="box" size="0.3 0.3 0.01" pos="0.45 0 0.25"/>
<geom name="post" type="cylinder" size="0.04 0.4" pos="-0.4 0.2 0.4"/>
<geom name="egg" type="ellipsoid" size="0.1 0.06 0.15" pos="0 -0.5 0.5" euler="0.4 0.3 0.2"/>
<geom name="ball" type="sphere" size="0.1" pos="0.2 0.5 0.6"/>
<geom name="rod" type="capsule" size="0.03 0.3" pos="-0.3 -0.4 0.5" euler="1 0.2 0"/>
<geom name="rock" type="mesh" mesh="rock" pos="0.5 0.5 0.1"/>
<geom name="ground" type="plane" size="2 2 0.1" pos="0 0 -0.3"/>
"""


def mjcf(things: str = SHAPES, assets: str = "") -> str:
    """The arm among things that stand in the world."""
    rng = np.random.default_rng(5)
    rock = " ".join(f"{x:.4f}" for x in rng.uniform(-0.15, 0.15, 3 * 60))
    axes = ("0 0 1", "0 1 0", "0 1 0", "1 0 0", "0 1 0", "1 0 0")
    lengths = (0.15, 0.3, 0.25, 0.12, 0.1, 0.08)
    opened = ""
    height = 0.05
    for i, (axis, length) in enumerate(zip(axes, lengths, strict=True)):
        joint = f'<joint name="j{i}" axis="{axis}" range="-2.5 2.5" armature="0.01"/>'
        opened += f'<body name="link{i}" pos="0 0 {height}">{joint}{LINK.format(length=length)}'
        height = length
    arm = f'{opened}<site name="tip" pos="0 0 {height}"/>{"</body>" * len(axes)}'
    motors = "".join(f'<motor joint="j{i}" ctrlrange="-100 100"/>' for i in range(len(axes)))
    return (
        '<mujoco model="collidable"><compiler angle="radian"/>'
        f'<asset><mesh name="rock" vertex="{rock}"/>{assets}</asset>'
        f"<worldbody>{things}{arm}</worldbody><actuator>{motors}</actuator></mujoco>"
    )


def arm_among(folder, things: str = SHAPES, assets: str = "") -> armctl.Arm:
    """The arm, loaded from a file in a folder."""
    path = folder / "collidable.xml"
    path.write_text(mjcf(things, assets))
    return armctl.load(path)


def placed(arm: armctl.Arm, q: np.ndarray) -> mujoco.MjData:
    """MuJoCo's data with the arm at a configuration and its contacts found."""
    data = mujoco.MjData(arm.model)
    data.qpos[:] = arm.qpos(q)
    mujoco.mj_kinematics(arm.model, data)
    mujoco.mj_collision(arm.model, data)
    return data


def capsule_gaps(model: mujoco.MjModel, data: mujoco.MjData, box: int) -> dict[int, float]:
    """How far each capsule is from a box that stands upright, negative where they overlap; not by MuJoCo, which misses some.

    The distance is convex along the axis of a capsule, so golden section finds the least.
    """
    capsules = np.flatnonzero(model.geom_type == int(mujoco.mjtGeom.mjGEOM_CAPSULE))
    axis = data.geom_xmat[capsules].reshape(-1, 3, 3)[:, :, 2] * model.geom_size[capsules, 1, None]
    middle = data.geom_xpos[capsules] - data.geom_xpos[box]
    low = -np.ones(len(capsules))
    high = np.ones(len(capsules))
    ratio = 0.5 * (np.sqrt(5.0) - 1.0)

    def distance(share: np.ndarray) -> np.ndarray:
        return np.linalg.norm(np.maximum(np.abs(middle + share[:, None] * axis) - model.geom_size[box], 0.0), axis=1)

    for _ in range(50):
        first = high - ratio * (high - low)
        second = low + ratio * (high - low)
        is_left = distance(first) < distance(second)
        high = np.where(is_left, second, high)
        low = np.where(is_left, low, first)
    gaps = distance(0.5 * (low + high)) - model.geom_size[capsules, 0]
    return dict(zip(capsules.tolist(), gaps.tolist(), strict=True))

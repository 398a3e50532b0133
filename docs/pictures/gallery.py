"""Draws the page of all robots afresh: `python docs/pictures/gallery.py` writes docs/gallery.md and docs/pictures/robots/.

It draws the bundled arm and every robot of Menagerie that needs no download, at its home.
"""

import contextlib
import copy
import warnings
from pathlib import Path

import mujoco
import mujoco_menagerie as menagerie
import numpy as np
from PIL import Image

import armctl
from armctl.model.loading.catalog import BUNDLED
from armctl.report.render.camera import box_corners, fitted_view

DOCS = Path(__file__).resolve().parents[1]
FOLDER = DOCS / "pictures" / "robots"
SIZE_PIXELS = 400
TURN_RAD = np.radians(35.0)  # from the model's own azimuth: neither from the front nor from the side
ELEVATION_RAD = np.radians(-20.0)
# Of the robots whose names in Menagerie do not say it.
MAKERS = {
    "aloha": "Trossen Robotics",
    "anybotics_anymal_c": "ANYbotics",
    "shadow_hand": "Shadow Robot",
    "trs_so_arm100": "The Robot Studio",
    "ufactory_xarm7": "UFACTORY",
    "wonik_allegro": "Wonik Robotics",
}
HEAD = """# Gallery

Robots that armctl was tested with, as `armctl.load` returns them, at home. Others of MuJoCo Menagerie load in the same way, and
so does [your own](your-robot.md); `armctl robots` prints the names, and [Robots, measured](robots.md) lists every chain.

"""


def installed_robots() -> list[str]:
    """The bundled arm and the robots of Menagerie that are on this computer."""
    store = menagerie.Cache()
    here = [r.name for r in menagerie.robots() if ((store.root / r.name).is_dir() if store.root else store.is_cached(r))]
    return [BUNDLED, *here]


def draw(arms: list[armctl.Arm], path: Path) -> None:
    """A small picture of a robot at home, with all of its arms in it and without the target marker."""
    model = copy.copy(arms[0].model)
    markers = np.flatnonzero(model.body_mocapid >= 0)
    model.geom_rgba[np.isin(model.geom_bodyid, markers), 3] = 0.0
    model.vis.global_.offwidth = model.vis.global_.offheight = 2 * SIZE_PIXELS
    data = mujoco.MjData(model)
    data.qpos[:] = arms[0].qpos(arms[0].home)
    mujoco.mj_forward(model, data)
    corners = np.concatenate([box_corners(arm, data) for arm in arms])
    camera = fitted_view(model, corners, np.radians(model.vis.global_.azimuth) + TURN_RAD, ELEVATION_RAD, 1.0)
    with mujoco.Renderer(model, 2 * SIZE_PIXELS, 2 * SIZE_PIXELS) as renderer:
        renderer.update_scene(data, camera)
        large = Image.fromarray(renderer.render())
    large.resize((SIZE_PIXELS, SIZE_PIXELS)).save(path, quality=80)


def load_chain(robot: str, chain: armctl.SerialChain) -> armctl.Arm:
    """The arm of a chain, with a held base."""
    return armctl.load(robot, tip=chain.tip, base=None if chain.base == "world" else chain.base)


def options(robot: str, arms: list[armctl.Arm]) -> str:
    """What `armctl view` needs besides the name of a robot; it shows all arms of equal length if none is named."""
    tips = [arm.tip for arm in arms if arm.n == arms[0].n]
    for words, tip in (("", None), (f" --tip {tips[0]}", tips[0])):
        with contextlib.suppress(armctl.ArmctlError):
            armctl.load(robot, tip=tip)
            return words
    raise ValueError(f"{robot}: no command shows it")


def cell(robot: str) -> str:
    """The picture, name, joints and command of a robot; empty if nothing on it can be an arm."""
    arms = [load_chain(robot, chain) for chain in armctl.chains(robot) if chain.ok]
    if not arms:
        return ""
    draw(arms, FOLDER / f"{robot}.webp")
    name = "armctl's bundled arm" if robot == BUNDLED else menagerie.get(robot).display_name
    maker = f" by {MAKERS[robot]}" if robot in MAKERS else ""
    most = max(arm.n for arm in arms)
    whole = [arm for arm in arms if 2 * arm.n > most]  # the fingers of a gripper are not counted
    joints = f"{whole[0].n} joints" if len(whole) == 1 else f"{len(whole)} chains"
    return f""":::{{container}}
![{name}](pictures/robots/{robot}.webp)
**{name}**{maker}, {joints}: `armctl view {robot}{options(robot, arms)}`
:::
"""


if __name__ == "__main__":
    FOLDER.mkdir(exist_ok=True)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", armctl.ArmctlWarning)
        cells = [cell(robot) for robot in installed_robots()]
    grid = "\n".join(filter(None, cells))
    (DOCS / "gallery.md").write_text(f"{HEAD}::::{{container}} gallery\n{grid}::::\n", encoding="utf-8")

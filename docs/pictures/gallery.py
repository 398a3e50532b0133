"""Draws the page of all robots afresh: `python docs/pictures/gallery.py` writes docs/gallery.md and docs/pictures/robots/.

It draws the bundled arm and every robot of Menagerie that needs no download, at its home, with one tip marked.
"""

import tempfile
import warnings
from pathlib import Path

import mujoco_menagerie as menagerie
from PIL import Image

import armctl
from armctl.loading.catalog import BUNDLED

DOCS = Path(__file__).resolve().parents[1]
FOLDER = DOCS / "pictures" / "robots"
WIDTH_PIXELS = 400
HEIGHT_PIXELS = 400
HEAD = """# Gallery

Pictures of the robots that armctl was tested with, as `armctl.load` returns them, at their home configuration, with the
target marker at one tip. Other robots of MuJoCo Menagerie load in the same way, and so does [your own](your-robot.md).
[Robots](robots.md) lists every chain with its limits and test results; `armctl robots` prints the names.

"""


def installed_robots() -> list[str]:
    """The bundled arm and the robots of Menagerie that are on this computer."""
    store = menagerie.Cache()
    here = [r.name for r in menagerie.robots() if ((store.root / r.name).is_dir() if store.root else store.is_cached(r))]
    return [BUNDLED, *here]


def draw(arm: armctl.Arm, path: Path) -> None:
    """A small picture of an arm at home."""
    log = armctl.simulate(arm, "computed-torque", armctl.move_j(arm, arm.home, arm.home), dwell=0.01)
    with tempfile.TemporaryDirectory() as folder:
        large = armctl.still(log, arm, Path(folder) / "still.png", size=(2 * WIDTH_PIXELS, 2 * HEIGHT_PIXELS))
        Image.open(large).resize((WIDTH_PIXELS, HEIGHT_PIXELS)).save(path, quality=80)


def load_chain(robot: str, chain: armctl.SerialChain) -> armctl.Arm:
    """The arm of a chain, with a held base."""
    return armctl.load(robot, tip=chain.tip, base=None if chain.base == "world" else chain.base, hold_base=True)


def section(robot: str) -> str:
    """The heading, picture and arms of a robot; empty if nothing on it can be an arm."""
    arms = [load_chain(robot, chain) for chain in armctl.chains(robot) if chain.ok]
    if not arms:
        return ""
    picture = FOLDER / f"{robot}.webp"
    draw(arms[0], picture)
    chains = "\n".join(f"- `{arm.tip}`: {arm.n} joint{'s' if arm.n > 1 else ''}" for arm in arms)
    return f"""## {robot}

```{{image}} pictures/robots/{picture.name}
:alt: {robot} at its home
:width: 300px
```

Tips:

{chains}
"""


if __name__ == "__main__":
    FOLDER.mkdir(exist_ok=True)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", armctl.ArmctlWarning)
        sections = [section(robot) for robot in installed_robots()]
    (DOCS / "gallery.md").write_text(HEAD + "\n".join(filter(None, sections)), encoding="utf-8")

"""The arms that tests run on: those that are installed, without any download, each loaded once per session.

`ARMS` are their names: the bundled arm, every arm of MuJoCo Menagerie under MENAGERIE_ROOT or in its cache, and the chains in
`tests/models/` with what no robot there has: slides, joints without limits, unusual axes and anchors, a URDF. `ROBOTS` are all
installed robots, with legs and hands.
"""

import re
import warnings
from functools import cache
from pathlib import Path

import mujoco_menagerie as menagerie
import pytest

import armctl
from armctl.loading.catalog import BUNDLED
from armctl.loading.datasheets import ALIASES

MODELS = Path(__file__).parent / "models"
MISSING = "its model is not installed"


def at_hand(robot: str) -> bool:
    """Whether a robot of Menagerie can be loaded without a download.

    Args:
        robot: Its name there, or an alias.

    Returns:
        True if its files are here.
    """
    if robot == BUNDLED:
        return True
    store = menagerie.Cache()
    row = menagerie.get(ALIASES.get(robot, robot))
    return (store.root / row.name).is_dir() if store.root else store.is_cached(row)


@cache
def arm_of(name: str) -> armctl.Arm:
    """An arm by name, the same object all session; the test is skipped where its model is not installed.

    Args:
        name: One of `ARMS`, or what `armctl.load` takes; "aloha:left/gripper" is a chain by its tip.

    Returns:
        The arm.
    """
    own = [path for path in MODELS.iterdir() if path.stem == name]
    robot, _, tip = name.partition(":")
    if not own and robot != BUNDLED and not at_hand(robot.partition("/")[0]):
        pytest.skip(f"{name}: {MISSING}")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", armctl.ArmctlWarning)  # a model that leaves something out is no fault of a test
        return armctl.load(own[0] if own else robot, tip=tip or None)


def _chains(robot: str) -> list[str]:
    """A robot with one arm as it is, one with several by their tips."""
    try:
        arm_of(robot)
    except armctl.ModelError as error:
        return [f"{robot}:{tip}" for tip in re.findall(r"'([^']+)'", str(error).partition("tip=:")[2])]
    return [robot]


_SHORT = {name: alias for alias, name in ALIASES.items()}
MENAGERIE_ARMS = [_SHORT.get(r.name, r.name) for r in menagerie.robots("arm") if at_hand(r.name)]
PAIRS = [chain for r in menagerie.robots("dual_arm") if at_hand(r.name) for chain in _chains(r.name)]
ARMS = [BUNDLED, *MENAGERIE_ARMS, *PAIRS, *sorted(path.stem for path in MODELS.iterdir())]
ROBOTS = [BUNDLED, *(_SHORT.get(r.name, r.name) for r in menagerie.robots() if at_hand(r.name))]

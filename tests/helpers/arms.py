"""The arms that tests run on: those that are installed, without any download, each loaded once per session.

`ARMS` are their names: the bundled arm, every arm of MuJoCo Menagerie under MENAGERIE_ROOT or in its cache, and the chains in
`tests/models/` with what no robot there has: slides, joints without limits, unusual axes and anchors, a URDF. `ROBOTS` are all
installed robots, with legs and hands.

All these lists are names, so pytest collects the tests without loading a robot. `arm_of` refuses to load one outside a test.
`make test` runs only some of them: `some_of` marks the others.
"""

import os
import warnings
from collections.abc import Collection, Iterable
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

import mujoco_menagerie as menagerie
import pytest
from synthetic import BENT, serial_arm

import armctl
from armctl.model.loading.catalog import BUNDLED
from armctl.model.loading.datasheets import ALIASES

HELPERS = Path(__file__).parent
MODELS = HELPERS.parent / "models"
CHAINS = ("first", "second")  # of a robot with two arms
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


def arm_of(name: str) -> armctl.Arm:
    """An arm by name, the same object all session; the test is skipped where its model is not installed.

    Args:
        name: One of `ARMS`, of the shapes in `synthetic.BENT`, or what `armctl.load` takes; "aloha:left/gripper" is a chain by
            its tip, and so is "aloha:first".

    Returns:
        The arm.

    Raises:
        RuntimeError: No test runs yet.
    """
    if "PYTEST_CURRENT_TEST" not in os.environ:
        raise RuntimeError(f"{name}: load robots in tests and fixtures; a module that loads one delays every run of pytest")
    robot, _, tip = name.partition(":")
    own = [path for path in MODELS.iterdir() if path.stem == name]
    if not own and name in BENT:  # `planar` is both
        return _synthetic(name)
    if not own and robot != BUNDLED and not at_hand(robot.partition("/")[0]):
        pytest.skip(f"{name}: {MISSING}")
    return _loaded(own[0] if own else robot, tip)


@cache
def _synthetic(name: str) -> armctl.Arm:
    with TemporaryDirectory() as folder:
        return serial_arm(Path(folder), BENT[name])


@cache
def _loaded(robot: str | Path, tip: str) -> armctl.Arm:
    if tip in CHAINS:
        tip = _tips(str(robot))[CHAINS.index(tip)]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", armctl.ArmctlWarning)  # a model that leaves something out is no fault of a test
        return armctl.load(robot, tip=tip or None)


@cache
def _tips(robot: str) -> list[str]:
    """The tips of the longest chains of a robot with several arms."""
    chains = armctl.chains(robot)
    return [chain.tip for chain in chains if chain.ok and len(chain.joint_names) == len(chains[0].joint_names)]


_SHORT = {name: alias for alias, name in ALIASES.items()}
MENAGERIE_ARMS = [_SHORT.get(r.name, r.name) for r in menagerie.robots("arm") if at_hand(r.name)]
PAIRS = [f"{r.name}:{chain}" for r in menagerie.robots("dual_arm") if at_hand(r.name) for chain in CHAINS]
ARMS_WITH_SHAPES = [BUNDLED, *MENAGERIE_ARMS]
ARMS = [BUNDLED, *MENAGERIE_ARMS, *PAIRS, *sorted(path.stem for path in MODELS.iterdir())]
ROBOTS = [BUNDLED, *(_SHORT.get(r.name, r.name) for r in menagerie.robots() if at_hand(r.name))]
# Of the lists above, `make test` runs these: the bundled arm, a redundant one, a robot with legs, and the chains of `MODELS`.
FEW = {BUNDLED, "panda", "unitree_go2", *(path.stem for path in MODELS.iterdir())}
# Those that `make test-all` runs besides: six joints, five, two arms. The nightly job runs all.
MORE = {"ur5e", "so_arm100", "aloha", *(f"aloha:{chain}" for chain in CHAINS[:1])}


def some_of(names: Iterable, few: Collection = frozenset(FEW), full: Collection = frozenset(MORE)) -> list:
    """Parameters of a test, of which only a few belong to `make test`.

    Args:
        names: All of them.
        few: Those that `make test` runs.
        full: Those that `make test-all` runs besides. The nightly job runs all.

    Returns:
        The names; those that are not in `few` with the mark `full` or `nightly`.
    """

    also = list(full)

    def marked(name: object) -> object:
        if name in few:
            return name
        return pytest.param(name, marks=pytest.mark.full if name in also else pytest.mark.nightly)

    return [marked(name) for name in names]

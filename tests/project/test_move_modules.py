"""How much of the package one move passes through."""

import sys
from pathlib import Path
from types import FrameType

import armctl

PACKAGE = Path(armctl.__file__).parent
MOST_MODULES = 48


def entered_modules(sim: armctl.Simulation, target: list[float]) -> set[str]:
    """The modules of armctl of which a move calls a function."""
    entered: set[str] = set()

    def note(frame: FrameType, event: str, _: object) -> None:
        if event == "call":
            entered.add(frame.f_code.co_filename)

    sys.setprofile(note)
    try:
        result = sim.move_to(target)
    finally:
        sys.setprofile(None)
    assert result, result.reason
    return {name for name in entered if Path(name).is_relative_to(PACKAGE)}


def test_a_move_enters_few_modules():
    target = [0.3, 0.2, 0.3]
    arm = armctl.load("robot_arm_3dof")
    names = sorted(str(Path(name).relative_to(PACKAGE)) for name in entered_modules(armctl.Simulation(arm), target))
    assert len(names) <= MOST_MODULES, names

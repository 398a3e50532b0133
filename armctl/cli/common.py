"""What several commands share: arguments, loading, output."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

from armctl.control import CONTROLLERS
from armctl.core.errors import InputError, UnknownNameError

if TYPE_CHECKING:
    from armctl.model.arm.arm import Arm

DONE = 0
NOT_REACHED = 1
WRONG_CALL = 2

PLANTS_HELP = "nominal, payload=1, mass=1.2, friction, delay=2, noise, all, or ARGUMENT=NUMBER of Plant; several joined with +"
_CHAIN_OPTIONS = {
    "--tip": "site, body or geom at the end of the chain; several with commas between them",
    "--base": "body at the start of the chain; joints above it are held",
    "--tool": "gripper, hand or MJCF file to mount at the tip",
    "--scene": "MJCF file of the tables and objects around the robot",
    "--srdf": "SRDF file: allowed contacts, home, and groups for --tip",
    "--shapes": "capsules or visual: what stands for the collision shape of links that have none",
}

Commands = argparse._SubParsersAction  # argparse has no public name for it
Run = Callable[[argparse.Namespace], int]


def add_command(commands: Commands, name: str, run: Run, text: str, examples: Sequence[str]) -> argparse.ArgumentParser:
    """A command; its help ends with examples, of which each is what follows `armctl NAME`."""
    parser = commands.add_parser(name, help=text, description=text)
    parser.set_defaults(run=run, examples=tuple(examples))
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.epilog = "\n".join(["examples:", *(f"  armctl {name} {each}".rstrip() for each in examples)])
    return parser


def add_robot(parser: argparse.ArgumentParser) -> None:
    robot = parser.add_argument("robot", help="bundled name, alias, Menagerie name, or path of an .xml or .urdf file")
    robot.completer = _robot_names  # type: ignore[attr-defined]  # read by argcomplete


def _robot_names(**_: object) -> list[str]:
    from armctl.model.loading.catalog import robots

    return list(robots())


def add_arm(parser: argparse.ArgumentParser, *, several_scenes: bool = False) -> None:
    """Adds the robot's name and the options that select the arm. With several scenes, `scene` is a list."""
    add_robot(parser)
    for option, meaning in _CHAIN_OPTIONS.items():
        if several_scenes and option == "--scene":
            parser.add_argument(option, action="append", default=[], help=f"{meaning}; give several to choose on the page")
        else:
            parser.add_argument(option, help=meaning)


def add_json(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--json", action="store_true", help="print JSON instead of text")


def add_speed(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--speed", metavar="FRACTION", default="1", help="fraction of full speed, in (0, 1] (default 1)")


def add_timestep(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--timestep", help="the control period, s (default the model's)")


def timestep_from(args: argparse.Namespace) -> float | None:
    """The value of --timestep, s; None if it is left out."""
    return one_number("timestep", args.timestep) if args.timestep else None


def list_controllers(parser: argparse.ArgumentParser, *, tunable: bool = False) -> None:
    """Lists the controllers below a command's options: all of them, or those that `tune` takes."""
    shown = [(name, row.summary) for name, row in CONTROLLERS.items() if row.tunable_gains is not None or not tunable]
    listed = "\n".join(["controllers:", *(f"  {name:<26}{summary}" for name, summary in shown)])
    parser.epilog = f"{listed}\n\n{parser.epilog}"


def controllers_from(text: str) -> list[str]:
    """The names of --controllers, checked; "all" is every controller."""
    if text == "all":
        return list(CONTROLLERS)
    controllers = names(text)
    for name in controllers:
        if name not in CONTROLLERS:
            raise UnknownNameError.from_known("controller", name, CONTROLLERS)
    return controllers


def load_arm(args: argparse.Namespace) -> Arm:
    from armctl.model.loading.load import load

    tips = names(args.tip)
    several = len(tips) > 1
    ends: dict[str, Any] = {"tips": tips} if several else {"tip": args.tip}
    return load(args.robot, **ends, base=args.base, tool=args.tool, scene=args.scene, srdf=args.srdf, shapes=args.shapes)


def load_arm_with_notes(args: argparse.Namespace) -> Arm:
    """As `load_arm`, for a command whose text contains all notes of the arm: they are not shown as warnings too."""
    import warnings

    from armctl.core.errors import ArmctlWarning

    with warnings.catch_warnings():
        if not args.json:
            warnings.simplefilter("ignore", ArmctlWarning)
        return load_arm(args)


def numbers(what: str, words: Sequence[str]) -> list[float]:
    """Finite numbers from words; InputError if a word is no number."""
    from armctl.core.validation import vector

    try:
        values = [float(word) for word in words]
    except ValueError:
        raise InputError(f"{what}: {' '.join(words)} is not a list of numbers; write them with spaces between") from None
    return vector(what, values).tolist()


def one_number(what: str, word: str) -> float:
    """A finite number from a word; InputError if it is none."""
    from armctl.core.validation import number

    try:
        value = float(word)
    except ValueError:
        raise InputError(f"{what}: {word!r:.80} is not a number") from None
    return number(what, value)


def speed_from(word: str) -> float:
    speed = one_number("speed", word)
    if not 0.0 < speed <= 1.0:
        raise InputError(f"speed: expected a fraction in (0, 1], got {speed:g}")
    return speed


def names(text: str | None) -> list[str]:
    return [word for word in (text or "").replace(" ", ",").split(",") if word]


def print_result(args: argparse.Namespace, text: str, figures: object, reason: str = "") -> None:
    """Prints text, or JSON with --json. On a terminal longer lines are folded; in a pipe a sentence stays on one line."""
    from armctl.core.tables import folded, terminal_columns

    if args.json:
        print_json(figures, reason)
    else:
        print(folded(text, terminal_columns()) if sys.stdout.isatty() else text)


def print_json(figures: object, reason: str) -> None:
    """Prints what every command prints with --json: one object whose keys are the same after success and failure."""
    print(json.dumps({"ok": not reason, "reason": reason, "result": figures}, indent=2))

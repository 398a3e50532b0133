"""`armctl reachability ROBOT`: which points the arm reaches, with how many orientations."""

from __future__ import annotations

import argparse
from pathlib import Path

from armctl.cli.common import (
    DONE,
    NOT_REACHED,
    Commands,
    add_arm,
    add_command,
    add_json,
    load_arm,
    one_number,
    print_result,
    say_written,
)


def add(commands: Commands) -> None:
    """Adds the command to the parser."""
    parser = add_command(
        commands, "reachability", run, "compute the points that an arm reaches, and with how many orientations"
    )
    add_arm(parser)
    parser.add_argument("--spacing", help="m, between the points (default an eighth of the arm's length)")
    parser.add_argument("--orientations", type=int, help="at each point (default 32, or 0 with fewer than six joints)")
    parser.add_argument("--out", type=Path, metavar="FILE.npz", help="write all figures")
    parser.add_argument("--plot", type=Path, metavar="FILE", help="draw slices into a .png, .svg or .pdf")
    add_json(parser)


def run(args: argparse.Namespace) -> int:
    """Runs the command."""
    from armctl.core.atomic import file_path
    from armctl.core.plotting import ENDINGS
    from armctl.ik.reachability import reachability

    if args.out is not None:
        file_path("out", args.out, (".npz",))
    if args.plot is not None:
        file_path("plot", args.plot, ENDINGS)
    spacing = None if args.spacing is None else one_number("spacing", args.spacing)
    found = reachability(load_arm(args), spacing, args.orientations)
    print_result(args, str(found), found.to_dict(), found.reason)
    if args.out is not None:
        found.save(args.out)
        say_written(args.out)
    if args.plot is not None:
        found.plot(args.plot)
        say_written(args.plot)
    return DONE if found else NOT_REACHED

"""`armctl reachability ROBOT`: which points the arm reaches, with how many orientations."""

import argparse
from pathlib import Path

from armctl.cli import common


def add(commands: common.Commands) -> None:
    parser = common.add_command(
        commands, "reachability", run, "compute the points that an arm reaches, and with how many orientations"
    )
    common.add_arm(parser)
    parser.add_argument("--spacing", help="m, between the points (default an eighth of the arm's length)")
    parser.add_argument("--orientations", type=int, help="at each point (default 32, or 0 with fewer than six joints)")
    parser.add_argument("--out", type=Path, metavar="FILE.npz", help="write all figures")
    parser.add_argument("--plot", type=Path, metavar="FILE", help="draw slices into a .png, .svg or .pdf")
    common.add_json(parser)


def run(args: argparse.Namespace) -> int:
    from armctl.core.atomic import file_path
    from armctl.core.plotting import ENDINGS
    from armctl.plan.ik.reachability import reachability

    if args.out is not None:
        file_path("out", args.out, (".npz",))
    if args.plot is not None:
        file_path("plot", args.plot, ENDINGS)
    spacing = None if args.spacing is None else common.one_number("spacing", args.spacing)
    found = reachability(common.load_arm(args), spacing, args.orientations)
    common.print_result(args, str(found), found.to_dict(), found.reason)
    if args.out is not None:
        found.save(args.out)
        common.say_written(args.out)
    if args.plot is not None:
        found.plot(args.plot)
        common.say_written(args.plot)
    return common.DONE if found else common.NOT_REACHED

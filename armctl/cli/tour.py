"""`armctl tour ROBOT`: what armctl does, on one page of short programs with their films and tables."""

import argparse
from pathlib import Path

from armctl.cli import common, outputs

_EXAMPLES = ("panda", "ur5e --out ur5e.html")


def add(commands: common.Commands) -> None:
    parser = common.add_command(commands, "tour", run, "see what armctl does on one page of short programs", _EXAMPLES)
    common.add_robot(parser)
    parser.add_argument(
        "--out", type=Path, metavar="PATH", help="the page, a file that ends in .html (default tour_ROBOT.html)"
    )


def run(args: argparse.Namespace) -> int:
    from armctl.core.atomic import file_path
    from armctl.core.open_browser import open_browser
    from armctl.lab.tour import write_tour
    from armctl.model.loading.load import load

    out = None if args.out is None else file_path("out", args.out, (".html",))
    arm = load(args.robot)
    path = write_tour(arm, args.robot, out or Path(f"tour_{arm.name}.html"))
    outputs.say_written(path)
    open_browser(path.resolve().as_uri())
    return common.DONE

"""`armctl margins ROBOT`: the delay, gain and phase margins of controllers, and the worst configurations."""

from __future__ import annotations

import argparse
from pathlib import Path

from armctl.cli.common import (
    CONTROLLERS_HELP,
    DONE,
    NOT_REACHED,
    PLANTS_HELP,
    Commands,
    add_arm,
    add_command,
    add_json,
    add_timestep,
    controllers_from,
    load_arm,
    names,
    print_result,
    say_written,
    timestep_from,
)


def add(commands: Commands) -> None:
    """Adds the command to the parser."""
    parser = add_command(commands, "margins", run, "compute the margins of controllers over the workspace")
    add_arm(parser)
    parser.add_argument("--controllers", default="all", metavar="A,B,...", help=f"of {CONTROLLERS_HELP} (default all)")
    parser.add_argument("--plants", default="nominal", metavar="A,B,...", help=f"{PLANTS_HELP} (default nominal)")
    parser.add_argument("--poses", type=int, default=20, help="number of configurations (default 20)")
    add_timestep(parser)
    parser.add_argument(
        "--report", type=Path, metavar="DIR", help="write a page with Nyquist, sensitivity and compliance plots"
    )
    add_json(parser)


def run(args: argparse.Namespace) -> int:
    """Runs the command."""
    from armctl.analysis.margins_html import margins_table, write_margins
    from armctl.cli.plants import plant_by_name
    from armctl.core.progress import progress_bar
    from armctl.design.margins import margins

    arm = load_arm(args)
    timestep = timestep_from(args)
    controllers = controllers_from(args.controllers)
    plants = [plant_by_name(name, arm, timestep) for name in names(args.plants)]
    found = []
    with progress_bar("margins", len(controllers), "controllers") as bar:
        for name in controllers:
            found.append(margins(arm, name, args.poses, plants))
            bar.update()
    reason = next((each.reason for each in found if not each), "")
    print_result(args, margins_table(found).text(), [each.to_dict() for each in found], reason)
    if args.report:
        say_written(write_margins(arm, found, plants, args.report))
    return DONE if all(found) else NOT_REACHED

"""`armctl margins ROBOT`: the delay, gain and phase margins of controllers, and the worst configurations."""

from __future__ import annotations

import argparse
from pathlib import Path

from armctl.cli import common


def add(commands: common.Commands) -> None:
    parser = common.add_command(commands, "margins", run, "compute the margins of controllers over the workspace")
    common.add_arm(parser)
    parser.add_argument("--controllers", default="all", metavar="A,B,...", help=f"of {common.CONTROLLERS_HELP} (default all)")
    parser.add_argument("--plants", default="nominal", metavar="A,B,...", help=f"{common.PLANTS_HELP} (default nominal)")
    parser.add_argument("--poses", type=int, default=20, help="number of configurations (default 20)")
    common.add_timestep(parser)
    parser.add_argument(
        "--report", type=Path, metavar="DIR", help="write a page with Nyquist, sensitivity and compliance plots"
    )
    common.add_json(parser)


def run(args: argparse.Namespace) -> int:
    from armctl.analysis.margins_html import margins_table, write_margins
    from armctl.cli.plants import plant_by_name
    from armctl.core.progress import progress_bar
    from armctl.design.margins import margins

    arm = common.load_arm(args)
    timestep = common.timestep_from(args)
    controllers = common.controllers_from(args.controllers)
    plants = [plant_by_name(name, arm, timestep) for name in common.names(args.plants)]
    found = []
    with progress_bar("margins", len(controllers), "controllers") as bar:
        for name in controllers:
            found.append(margins(arm, name, args.poses, plants))
            bar.update()
    reason = next((each.reason for each in found if not each), "")
    common.print_result(args, margins_table(found).text(), [each.to_dict() for each in found], reason)
    if args.report:
        common.say_written(write_margins(arm, found, plants, args.report))
    return common.DONE if all(found) else common.NOT_REACHED

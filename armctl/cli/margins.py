"""`armctl margins ROBOT` and `armctl tune ROBOT LAW`: how robust controllers are, and their highest gains within bounds."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

from armctl.cli import common, outputs
from armctl.core.defaults import MAX_PEAK_SENSITIVITY, MIN_DELAY_MARGIN_S

if TYPE_CHECKING:
    from armctl.model.arm.arm import Arm
    from armctl.run.sim.plant import Plant

_MARGINS_EXAMPLES = (
    "panda",
    "panda --controllers pd,computed-torque --plants nominal,delay=2 --out margins.html",
)
_TUNE_EXAMPLES = (
    "panda pd-gravity",
    "panda computed-torque --delay-margin 0.01 --plants nominal,payload=1",
)


def add(commands: common.Commands) -> None:
    margins = common.add_command(
        commands, "margins", compute_margins, "compute the margins of controllers over the workspace", _MARGINS_EXAMPLES
    )
    tune = common.add_command(
        commands, "tune", tune_law, "find the highest gains of a controller within bounds on its margins", _TUNE_EXAMPLES
    )
    for parser in (margins, tune):
        common.add_arm(parser)
        parser.add_argument("--plants", default="nominal", metavar="A,B,...", help=f"{common.PLANTS_HELP} (default nominal)")
        parser.add_argument("--configurations", type=int, metavar="N", default=20, help="number of configurations (default 20)")
        common.add_timestep(parser)
        common.add_json(parser)
    margins.add_argument("--controllers", default="all", metavar="A,B,...", help="some of those below (default all)")
    common.list_controllers(margins)
    outputs.add_out(margins, "a page with Nyquist, sensitivity and compliance plots", [".html"])
    tune.add_argument("law", help="the controller, one of those below")
    common.list_controllers(tune, tunable=True)
    tune.add_argument(
        "--delay-margin",
        default=str(MIN_DELAY_MARGIN_S),
        metavar="S",
        help=f"the smallest permitted one (default {MIN_DELAY_MARGIN_S})",
    )
    tune.add_argument(
        "--peak-sensitivity",
        default=str(MAX_PEAK_SENSITIVITY),
        metavar="MS",
        help=f"the largest permitted one (default {MAX_PEAK_SENSITIVITY})",
    )
    tune.add_argument("--chatter", metavar="NM", help="the largest permitted torque noise with an encoder of 1e-5 rad")


def _arm_and_plants(args: argparse.Namespace) -> tuple[Arm, list[Plant]]:
    from armctl.cli.plants import plant_by_name

    arm = common.load_arm(args)
    timestep = common.timestep_from(args)
    return arm, [plant_by_name(name, arm, timestep) for name in common.names(args.plants)]


def compute_margins(args: argparse.Namespace) -> int:
    from armctl.core.progress import progress_bar
    from armctl.lab.loops.margins import margins
    from armctl.lab.loops.margins_html import margins_table, write_margins

    outputs.check_out(args)
    arm, plants = _arm_and_plants(args)
    controllers = common.controllers_from(args.controllers)
    found = []
    with progress_bar("margins", len(controllers), "controllers") as bar:
        for name in controllers:
            found.append(margins(arm, name, args.configurations, plants))
            bar.update()
    reason = next((each.reason for each in found if not each), "")
    common.print_result(args, margins_table(found).text(), [each.to_dict() for each in found], reason)
    page = outputs.Output("margins.html", (".html",), lambda path: write_margins(arm, found, plants, path))
    outputs.write_outputs(args, [page])
    return common.DONE if all(found) else common.NOT_REACHED


def tune_law(args: argparse.Namespace) -> int:
    from armctl.lab.loops.tuning import tune

    arm, plants = _arm_and_plants(args)
    found = tune(
        arm,
        args.law,
        common.one_number("delay_margin", args.delay_margin),
        common.one_number("peak_sensitivity", args.peak_sensitivity),
        common.one_number("chatter", args.chatter) if args.chatter else None,
        args.configurations,
        plants,
    )
    common.print_result(args, str(found), found.to_dict(), found.reason)
    return common.DONE if found else common.NOT_REACHED

"""`armctl compare ROBOT`: the same motion under several controllers, on several plants."""

from __future__ import annotations

import argparse
import os
import re
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

from armctl.cli import common, outputs
from armctl.control import CONTROLLERS

if TYPE_CHECKING:
    from armctl.control.interface import Controller
    from armctl.model.arm.arm import Arm
    from armctl.report.report import Report
    from armctl.run.sim.plant import Plant

_MAX_PREFIX_CHARACTERS = 120  # file systems allow 255 bytes for a name

_EXAMPLES = (
    "panda",
    "panda --controllers all --plants nominal,payload=1,delay=2 --out run",
    "ur5e --delay-margin 0.01 --json",
)


def add(commands: common.Commands) -> None:
    parser = common.add_command(commands, "compare", run, "follow the same motion under several controllers", _EXAMPLES)
    common.add_arm(parser)
    parser.add_argument(
        "--controllers",
        default="pd,computed-torque",
        metavar="A,B,...",
        help="all, or some of those below (default %(default)s)",
    )
    common.list_controllers(parser)
    parser.add_argument("--plants", default="nominal", metavar="A,B,...", help=f"{common.PLANTS_HELP} (default nominal)")
    parser.add_argument(
        "--encoder-noise",
        metavar="RAD",
        default="1e-5",
        help="of plants without noise of their own, in rad; velocities are position differences (default %(default)s)",
    )
    parser.add_argument(
        "--configurations",
        type=int,
        metavar="N",
        default=5,
        help="number of configurations at which margins are computed, 0 for none (default %(default)s)",
    )
    parser.add_argument(
        "--dwell",
        metavar="S",
        default="10",
        help="seconds for which the end is held at most, until the arm rests (default %(default)s)",
    )
    parser.add_argument(
        "--delay-margin",
        metavar="S",
        help="tune every controller to this delay margin first, as armctl tune does (default: its default gains)",
    )
    common.add_timestep(parser)
    parser.add_argument(
        "--threads",
        type=int,
        metavar="N",
        default=os.cpu_count() or 1,
        help="number of threads (default one per processor core)",
    )
    common.add_speed(parser)
    common.add_json(parser)
    outputs.add_out(parser, "the table as JSON, Markdown and a page, and the log and plot of each run")


def run(args: argparse.Namespace) -> int:
    speed = common.speed_from(args.speed)
    from armctl.cli.plants import plant_by_name
    from armctl.core.validation import number
    from armctl.lab.comparison import compare, out_and_back, remarks
    from armctl.lab.comparison_html import write_comparison
    from armctl.report.report import report_table

    arm = common.load_arm(args)
    timestep = common.timestep_from(args)
    controllers = common.controllers_from(args.controllers)
    noise = number("encoder_noise", common.one_number("encoder_noise", args.encoder_noise), 0.0)
    dwell = number("dwell", common.one_number("dwell", args.dwell), 0.0)
    plants = [plant_by_name(name, arm, timestep) for name in common.names(args.plants)]
    plants = [each if each.encoder_noise else replace(each, encoder_noise=noise, name=str(each)) for each in plants]
    folders = outputs.make_folders(args)  # one that cannot be made is reported before the runs
    laws, notes = _tuned(args, arm, controllers, plants) if args.delay_margin else (controllers, [])
    motion = out_and_back(arm, speed=speed)
    reports = compare(arm, laws, motion, plants, threads=args.threads, configurations=args.configurations, dwell=dwell)
    notes += remarks(reports)
    if notes:
        notes.append("")
    common.print_result(args, "\n".join([*notes, report_table(reports).text(keys=2)]), [r.to_dict() for r in reports])
    for folder in folders:
        for path in write_comparison(reports, folder, "All joints out and back", film_of=arm):
            outputs.say_written(path)
    for report, prefix in zip(reports, _file_prefixes(reports), strict=True):
        outputs.write_outputs(args, outputs.report_outputs(report, prefix))
    return common.DONE


def _tuned(
    args: argparse.Namespace, arm: Arm, names: Sequence[str], plants: Sequence[Plant]
) -> tuple[list[Controller | str], list[str]]:
    """The controllers tuned to the delay margin on all plants, and a remark on each that keeps its default gains."""
    from armctl.core.progress import progress_bar
    from armctl.lab.loops.tuning import tune

    delay_margin = common.one_number("delay_margin", args.delay_margin)
    controllers: list[Controller | str] = []
    notes: list[str] = []
    with progress_bar("tune", len(names), "controllers") as bar:
        for name in names:
            is_tunable = CONTROLLERS[name].tunable_gains is not None
            found = (
                tune(arm, name, delay_margin, configurations=args.configurations or 1, plants=plants) if is_tunable else None
            )
            controllers.append(name if found is None else found.controller)
            if not found:
                notes.append(f"{name} has its default gains: {'it has no gains to tune' if found is None else found.reason}")
            bar.update()
    return controllers, notes


def _file_prefixes(reports: Sequence[Report]) -> list[str]:
    """A distinct beginning of a file name for each run: its controller, and its plant if there are several."""
    several_plants = len({report.plant for report in reports}) > 1
    prefixes: list[str] = []
    for report in reports:
        label = f"{report.controller}-{report.plant}" if several_plants else report.controller
        prefix = re.sub(r"[^\w.=+-]+", "_", label)[:_MAX_PREFIX_CHARACTERS]
        while f"{prefix}-" in prefixes:
            prefix += "_"
        prefixes.append(f"{prefix}-")
    return prefixes

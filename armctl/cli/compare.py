"""`armctl compare ROBOT`: the same motion under several controllers, on several plants, or on a robot beside its simulation."""

from __future__ import annotations

import argparse
import os
import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from armctl.cli import common, outputs
from armctl.cli.robot import add_link, link_from
from armctl.control import CONTROLLERS
from armctl.core.errors import InputError

if TYPE_CHECKING:
    from armctl.control.interface import Controller
    from armctl.model.arm.arm import Arm
    from armctl.report.report import Report
    from armctl.run.links.link import Link
    from armctl.run.sim.plant import Plant

_MAX_PREFIX_CHARACTERS = 120  # file systems allow 255 bytes for a name

_EXAMPLES = (
    "panda",
    "panda --controllers all --plants nominal,payload=1,delay=2 --out run",
    "ur5e --delay-margin 0.01 --json",
    "fr3 --robot 172.16.0.2 --controllers pd-gravity,computed-torque --identify",
)
_OF_ROBOT = ("link", "calibration", "payload", "no_real_time", "tip_speed", "identify")
_PLANTS = "nominal"
_SPEED = "1"
_ROBOT_SPEED = "0.2"
_DWELL_S = "10"
_ROBOT_DWELL_S = "1"


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
    parser.add_argument("--plants", default=_PLANTS, metavar="A,B,...", help=f"{common.PLANTS_HELP} (default %(default)s)")
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
        help="seconds for which the end is held at most, until the arm rests (default 10); on a robot all of them (default 1)",
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
    parser.add_argument("--speed", metavar="FRACTION", help="fraction of full speed, in (0, 1] (default 1, on a robot 0.2)")
    parser.add_argument(
        "--robot",
        dest="host",
        metavar="HOST",
        help="run the motion on a robot that takes torques, and in its simulation: the address of the robot",
    )
    add_link(parser)
    parser.add_argument("--tip-speed", metavar="M/S", default="0.25", help="greatest speed of a robot's tip (default 0.25)")
    parser.add_argument(
        "--identify", action="store_true", help="identify the arm from one more run of the robot, and compare again"
    )
    parser.set_defaults(of_robot={name: parser.get_default(name) for name in _OF_ROBOT})
    common.add_json(parser)
    outputs.add_out(parser, "the table as JSON, Markdown and a page, and the log and plot of each run")


def run(args: argparse.Namespace) -> int:
    speed = common.speed_from(args.speed or (_ROBOT_SPEED if args.host else _SPEED))
    if args.host:
        return _on_robot(args, speed)
    for name, default in args.of_robot.items():
        if getattr(args, name) != default:
            instead = "; --plants simulates a load" if name == "payload" else ""
            raise InputError(f"{name}: it is for a robot; give --robot HOST{instead}")
    from armctl.lab.comparison import compare, out_and_back, remarks

    arm = common.load_arm(args)
    plants = _plants(args, arm)
    controllers = common.controllers_from(args.controllers)
    dwell = _dwell(args)
    folders = outputs.make_folders(args)  # one that cannot be made is reported before the runs
    laws, notes = _tuned(args, arm, controllers, plants) if args.delay_margin else (controllers, [])
    motion = out_and_back(arm, speed=speed)
    reports = compare(arm, laws, motion, plants, threads=args.threads, configurations=args.configurations, dwell=dwell)
    _give(args, arm, reports, notes + remarks(reports), folders)
    return common.DONE


def _on_robot(args: argparse.Namespace, speed: float) -> int:
    """Compares on a robot, and in its simulation. As in a comparison on plants, a law that fails is a row and no error."""
    tip_speed = common.one_number("tip_speed", args.tip_speed)
    payload = common.one_number("payload", args.payload)
    dwell = _dwell(args)
    if args.delay_margin:
        raise InputError(
            "delay_margin: on a robot, laws have their default gains; leave it out, or use armctl.compare_on_robot"
        )
    from armctl.lab.robot_comparison import compare_on_robot
    from armctl.run.links.plant_link import PlantLink

    arm = common.load_arm(args)
    controllers = common.controllers_from(args.controllers)
    plants = _plants(args, arm)
    if args.link == "plant":
        if len(plants) != 1:
            raise InputError(f"plants: a simulated robot is one plant, got {len(plants)}")
        link: Link = PlantLink(arm, plants[0], payload=payload, real_time=True)
    elif args.plants != _PLANTS or args.timestep:
        raise InputError("plants: a robot is what it is; leave --plants and --timestep out, or give --link plant")
    else:
        link = link_from(args, arm, payload)
    folders = outputs.make_folders(args)
    reports = compare_on_robot(
        arm,
        link,
        controllers,
        identified=args.identify,
        speed=speed,
        tip_speed=tip_speed,
        payload=payload,
        configurations=args.configurations,
        dwell=dwell,
    )
    _give(args, arm, reports, reports.remarks(), folders)
    return common.DONE


def _plants(args: argparse.Namespace, arm: Arm) -> list[Plant]:
    from armctl.cli.plants import plant_by_name
    from armctl.core.validation import number

    timestep = common.timestep_from(args)
    noise = number("encoder_noise", common.one_number("encoder_noise", args.encoder_noise), 0.0)
    plants = [plant_by_name(name, arm, timestep) for name in common.names(args.plants)]
    return [each if each.encoder_noise else replace(each, encoder_noise=noise, name=str(each)) for each in plants]


def _dwell(args: argparse.Namespace) -> float:
    from armctl.core.validation import number

    default = _ROBOT_DWELL_S if args.host else _DWELL_S
    return number("dwell", common.one_number("dwell", args.dwell or default), 0.0)


def _give(args: argparse.Namespace, arm: Arm, reports: Sequence[Report], notes: list[str], folders: Sequence[Path]) -> None:
    """Prints notes and the table, and writes the files."""
    from armctl.lab.comparison_html import write_comparison
    from armctl.report.report import report_table

    if notes:
        notes.append("")
    common.print_result(args, "\n".join([*notes, report_table(reports).text(keys=2)]), [r.to_dict() for r in reports])
    for folder in folders:
        for path in write_comparison(reports, folder, "All joints out and back", film_of=arm):
            outputs.say_written(path)
    begun = [report for report in reports if len(report.log)]
    for report, prefix in zip(begun, _file_prefixes(begun), strict=True):
        outputs.write_outputs(args, outputs.report_outputs(report, prefix))


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

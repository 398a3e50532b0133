"""`armctl simulate ROBOT --ctrl ...`: constant controls."""

import argparse
from pathlib import Path

from armctl.cli import common


def add(commands: common.Commands) -> None:
    parser = common.add_command(commands, "simulate", run, "simulate the arm under constant motor controls")
    common.add_arm(parser)
    parser.add_argument("--ctrl", nargs="+", required=True, metavar="N", help="one control per motor; torque = gear x control")
    parser.add_argument("--duration", default="2", help="how long, s (default 2)")
    parser.add_argument("--plot", type=Path, metavar="PATH", help="draw the run: a picture, or a folder for it")
    common.add_json(parser)


def run(args: argparse.Namespace) -> int:
    from armctl.cli.describe import describe_end
    from armctl.core.atomic import file_path
    from armctl.core.plotting import ENDINGS
    from armctl.report.plot import four_panels
    from armctl.run.sim.simulation import Simulation

    if args.plot is not None and args.plot.suffix and not args.plot.is_dir():
        file_path("plot", args.plot, ENDINGS)
    arm = common.load_arm_with_notes(args)
    log = Simulation(arm).apply_ctrl(common.numbers("ctrl", args.ctrl), common.one_number("duration", args.duration))
    columns = {"q": log.q, "v": log.v, "tau": log.tau}
    joints = {k: dict(zip(log.joint_names, column[-1].round(6).tolist(), strict=True)) for k, column in columns.items()}
    last = {"t": log.t[-1], **joints, "tip": log.tip[-1].round(6).tolist()}
    lines = [describe_end(log), *(f"note: {note}" for note in arm.notes)]
    common.print_result(args, "\n".join(lines), last | {"notes": list(arm.notes)}, log.failure)
    if args.plot:
        picture = args.plot if args.plot.suffix in ENDINGS else args.plot / f"{args.robot.replace('/', '_')}.png"
        four_panels(log, picture)
        common.say_written(picture)
    return common.NOT_REACHED if log.failure else common.DONE

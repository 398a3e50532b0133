"""`armctl simulate ROBOT --ctrl ...`: constant controls."""

import argparse

from armctl.cli import common, outputs
from armctl.core.defaults import PICTURE_ENDINGS

_EXAMPLES = (
    "robot_arm_3dof --ctrl 0.5 -0.3 -0.2",
    "robot_arm_3dof --ctrl 0 0 0 --duration 5 --out plot.svg",
)


def add(commands: common.Commands) -> None:
    parser = common.add_command(commands, "simulate", run, "simulate the arm under constant motor controls", _EXAMPLES)
    common.add_arm(parser)
    parser.add_argument("--ctrl", nargs="+", required=True, metavar="N", help="one control per motor; torque = gear x control")
    parser.add_argument("--duration", default="2", help="how long, s (default 2)")
    outputs.add_out(parser, "the log and its plot", [".npz", ".csv", *PICTURE_ENDINGS])
    common.add_json(parser)


def run(args: argparse.Namespace) -> int:
    from armctl.cli.describe import describe_end
    from armctl.report.plot import four_panels
    from armctl.run.sim.simulation import Simulation

    outputs.check_out(args)
    arm = common.load_arm_with_notes(args)
    log = Simulation(arm).apply_ctrl(common.numbers("ctrl", args.ctrl), common.one_number("duration", args.duration))
    columns = {"q": log.q, "v": log.v, "tau": log.tau}
    joints = {k: dict(zip(log.joint_names, column[-1].round(6).tolist(), strict=True)) for k, column in columns.items()}
    last = {"t": log.t[-1], **joints, "tip": log.tip[-1].round(6).tolist()}
    lines = [describe_end(log), *(f"note: {note}" for note in arm.notes)]
    common.print_result(args, "\n".join(lines), last | {"notes": list(arm.notes)}, log.failure)
    logs = [outputs.Output(f"log{ending}", (ending,), log.save) for ending in (".npz", ".csv")]
    outputs.write_outputs(args, [*logs, *outputs.plot_outputs(lambda path: four_panels(log, path))])
    return common.NOT_REACHED if log.failure else common.DONE

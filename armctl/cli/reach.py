"""`armctl reach ROBOT`: the tip moves to a target, and a report."""

import argparse
import math
from collections.abc import Sequence

from armctl.cli import common, outputs
from armctl.core.defaults import FILM_ENDINGS, PICTURE_ENDINGS
from armctl.core.errors import InputError, LimitError

_EXAMPLES = (
    "panda --target 0.5 0.2 0.4",
    "panda --target 0.5 0.2 0.4 3.14 0 0 --controller computed-torque-observer --out run",
    "ur5e --out reach.mp4",
)


def add(commands: common.Commands) -> None:
    parser = common.add_command(commands, "reach", run, "move the tip to a target and report", _EXAMPLES)
    common.add_arm(parser)
    parser.add_argument("--target", nargs="+", metavar="N", help="x y z in m, optionally with roll pitch yaw in rad")
    parser.add_argument(
        "--allow", action="append", default=[], metavar="A,B", help="two bodies or geoms that may touch, such as cube,table"
    )
    parser.add_argument("--controller", default="computed-torque", help="one of those below (default %(default)s)")
    common.list_controllers(parser)
    parser.add_argument("--video-speed", metavar="X", default="1", help="speed of the film; 0.5 is slow motion (default 1)")
    common.add_speed(parser)
    common.add_json(parser)
    outputs.add_out(parser, "log, figures and plots", [".npz", ".csv", ".json", *PICTURE_ENDINGS, *FILM_ENDINGS])


def run(args: argparse.Namespace) -> int:
    speed = common.speed_from(args.speed)
    from armctl.core.validation import number
    from armctl.report.render import film_path
    from armctl.report.report import Report
    from armctl.run.sim.simulation import Simulation

    outputs.check_out(args)
    for path in args.out:
        if path.suffix in FILM_ENDINGS:
            film_path(path, "out")
    video_speed = number("video_speed", common.one_number("video_speed", args.video_speed), 0.01, 100.0)
    allow = [_pair(words) for words in args.allow]
    simulation = Simulation(common.load_arm(args), args.controller)
    target = simulation.target if args.target is None else _target(args.target)
    result = simulation.move_to(target, speed=speed, allow=allow)
    if result.log is None:
        common.print_result(args, str(result), None, result.reason)
        return common.NOT_REACHED
    report = Report.from_log(result.log)
    common.print_result(args, str(report), report.to_dict(), result.reason or report.reason)
    film = outputs.Output("", FILM_ENDINGS, lambda path: simulation.record(path, speed=video_speed))
    outputs.write_outputs(args, [*outputs.report_outputs(report), film])
    return common.DONE if result and report else common.NOT_REACHED


def _pair(words: str) -> tuple[str, str]:
    first, _, second = words.partition(",")
    if not (first and second) or "," in second:
        raise InputError(f"allow: expected two names with a comma between them, such as cube,table, got {words!r:.80}")
    return first, second


def _target(words: Sequence[str]):
    from armctl.core.pose import Pose

    values = common.numbers("target", words)
    if len(values) not in (3, 6):
        raise InputError(f"target: expected x y z or x y z roll pitch yaw, got {len(values)} numbers")
    angle = max(values[3:], key=abs, default=0.0)
    if abs(angle) > math.tau:
        raise LimitError(f"target: {angle:g} rad is more than a turn; {angle:g} degrees are {math.radians(angle):.4f} rad")
    return Pose(values[:3], rpy=values[3:]) if len(values) == 6 else values

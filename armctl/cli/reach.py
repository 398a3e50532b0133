"""`armctl reach ROBOT`: the tip moves to a target, and a report."""

from __future__ import annotations

import argparse
import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

from armctl.cli import common, outputs
from armctl.core.defaults import FILM_ENDINGS, PICTURE_ENDINGS
from armctl.core.errors import InputError, LimitError, few_names

if TYPE_CHECKING:
    from armctl.core.target import TargetLike
    from armctl.core.tip_targets import TipTarget, TipTargets
    from armctl.run.sim.simulation import Simulation

_EXAMPLES = (
    "panda --target 0.5 0.2 0.4",
    "panda --target 0.5 0.2 0.4 3.14 0 0 --controller computed-torque-observer --out run",
    "ur5e --plant payload=2+friction --controller pd-gravity",
    "ur5e --out reach.mp4",
    "aloha --target left/gripper 0 0.05 0.65 --target right/gripper stay",
)


def add(commands: common.Commands) -> None:
    parser = common.add_command(commands, "reach", run, "move the tip to a target and report", _EXAMPLES)
    common.add_arm(parser)
    parser.add_argument(
        "--target",
        nargs="+",
        action="append",
        metavar="N",
        help="x y z in m, optionally with roll pitch yaw in rad; of a robot with several tips after the name of one, "
        "given for each that has a target, or `stay`",
    )
    parser.add_argument(
        "--allow", action="append", default=[], metavar="A,B", help="two bodies or geoms that may touch, such as cube,table"
    )
    parser.add_argument("--controller", default="computed-torque", help="one of those below (default %(default)s)")
    common.list_controllers(parser)
    parser.add_argument("--plant", default="nominal", metavar="A+B", help=f"{common.PLANTS_HELP} (default %(default)s)")
    parser.add_argument("--video-speed", metavar="X", default="1", help="speed of the film; 0.5 is slow motion (default 1)")
    common.add_speed(parser)
    common.add_json(parser)
    outputs.add_out(parser, "log, figures and plots", [".npz", ".csv", ".json", *PICTURE_ENDINGS, *FILM_ENDINGS])


def run(args: argparse.Namespace) -> int:
    speed = common.speed_from(args.speed)
    from armctl.cli.plants import plant_by_name
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
    arm = common.load_arm(args)
    simulation = Simulation(arm, args.controller, plant_by_name(args.plant, arm))
    result = simulation.move_to(_targets(simulation, args.target), speed=speed, allow=allow)
    if result.log is None:
        common.print_result(args, str(result), None, result.reason)
        return common.NOT_REACHED
    report = Report.from_log(result.log)
    figures = report.to_dict() | ({"tip_errors": result.tip_errors} if result.tip_errors else {})
    common.print_result(args, str(report), figures, result.reason or report.reason)
    film = outputs.Output("", FILM_ENDINGS, lambda path: simulation.record(path, speed=video_speed))
    outputs.write_outputs(args, [*outputs.report_outputs(report), film])
    return common.DONE if result and report else common.NOT_REACHED


def _pair(words: str) -> tuple[str, str]:
    first, _, second = words.partition(",")
    if not (first and second) or "," in second:
        raise InputError(f"allow: expected two names with a comma between them, such as cube,table, got {words!r:.80}")
    return first, second


def _targets(simulation: Simulation, given: Sequence[Sequence[str]] | None) -> TargetLike | TipTargets:
    """The target of an arm with one tip, or those of several by tip."""
    from armctl.core.tip_targets import STAY

    arm = simulation.arm
    if not arm.further_tips:
        if given is None:
            return simulation.target
        if len(given) > 1:
            raise InputError(f"target: {len(given)} targets for the tip {arm.tip!r:.80}; give one")
        return _target(given[0])
    example = f"--target {arm.tip:.80} x y z"
    if given is None:
        raise InputError(f"target: {arm.name:.60} has {len(arm.tips)} tips; give a target for any of them: {example}")
    targets: dict[str, TipTarget] = {}
    for name, *words in given:
        if name not in arm.tips:
            known = few_names(arm.tips)
            raise InputError(f"target: expected the tip that it is for, {known}, before its numbers, got {name!r:.80}")
        if name in targets:
            raise InputError(f"target: {name!r:.80} has two targets; give one")
        targets[name] = STAY if words == ["stay"] else _target(words)
    return targets


def _target(words: Sequence[str]) -> TargetLike:
    from armctl.core.pose import Pose

    values = common.numbers("target", words)
    if len(values) not in (3, 6):
        raise InputError(f"target: expected x y z or x y z roll pitch yaw, got {len(values)} numbers")
    angle = max(values[3:], key=abs, default=0.0)
    if abs(angle) > math.tau:
        raise LimitError(f"target: {angle:g} rad is more than a turn; {angle:g} degrees are {math.radians(angle):.4f} rad")
    return Pose(values[:3], rpy=values[3:]) if len(values) == 6 else values

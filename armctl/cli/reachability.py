"""`armctl reachability ROBOT`: which points the arm reaches, with how many orientations."""

import argparse

from armctl.cli import common, outputs
from armctl.core.defaults import PICTURE_ENDINGS

_EXAMPLES = (
    "robot_arm_3dof",
    "panda --out reach.png --out reach.npz",
)


def add(commands: common.Commands) -> None:
    parser = common.add_command(
        commands, "reachability", run, "compute the points that an arm reaches, and with how many orientations", _EXAMPLES
    )
    common.add_arm(parser)
    parser.add_argument("--spacing", help="m, between the points (default an eighth of the arm's length)")
    parser.add_argument("--orientations", type=int, help="at each point (default 32, or 0 with fewer than six joints)")
    outputs.add_out(parser, "all figures and a plot of slices", [".npz", *PICTURE_ENDINGS])
    common.add_json(parser)


def run(args: argparse.Namespace) -> int:
    from armctl.plan.ik.reachability import reachability

    outputs.check_out(args)
    spacing = None if args.spacing is None else common.one_number("spacing", args.spacing)
    found = reachability(common.load_arm(args), spacing, args.orientations)
    common.print_result(args, str(found), found.to_dict(), found.reason)
    figures = outputs.Output("reachability.npz", (".npz",), found.save)
    outputs.write_outputs(args, [figures, *outputs.plot_outputs(found.plot)])
    return common.DONE if found else common.NOT_REACHED

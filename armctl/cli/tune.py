"""`armctl tune ROBOT LAW`: the highest gains of a control law within bounds on its margins."""

from __future__ import annotations

import argparse

from armctl.cli import common


def add(commands: common.Commands) -> None:
    parser = common.add_command(commands, "tune", run, "find the highest gains of a controller within bounds on its margins")
    common.add_arm(parser)
    parser.add_argument("law", help=f"the controller, of {common.CONTROLLERS_HELP}")
    parser.add_argument("--delay-margin", default="0.005", metavar="S", help="the smallest permitted one (default 0.005)")
    parser.add_argument("--peak-sensitivity", default="1.7", metavar="MS", help="the largest permitted one (default 1.7)")
    parser.add_argument("--chatter", metavar="NM", help="the largest permitted torque noise with an encoder of 1e-5 rad")
    parser.add_argument("--plants", default="nominal", metavar="A,B,...", help=f"{common.PLANTS_HELP} (default nominal)")
    parser.add_argument("--poses", type=int, default=20, help="number of configurations (default 20)")
    common.add_timestep(parser)
    common.add_json(parser)


def run(args: argparse.Namespace) -> int:
    from armctl.cli.plants import plant_by_name
    from armctl.design.tuning import tune

    arm = common.load_arm(args)
    timestep = common.timestep_from(args)
    plants = [plant_by_name(name, arm, timestep) for name in common.names(args.plants)]
    found = tune(
        arm,
        args.law,
        common.one_number("delay_margin", args.delay_margin),
        common.one_number("peak_sensitivity", args.peak_sensitivity),
        common.one_number("chatter", args.chatter) if args.chatter else None,
        args.poses,
        plants,
    )
    common.print_result(args, str(found), found.to_dict(), found.reason)
    return common.DONE if found else common.NOT_REACHED

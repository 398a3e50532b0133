"""`armctl iso9283 ROBOT`: pose and path accuracy."""

import argparse
import sys

from armctl.cli import common

_STANDARD_SPEEDS = (1.0, 0.5, 0.1)

_EXAMPLES = (
    "panda",
    "panda --plant payload=1+noise --identify --all-speeds",
)


def add(commands: common.Commands) -> None:
    parser = common.add_command(commands, "iso9283", run, "measure the performance criteria of ISO 9283", _EXAMPLES)
    common.add_arm(parser)
    parser.add_argument("--controller", default="computed-torque-observer", help="one of those below (default %(default)s)")
    common.list_controllers(parser)
    parser.add_argument("--plant", default="noise", metavar="A+B", help=f"{common.PLANTS_HELP} (default noise)")
    parser.add_argument("--identify", action="store_true", help="identify the payload first; the controller then uses it")
    parser.add_argument("--cycles", type=int, default=30, help="number of cycles through the five poses (default 30)")
    common.add_timestep(parser)
    parser.add_argument("--all-speeds", action="store_true", help="at 100, 50 and 10 %% of the speed, as in the standard")
    common.add_speed(parser)
    common.add_json(parser)


def run(args: argparse.Namespace) -> int:
    speed = common.speed_from(args.speed)
    from armctl.cli.plants import plant_by_name
    from armctl.control import controller_by_name
    from armctl.lab.identification.excitation import excitation
    from armctl.lab.identification.payload import identify_payload
    from armctl.lab.iso9283 import iso9283_cycles
    from armctl.run.sim.simulate import simulate

    arm = common.load_arm(args)
    known = arm
    plant = plant_by_name(args.plant, arm, common.timestep_from(args))
    if args.identify:
        found = identify_payload(arm, simulate(arm, args.controller, excitation(arm), plant))
        print(f"armctl: {found}", file=sys.stderr)
        known = found.applied_to(arm)
    speeds = [share * speed for share in _STANDARD_SPEEDS] if args.all_speeds else [speed]
    results = [
        iso9283_cycles(arm, controller_by_name(args.controller, known), plant, cycles=args.cycles, speed=each)
        for each in speeds
    ]
    data = {"speeds": [result.to_dict() for result in results]} if args.all_speeds else results[0].to_dict()
    reason = next((result.reason for result in results if not result), "")
    common.print_result(args, "\n\n".join(map(str, results)), data, reason)
    return common.DONE if all(results) else common.NOT_REACHED

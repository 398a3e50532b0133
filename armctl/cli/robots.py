"""`armctl robots`, `chains`, `info` and `doctor`: which robots there are, and what is in their files."""

import argparse

from armctl.cli import common


def add(commands: common.Commands) -> None:
    robots = common.add_command(
        commands, "robots", list_robots, "list the known robots, and which of them are installed", ["", "--ratings"]
    )
    robots.add_argument("--ratings", action="store_true", help="the makers' payload, reach and speeds, with their source")
    chains = common.add_command(
        commands, "chains", list_chains, "list every serial chain of a robot: arms, legs, fingers", ["aloha"]
    )
    common.add_robot(chains)
    info = common.add_command(
        commands, "info", show_info, "show a robot's joints and limits", ["panda", "ur5e --tool robotiq_2f85"]
    )
    common.add_arm(info)
    doctor = common.add_command(
        commands,
        "doctor",
        run_doctor,
        "list what is missing, impossible or assumed in a robot's file",
        ["panda", "my_robot.urdf"],
    )
    common.add_robot(doctor)
    doctor.add_argument("--tip", help="site, body or geom at the end of the chain")
    doctor.add_argument("--base", help="body at the start of the chain")
    doctor.add_argument("--srdf", help="path of an SRDF")
    doctor.add_argument("--shapes", help="capsules or visual: the collision shape of links that have none")
    for parser in (robots, chains, info, doctor):
        common.add_json(parser)


def list_robots(args: argparse.Namespace) -> int:
    """The robots that have a name, or the ratings of all data sheets."""
    from armctl.model.loading.catalog import installed_robots, robots
    from armctl.model.loading.datasheets import ALIASES

    if args.ratings:
        return _list_ratings(args)
    known = robots()
    installed = set(installed_robots())
    here = {name: ALIASES.get(name, name) in installed for name in known}
    width = max(map(len, known))
    lines = [f"{name:{width}}  {text}{'  [on this machine]' if here[name] else ''}" for name, text in known.items()]
    rows = [{"name": name, "description": text, "on_this_machine": here[name]} for name, text in known.items()]
    common.print_result(args, "\n".join(lines), rows)
    return common.DONE


def list_chains(args: argparse.Namespace) -> int:
    from dataclasses import asdict

    from armctl.cli.describe import describe_chains
    from armctl.model.loading.load import chains

    found = chains(args.robot)
    common.print_result(args, describe_chains(args.robot, found), [asdict(chain) for chain in found])
    return common.DONE


def show_info(args: argparse.Namespace) -> int:
    from armctl.cli.describe import describe, facts

    arm = common.load_arm_with_notes(args)
    data = facts(arm)
    common.print_result(args, describe(arm, data), data)
    return common.DONE


def run_doctor(args: argparse.Namespace) -> int:
    from dataclasses import asdict

    from armctl.core.json_values import json_value
    from armctl.lab.diagnose import diagnose

    found = diagnose(args.robot, tip=args.tip, base=args.base, srdf=args.srdf, shapes=args.shapes)
    common.print_result(args, str(found), json_value(asdict(found)), found.reason)
    return common.DONE if found else common.NOT_REACHED


def _list_ratings(args: argparse.Namespace) -> int:
    from armctl.model.loading.datasheets import rated_arms, ratings_table

    rows = [
        {
            "robot": name,
            "payload_kg": row.payload,
            "reach_m": row.reach,
            "v_max": None if row.v_max is None else list(row.v_max),
            "source": row.sources,
        }
        for name, row in rated_arms().items()
    ]
    common.print_result(args, ratings_table().text(), rows)
    return common.DONE

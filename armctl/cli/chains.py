"""`armctl chains ROBOT`: every serial chain of a robot."""

from __future__ import annotations

import argparse

from armctl.cli.common import DONE, Commands, add_command, add_json, add_robot, print_result


def add(commands: Commands) -> None:
    """Adds the command to the parser."""
    parser = add_command(commands, "chains", run, "list every serial chain of a robot: arms, legs, fingers")
    add_robot(parser)
    add_json(parser)


def run(args: argparse.Namespace) -> int:
    """Runs the command."""
    from dataclasses import asdict

    from armctl.analysis.describe import describe_chains
    from armctl.loading.load import chains

    found = chains(args.robot)
    print_result(args, describe_chains(args.robot, found), [asdict(chain) for chain in found])
    return DONE

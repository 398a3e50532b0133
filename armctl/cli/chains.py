"""`armctl chains ROBOT`: every serial chain of a robot."""

from __future__ import annotations

import argparse

from armctl.cli import common


def add(commands: common.Commands) -> None:
    """Adds the command to the parser."""
    parser = common.add_command(commands, "chains", run, "list every serial chain of a robot: arms, legs, fingers")
    common.add_robot(parser)
    common.add_json(parser)


def run(args: argparse.Namespace) -> int:
    """Runs the command."""
    from dataclasses import asdict

    from armctl.analysis.describe import describe_chains
    from armctl.loading.load import chains

    found = chains(args.robot)
    common.print_result(args, describe_chains(args.robot, found), [asdict(chain) for chain in found])
    return common.DONE

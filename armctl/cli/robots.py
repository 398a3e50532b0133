"""`armctl robots`: the robots that have a name."""

from __future__ import annotations

import argparse

from armctl.cli.common import DONE, Commands, add_command


def add(commands: Commands) -> None:
    """Adds the command to the parser."""
    add_command(commands, "robots", run, "list the robots that have a name")


def run(args: argparse.Namespace) -> int:
    """Runs the command."""
    from armctl.loading.catalog import robots

    known = robots()
    width = max(map(len, known))
    for name, text in known.items():
        print(f"{name:{width}}  {text}")
    return DONE

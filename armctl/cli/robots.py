"""`armctl robots`: the robots that have a name."""

from __future__ import annotations

import argparse

from armctl.cli.common import DONE, Commands, add_command, add_json, print_result


def add(commands: Commands) -> None:
    """Adds the command to the parser."""
    parser = add_command(commands, "robots", run, "list the known robots, and which of them are installed")
    parser.add_argument("--ratings", action="store_true", help="the makers' payload, reach and speeds, with their source")
    add_json(parser)


def run(args: argparse.Namespace) -> int:
    """Runs the command."""
    if args.ratings:
        _print_ratings(args)
    else:
        _print_names(args)
    return DONE


def _print_names(args: argparse.Namespace) -> None:
    from armctl.loading.catalog import installed_robots, robots
    from armctl.loading.datasheets import ALIASES

    known = robots()
    installed = set(installed_robots())
    here = {name: ALIASES.get(name, name) in installed for name in known}
    width = max(map(len, known))
    lines = [f"{name:{width}}  {text}{'  [on this machine]' if here[name] else ''}" for name, text in known.items()]
    rows = [{"name": name, "description": text, "on_this_machine": here[name]} for name, text in known.items()]
    print_result(args, "\n".join(lines), rows)


def _print_ratings(args: argparse.Namespace) -> None:
    """The ratings of all data sheets."""
    from armctl.loading.datasheets import rated_arms, ratings_table

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
    print_result(args, ratings_table().text(), rows)

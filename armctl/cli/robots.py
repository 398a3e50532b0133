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
    from math import degrees

    from armctl.core.tables import Table
    from armctl.loading.datasheets import ROWS

    cells = []
    rows = []
    for name, row in ROWS.items():
        speeds = None if row.v_max is None else [float(v) for v in row.v_max]
        sources = "; ".join(dict.fromkeys(filter(None, [row.rating_source, row.source])))
        figures = ["" if figure is None else f"{figure:g}" for figure in (row.payload, row.reach)]
        cells.append([name, *figures, " ".join(f"{degrees(v):.0f}" for v in speeds or ()), sources])
        rows.append({"robot": name, "payload_kg": row.payload, "reach_m": row.reach, "v_max": speeds, "source": sources})
    table = Table(("robot", "payload, kg", "reach, m", "joint speeds, deg/s", "source"), cells)
    print_result(args, table.text(), rows)

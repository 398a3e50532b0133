"""`armctl robots`: the robots that have a name."""

from __future__ import annotations

import argparse

from armctl.cli.common import DONE, Commands, add_command


def add(commands: Commands) -> None:
    """Adds the command to the parser."""
    parser = add_command(commands, "robots", run, "list the known robots, and which of them are installed")
    parser.add_argument("--ratings", action="store_true", help="the makers' payload, reach and speeds, with their source")


def run(args: argparse.Namespace) -> int:
    """Runs the command."""
    from armctl.loading.catalog import installed_robots, robots
    from armctl.loading.datasheets import ALIASES

    if args.ratings:
        print(_ratings())
        return DONE
    known = robots()
    here = set(installed_robots())
    width = max(map(len, known))
    for name, text in known.items():
        mark = "  [on this machine]" if ALIASES.get(name, name) in here else ""
        print(f"{name:{width}}  {text}{mark}")
    return DONE


def _ratings() -> str:
    """The ratings of all data sheets as a table."""
    from math import degrees

    from armctl.core.tables import Table
    from armctl.loading.datasheets import ROWS

    rows = []
    for name, row in ROWS.items():
        speeds = "" if row.v_max is None else " ".join(f"{degrees(v):.0f}" for v in row.v_max)
        figures = ["" if figure is None else f"{figure:g}" for figure in (row.payload, row.reach)]
        sources = dict.fromkeys(filter(None, [row.rating_source, row.source]))
        rows.append([name, *figures, speeds, "; ".join(sources)])
    return Table(("robot", "payload, kg", "reach, m", "joint speeds, deg/s", "source"), rows).text()

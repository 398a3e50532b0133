"""`armctl COMMAND`: the parser of the command line, and the exit status.

Exit status: 0 done and reached, 1 not reached, 2 a wrong call, 130 interrupted.
"""

import argparse
import os
import re
import sys
import warnings
from collections.abc import Sequence
from typing import NoReturn

from armctl import __version__
from armctl.cli import (
    INTERRUPTED,
    compare,
    identify,
    iso9283,
    margins,
    mcp,
    reach,
    reachability,
    robot,
    robots,
    ros2,
    simulate,
    study,
    tour,
    view,
)
from armctl.cli.common import DONE, WRONG_CALL, print_json
from armctl.core.errors import ArmctlError, InputError, UnknownNameError
from armctl.core.uninterrupted import uninterrupted_import

_COMMANDS = (robots, reach, compare, iso9283, margins, reachability, identify, simulate, study, view, tour, robot, ros2, mcp)
_NOT_OPTIONS = {"action", "host", "robot", "law", "file", "run", "options"}


def main(argv: Sequence[str] | None = None) -> int:
    """Runs one command, by default that of the process, and returns the exit status."""
    words = sys.argv[1:] if argv is None else list(argv)
    parser = command_parser()
    if "_ARGCOMPLETE" in os.environ:  # set by the shell when Tab is pressed
        from argcomplete import autocomplete

        autocomplete(parser)
    if not words:
        parser.print_help()
        return DONE
    try:
        args = _parsed(parser, words)
    except ArmctlError as error:
        return _refuse(str(error), "--json" in words)
    with warnings.catch_warnings():
        warnings.showwarning = _show_warning
        return _run(args)


class _Parser(argparse.ArgumentParser):
    """A parser that raises what the command line reports in one sentence."""

    known: Sequence[str] = ()  # the names of the commands

    def error(self, message: str) -> NoReturn:
        raise InputError(f"{message}; `{self.prog} --help` lists the arguments")


def _parsed(parser: _Parser, words: Sequence[str]) -> argparse.Namespace:
    """The arguments of a command. A mistyped command or option gets a suggestion."""
    if not words[0].startswith("-") and words[0] not in parser.known:
        raise UnknownNameError.from_known("command", words[0], parser.known)
    args, unknown = parser.parse_known_args(words)
    if unknown and unknown[0].startswith("-"):
        raise UnknownNameError.from_known("option", unknown[0], args.options, f"`armctl {words[0]} --help`")
    if unknown:
        raise InputError(f"{unknown[0]!r:.80} is one argument too many; `armctl {words[0]} --help` lists the arguments")
    return args


def _run(args: argparse.Namespace) -> int:
    as_json = getattr(args, "json", False)
    try:
        with uninterrupted_import():
            import mujoco  # noqa: F401  # the imports of the commands find it loaded
        status = args.run(args)
        sys.stdout.flush()
        return status
    except ArmctlError as error:
        return _refuse(with_options(str(error), args), as_json)
    except BrokenPipeError:  # the reader of the output has gone
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # for the flush at exit
        return DONE
    except OSError as error:
        if error.filename is None:  # the output itself cannot be written
            return _refuse(f"output: {error.strerror or error}", as_json=False)
        return _refuse(f"{error.filename}: {error.strerror or error}", as_json)
    except KeyboardInterrupt:
        return _refuse("stopped", as_json, INTERRUPTED)


def _refuse(message: str, as_json: bool, status: int = WRONG_CALL) -> int:
    """Prints why a command has no result, also as JSON if its result would be JSON. Returns the exit status."""
    print(f"armctl: {message}", file=sys.stderr)
    if as_json:
        print_json(None, reason=message)
    return status


def with_options(message: str, args: argparse.Namespace) -> str:
    """A message of the library with the options of the command in place of arguments of Python: `--tip` for `tip=`."""
    for name in vars(args).keys() - _NOT_OPTIONS:
        option = f"--{name.replace('_', '-')}"
        message = re.sub(rf"^{name}(?=: )|(?<![\w-]){name}=(True\b|(?=[^\w'\"\[]|$))", option, message)
        message = re.sub(rf"(?<![\w-]){name}=(?=[\w'\"\[])", f"{option} ", message)
    return message


def command_parser() -> _Parser:
    """The parser. The module of a command has `add`, which gives it the command and the function that runs it."""
    parser = _Parser(prog="armctl", description="Command robot arms in MuJoCo.")
    parser.add_argument("--version", action="version", version=f"armctl {__version__}")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    for command in _COMMANDS:
        command.add(commands)
    for command in commands.choices.values():
        command.set_defaults(options=[option for option in command._option_string_actions if option.startswith("--")])
    parser.known = list(commands.choices)
    return parser


def _show_warning(message, category, filename, lineno, file=None, line=None) -> None:
    print(f"armctl: note: {message}", file=sys.stderr)

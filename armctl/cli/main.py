"""`armctl COMMAND`: the parser of the command line, and the exit status.

Exit status: 0 done and reached, 1 not reached, 2 a wrong call, 130 interrupted.
"""

from __future__ import annotations

import argparse
import os
import re
import sys
import warnings
from collections.abc import Sequence

from armctl import __version__
from armctl.cli import (
    chains,
    compare,
    doctor,
    identify,
    info,
    iso9283,
    margins,
    reach,
    reachability,
    robots,
    simulate,
    study,
    tune,
    view,
    warmup,
)
from armctl.cli.common import DONE, INTERRUPTED, WRONG_CALL
from armctl.core.errors import ArmctlError, UnknownNameError

_COMMANDS = (
    robots,
    chains,
    info,
    doctor,
    reach,
    compare,
    iso9283,
    margins,
    reachability,
    tune,
    identify,
    simulate,
    study,
    view,
    warmup,
)
_NOT_OPTIONS = {"robot", "law", "file", "run"}


def main(argv: Sequence[str] | None = None) -> int:
    """Runs one command.

    Args:
        argv: The arguments; those of the process if left out.

    Returns:
        The exit status.
    """
    words = sys.argv[1:] if argv is None else list(argv)
    parser = _parser()
    if "_ARGCOMPLETE" in os.environ:  # set by the shell when Tab is pressed
        from argcomplete import autocomplete

        autocomplete(parser)
    if not words:
        parser.print_help()
        return DONE
    known = [command.__name__.rpartition(".")[2] for command in _COMMANDS]
    if not words[0].startswith("-") and words[0] not in known:
        print(f"armctl: {UnknownNameError.of('command', words[0], known, 'armctl --help')}", file=sys.stderr)
        return WRONG_CALL
    args = parser.parse_args(words)
    with warnings.catch_warnings():
        warnings.showwarning = _show_warning
        return _run(args)


def _run(args: argparse.Namespace) -> int:
    try:
        status = args.run(args)
        sys.stdout.flush()
        return status
    except ArmctlError as error:
        print(f"armctl: {_with_options(str(error), args)}", file=sys.stderr)
        return WRONG_CALL
    except BrokenPipeError:  # the reader of the output has gone
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # for the flush at exit
        return DONE
    except OSError as error:
        name = error.filename if error.filename is not None else "output"
        print(f"armctl: {name}: {error.strerror or error}", file=sys.stderr)
        return WRONG_CALL
    except KeyboardInterrupt:
        print("armctl: stopped", file=sys.stderr)
        return INTERRUPTED


def _with_options(message: str, args: argparse.Namespace) -> str:
    """A message of the library with the options of the command in place of arguments of Python: `--tip` for `tip=`."""
    for name in vars(args).keys() - _NOT_OPTIONS:
        option = f"--{name.replace('_', '-')}"
        message = re.sub(rf"^{name}(?=: )|(?<![\w-]){name}=(True\b|(?=\W|$))", option, message)
        message = re.sub(rf"(?<![\w-]){name}=(?=\w)", f"{option} ", message)
    return message


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="armctl", description="Command robot arms in MuJoCo.")
    parser.add_argument("--version", action="version", version=f"armctl {__version__}")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    for command in _COMMANDS:
        command.add(commands)
    return parser


def _show_warning(message, category, filename, lineno, file=None, line=None) -> None:
    print(f"armctl: note: {message}", file=sys.stderr)

"""`armctl view ROBOT`: drag a target in the browser; the arm follows it."""

from __future__ import annotations

import argparse
import ctypes
import os
import platform
from pathlib import Path

from armctl.cli.common import CONTROLLERS_HELP, DONE, Commands, add_arm, add_command, load_arm
from armctl.core.errors import InputError

_TOKEN_VARIABLE = "ARMCTL_TOKEN"
_M_MMAP_THRESHOLD = -3  # mallopt(3)
_LARGE_BUFFER_BYTES = 128 * 1024


def add(commands: Commands) -> None:
    """Adds the command to the parser."""
    parser = add_command(commands, "view", run, "drag a target in the browser; the arm follows it")
    add_arm(parser)
    parser.add_argument(
        "--controller", default="computed-torque", help=f"the first controller, of {CONTROLLERS_HELP} (default %(default)s)"
    )
    parser.add_argument(
        "--port", type=int, default=8080, help="port of the page; the next free one if it is in use (default 8080)"
    )
    parser.add_argument("--host", help="serve other machines too, at this address of this machine; requires a token")
    parser.add_argument("--token", help=f"token that visitors need, at least 8 characters; also read from {_TOKEN_VARIABLE}")
    parser.add_argument(
        "--token-file", type=Path, metavar="PATH", help="read the token from a file, since others can list processes"
    )
    parser.add_argument(
        "--allow-host", action="append", default=[], metavar="NAME", help="an additional host name of this machine"
    )
    parser.add_argument("--native", action="store_true", help="MuJoCo's own viewer instead of the browser")


def run(args: argparse.Namespace) -> int:
    """Runs the command."""
    from armctl import viewer
    from armctl.loading import catalog

    if args.native:
        viewer.view_natively(load_arm(args), args.controller)
    else:
        _return_large_buffers()
        catalog.locate(args.robot)  # an unknown name is reported before a browser opens
        viewer.view(
            lambda: load_arm(args),
            args.controller,
            port=args.port,
            host=args.host,
            token=_token(args.token, args.token_file),
            allowed_hosts=args.allow_host,
            title=f"{Path(args.robot).stem} - armctl",
        )
    return DONE


def _return_large_buffers() -> None:
    """Lets glibc give every freed large buffer back to the system.

    Each client costs buffers of megabytes for a moment. By default glibc raises its threshold for them, and the heap between
    them becomes fragmented: a page that runs for hours grows.
    """
    if platform.libc_ver()[0] == "glibc":
        ctypes.CDLL(None).mallopt(_M_MMAP_THRESHOLD, _LARGE_BUFFER_BYTES)


def _token(token: str | None, path: Path | None) -> str | None:
    """The page's token, from the command line, a file or the environment."""
    if token is not None and path is not None:
        raise InputError("token: give --token or --token-file, not both")
    if path is None:
        return token if token is not None else os.environ.get(_TOKEN_VARIABLE) or None
    try:
        return path.read_text(encoding="utf-8").strip()
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"token_file: cannot read {str(path)!r:.80}: {error!s:.80}") from None

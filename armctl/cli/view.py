"""`armctl view ROBOT`: drag a target in the browser; the arm follows it."""

from __future__ import annotations

import argparse
import ctypes
import functools
import os
import platform
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from armctl.cli import common
from armctl.core.errors import InputError

if TYPE_CHECKING:
    from armctl.model.arm.arm import Arm

_TOKEN_VARIABLE = "ARMCTL_TOKEN"
_NO_SCENE = "none"
_M_MMAP_THRESHOLD = -3  # mallopt(3)
_LARGE_BUFFER_BYTES = 128 * 1024

_EXAMPLES = (
    "panda",
    "panda --scene table.xml --controller impedance",
    "ur5e --host 192.168.0.7 --token-file token.txt",
)


def add(commands: common.Commands) -> None:
    parser = common.add_command(commands, "view", run, "drag a target in the browser; the arm follows it", _EXAMPLES)
    common.add_arm(parser, several_scenes=True)
    parser.add_argument(
        "--controller", default="computed-torque", help="the first controller, one of those below (default %(default)s)"
    )
    common.list_controllers(parser)
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
    from armctl import view
    from armctl.model.loading import catalog

    scenes = scenes_by_name(args.scene)
    if args.native:
        if len(args.scene) > 1:
            raise InputError(
                f"scene: MuJoCo's own viewer shows one, got {len(args.scene)}; leave out --native or give one scene"
            )
        view.view_natively(loaded_arm(args, next(iter(scenes.values()))), args.controller)
    else:
        _return_large_buffers()
        catalog.locate(args.robot)  # an unknown name is reported before a browser opens
        view.view(
            {name: functools.partial(loaded_arm, args, scene) for name, scene in scenes.items()},
            args.controller,
            port=args.port,
            host=args.host,
            token=_token(args.token, args.token_file),
            allowed_hosts=args.allow_host,
            title=f"{Path(args.robot).stem} - armctl",
        )
    return common.DONE


def scenes_by_name(paths: Sequence[str]) -> dict[str, str | None]:
    """The scenes to choose from, by name: the files that are given, and none."""
    names = [Path(path).name for path in paths]
    are_unique = len(set(names)) == len(names)
    return {**dict(zip(names if are_unique else paths, paths, strict=True)), _NO_SCENE: None}


def loaded_arm(args: argparse.Namespace, scene: str | None = None) -> Arm:
    """The arm in a scene."""
    return common.load_arm(argparse.Namespace(**{**vars(args), "scene": scene}))


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

"""The person who lets an agent move a robot: as long as `armctl allow` runs in a terminal, and no longer."""

from __future__ import annotations

import contextlib
import os
import select
import socket
import stat
import sys
import tempfile
from pathlib import Path
from threading import Lock, Thread
from typing import TextIO

from armctl.core.errors import InputError, LinkError

_GO = b"go\n"
_YES = "yes"
_MAX_LINE_BYTES = 4096
_NOBODY = "nobody lets the agent move the robot: a person has to run `armctl allow` in a terminal of this computer"


class PersonSwitch:
    """Where the server waits for a person's terminal: a socket in a folder that only this user can open."""

    def __init__(self, what: str):
        """A switch that is off.

        Args:
            what: What would move, in words for the person.
        """
        self._what = what
        self._lock = Lock()
        self._terminal: socket.socket | None = None  # of the person who lets the agent move the robot
        self._path = _folder() / f"{os.getpid()}.sock"
        with contextlib.suppress(FileNotFoundError):
            self._path.unlink()  # of an earlier process with this number
        self._server = socket.socket(socket.AF_UNIX)
        try:
            self._server.bind(str(self._path))
        except OSError as error:
            raise LinkError(f"{self._path}: the switch for a person cannot be made ({error.strerror or error})") from None
        self._server.listen(1)
        Thread(target=self._wait_for_people, daemon=True).start()

    def refusal(self) -> str:
        """Why the agent must not move the robot now; empty if a person lets it."""
        return "" if self._terminal is not None else _NOBODY

    def tell(self, line: str) -> None:
        """Shows a line in the person's terminal, if there is one; it never waits for it."""
        with self._lock:
            terminal = self._terminal
            if terminal is not None:
                with contextlib.suppress(OSError):
                    terminal.send(line.replace("\n", " ").encode()[:_MAX_LINE_BYTES] + b"\n", socket.MSG_DONTWAIT)

    def close(self) -> None:
        """Switches off, and lets nobody in any more."""
        self._off()
        self._server.close()
        with contextlib.suppress(OSError):
            self._path.unlink()

    def _wait_for_people(self) -> None:
        """One terminal after the other."""
        while True:
            try:
                terminal, _ = self._server.accept()
            except OSError:  # closed
                return
            with terminal, contextlib.suppress(OSError):
                terminal.sendall(self._what.encode() + b"\n")
                if terminal.makefile("rb").readline(_MAX_LINE_BYTES) == _GO:
                    try:
                        with self._lock:
                            self._terminal = terminal
                        terminal.recv(1)  # nothing comes until it is closed; whatever comes switches off, too
                    finally:
                        self._off()

    def _off(self) -> None:
        with self._lock:
            self._terminal = None


def allow(stdin: TextIO = sys.stdin, stdout: TextIO = sys.stdout) -> None:
    """Lets the agent of this computer move its robot, after a yes, until a person presses Enter or the terminal closes.

    Raises:
        InputError: It is no terminal, no server waits for a person, or several do.
    """
    if not stdin.isatty() or not stdout.isatty():
        raise InputError("allow: only a person in a terminal can let an agent move a robot; run it there")
    with _the_server() as server:
        lines = server.makefile("rb")
        what = lines.readline(_MAX_LINE_BYTES).decode(errors="replace").strip()
        print(f"An agent wants to command {what}.", file=stdout)
        print("Keep your hand on the emergency stop. Type yes and Enter to let it; Enter or Ctrl-C stops it.", file=stdout)
        stdout.flush()
        if stdin.readline().strip() != _YES:
            print("not allowed", file=stdout, flush=True)
            return
        server.sendall(_GO)
        while True:
            ready, _, _ = select.select([stdin, server], [], [])
            if stdin in ready:
                break
            line = lines.readline(_MAX_LINE_BYTES)
            if not line:
                print("the agent's server has ended", file=stdout, flush=True)
                return
            print(line.decode(errors="replace").rstrip(), file=stdout, flush=True)
    print("stopped", file=stdout, flush=True)


def _the_server() -> socket.socket:
    """A connection to the one server that waits for a person."""
    found = []
    for path in sorted(_folder().glob("*.sock")):
        each = socket.socket(socket.AF_UNIX)
        try:
            each.connect(str(path))
        except OSError:  # its server has ended
            each.close()
            with contextlib.suppress(OSError):
                path.unlink()
            continue
        found.append(each)
    if len(found) != 1:
        for each in found:
            each.close()
        some = "no server of an agent has a robot" if not found else f"{len(found)} servers of agents have robots"
        raise InputError(
            f"allow: {some} on this computer; `armctl mcp ROBOT --robot HOST` is one, which the agent's program starts"
        )
    return found[0]


def _folder() -> Path:
    """A folder of this user that nobody else can read."""
    path = Path(tempfile.gettempdir()) / f"armctl-mcp-{os.getuid()}"
    path.mkdir(mode=0o700, exist_ok=True)
    status = path.lstat()
    if status.st_uid != os.getuid() or not stat.S_ISDIR(status.st_mode) or stat.S_IMODE(status.st_mode) & 0o077:
        raise LinkError(f"{path}: this folder must belong to you alone, for the switch of a person; remove it")
    return path

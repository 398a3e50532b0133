"""hold_alone: a lock on a robot or a name, so that one program on this computer has it."""

from __future__ import annotations

import contextlib
import os
import re
import tempfile
from pathlib import Path
from typing import IO

from armctl.core.errors import LinkError


def hold_alone(address: str, refusal: str) -> IO[str] | None:
    """A lock on an address for this process, released when it is closed or the process ends; None without an address.

    Raises LinkError with a refusal if another program, or another call, holds it.
    """
    if not address:
        return None
    import fcntl

    name = re.sub(r"[^A-Za-z0-9.]+", "-", address).strip("-")
    path = Path(tempfile.gettempdir()) / f"armctl-{name}.lock"
    with contextlib.suppress(OSError):  # another user's file
        path.touch(mode=0o666)
    file = open(path, "r+")  # noqa: SIM115  # open as long as the lock is held
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        file.close()
        raise LinkError(refusal) from None
    file.truncate(0)
    file.write(f"{os.getpid()}\n")
    file.flush()
    return file

"""Atomic writing of files: a reader finds the old file or the new one, complete, whatever interrupts the writer."""

from __future__ import annotations

import os
import secrets
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from armctl.core.errors import ArmctlError


@contextmanager
def atomic_path(path: str | os.PathLike[str]) -> Iterator[Path]:
    """A temporary path in the same folder, which replaces `path` when the block ends without an exception.

    The folder of `path` is made. The temporary file has the same suffix, so that writers can tell the format from it; it is
    flushed to the disk before it replaces `path`, and removed if the block raises.

    Args:
        path: The file to be written.

    Yields:
        The temporary path; the block must create that file.

    Raises:
        ArmctlError: The file cannot be written.
    """
    final = Path(path)
    temporary = final.with_name(f".{final.stem}.{secrets.token_hex(4)}{final.suffix}")
    try:
        final.parent.mkdir(parents=True, exist_ok=True)
        yield temporary
        _flush_to_disk(temporary, os.O_RDWR)
        os.replace(temporary, final)
        if os.name == "posix":
            _flush_to_disk(final.parent, os.O_RDONLY)  # the new name is on the disk, not only the contents
    except OSError as error:
        raise ArmctlError(f"{final}: cannot be written: {error.strerror or error}") from None
    finally:
        temporary.unlink(missing_ok=True)


def _flush_to_disk(path: Path, flags: int) -> None:
    descriptor = os.open(path, flags)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)

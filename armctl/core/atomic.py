"""Atomic writing of files: a reader finds the old file or the new one, complete, whatever interrupts the writer."""

import os
import secrets
import stat
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

from armctl.core.errors import ArmctlError, InputError
from armctl.core.validation import shown


def file_path(what: str, path: str | os.PathLike[str], endings: Sequence[str] = ()) -> Path:
    """The path in an argument called `what`; InputError if it is no name of a file, or ends in none of the `endings`."""
    try:
        text = os.fspath(path)
        out = Path(text)
        os.fsencode(out)
    except (TypeError, UnicodeEncodeError):  # a lone surrogate is no name on any disk
        raise InputError(f"{what}: {shown(path)} is not the name of a file") from None
    if not out.name or "\0" in str(text):
        raise InputError(f"{what}: {shown(text)} is not the name of a file")
    if endings and out.suffix not in endings:
        known = f"{', '.join(endings[:-1])} or {endings[-1]}" if len(endings) > 1 else endings[0]
        raise InputError(f"{what}: {out.name!r:.80} ends in {out.suffix!r:.20}, expected {known}")
    return out


@contextmanager
def atomic_path(path: str | os.PathLike[str]) -> Iterator[Path]:
    """A temporary path in the same folder, which replaces `path` when the block ends without an exception.

    The folder of `path` is made. The temporary file, which the block creates, has the same suffix, so that writers can tell
    the format from it; it is flushed to the disk before it replaces `path`, and removed if the block raises. The new file
    keeps the permissions of the old one. A link is followed. What is no regular file, such as a pipe or /dev/null, is
    written directly. ArmctlError if the file cannot be written.
    """
    final = Path(os.path.realpath(path))
    temporary = final.with_name(f".{final.stem[:100]}.{secrets.token_hex(4)}{final.suffix}")
    try:
        if final.exists() and not final.is_file() and not final.is_dir():
            yield final
            return
        final.parent.mkdir(parents=True, exist_ok=True)
        yield temporary
        if final.exists():
            os.chmod(temporary, stat.S_IMODE(final.stat().st_mode))
        _flush_to_disk(temporary, os.O_RDWR)
        os.replace(temporary, final)
        if os.name == "posix":
            with suppress(OSError):  # some network file systems cannot flush a folder; the file itself is complete
                _flush_to_disk(final.parent, os.O_RDONLY)  # the new name is on the disk, not only the contents
    except OSError as error:
        raise ArmctlError(f"{path}: cannot be written: {error.strerror or error}") from None
    finally:
        with suppress(OSError):
            temporary.unlink(missing_ok=True)


def write_text(path: str | os.PathLike[str], text: str) -> None:
    with atomic_path(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def _flush_to_disk(path: Path, flags: int) -> None:
    descriptor = os.open(path, flags)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)

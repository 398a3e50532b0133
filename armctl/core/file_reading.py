"""Reading of files that may be damaged or hostile: limits of their size, and one sentence for all that is wrong with them."""

import os
import warnings
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from armctl.core.errors import ArmctlError, InputError, NotInstalledError, import_extra

_MAX_PATH_CHARACTERS = 120  # of a path in a message


def shown_path(path: str | os.PathLike[str]) -> str:
    """A path for a message: its end, if it is long."""
    text = str(path)
    return text if len(text) <= _MAX_PATH_CHARACTERS else f"...{text[-_MAX_PATH_CHARACTERS:]}"


@contextmanager
def reading(path: Path, fault: str, kind: type[ArmctlError] = InputError) -> Iterator[None]:
    """Turns whatever the block raises about the content of a file into one sentence with its path, of the given type.

    `fault` says what is wrong if the content is, such as "no log that armctl wrote".
    """
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # NumPy's about odd headers: the content is checked
            yield
    except NotInstalledError:
        raise
    except ArmctlError as error:
        raise kind(f"{shown_path(path)}: {fault}: {error}") from None
    except Exception as error:  # NumPy, zipfile, zlib, pyarrow and JSON raise many types, and list them nowhere
        if isinstance(error, OSError) and error.filename is not None:
            raise kind(f"{shown_path(path)}: cannot be read: {error.strerror or error}") from None
        raise kind(f"{shown_path(path)}: {fault} ({type(error).__name__}: {error!s:.120})") from None


def read_bytes(path: Path, max_bytes: int) -> bytes:
    """The content of a file; InputError if it is too large."""
    with path.open("rb") as file:
        content = file.read(max_bytes + 1)
    check_size(len(content), max_bytes)
    return content


def read_npz(path: Path, max_bytes: int) -> dict[str, Any]:
    """The arrays of an .npz file without Python objects; InputError if they are too large, before anything is unpacked."""
    with path.open("rb") as file:
        with zipfile.ZipFile(file) as archive:
            check_size(sum(member.file_size for member in archive.infolist()), max_bytes)
        file.seek(0)
        with np.load(file, allow_pickle=False) as data:
            return dict(data)


def check_size(size: int, max_bytes: int) -> None:
    if size > max_bytes:
        raise InputError(f"it is larger than {max_bytes // 10**6} MB")


def read_parquet(path: Path, max_bytes: int) -> Any:
    """The pyarrow table of a .parquet file; InputError if it is too large, before anything is unpacked."""
    _, parquet = pyarrow()
    with path.open("rb") as file:
        table = parquet.ParquetFile(file)
        check_size(8 * table.metadata.num_rows * table.metadata.num_columns, max_bytes)
        return table.read()


def pyarrow() -> tuple[Any, Any]:
    parquet = import_extra("pyarrow.parquet", "Parquet files need pyarrow", "study")
    return import_extra("pyarrow", "Parquet files need pyarrow", "study"), parquet

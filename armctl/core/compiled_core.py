"""Whether the compiled core, `armctl._core`, was built from the C++ sources beside it.

The extension contains the checksum of its sources. In a checkout, where `armctl/cpp` exists, its import compares it with the
checksum of the files. The build runs this file as a script, so it imports the standard library only.
"""

import os
import sys
import zlib

_SUFFIXES = (".cpp", ".hpp")


def source_checksum(folder: str) -> int:
    """The CRC-32 of the names and the contents of all C++ files in a folder and its subfolders."""
    checksum = 0
    paths = [os.path.join(parent, name) for parent, _, names in os.walk(folder) for name in names if name.endswith(_SUFFIXES)]
    for path in sorted(paths):
        checksum = zlib.crc32(os.path.relpath(path, folder).replace(os.sep, "/").encode(), checksum)
        with open(path, "rb") as file:
            checksum = zlib.crc32(file.read(), checksum)
    return checksum


def build_problem(extension: str, checksum: int) -> str:
    """What is wrong with an extension built from sources with this checksum, for an ImportError; empty if nothing is."""
    folder = os.path.join(os.path.dirname(extension), "cpp")
    if not os.path.isdir(folder) or source_checksum(folder) == checksum:
        return ""
    return f"{extension} was built from other sources than those in {folder}; run `make core` to build it again"


if __name__ == "__main__":
    folder, header = sys.argv[1:]
    os.makedirs(os.path.dirname(header), exist_ok=True)
    with open(header, "w", encoding="utf-8") as file:
        file.write(f"#pragma once\nnamespace armctl {{\nconstexpr unsigned SOURCE_CHECKSUM = {source_checksum(folder)}u;\n}}\n")

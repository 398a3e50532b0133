"""Whether this computer has a C++ compiler, and how CMake uses zig's if it has none."""

import os
import shlex
import shutil
import sys
from pathlib import Path

ZIG_REQUIREMENT = "ziglang>=0.14"
_COMPILERS = ("c++", "g++", "clang++", "cl")
_WRAPPER = Path(__file__).resolve().with_name("zig_wrapper.py")


def has_compiler() -> bool:
    """Whether the environment names a C++ compiler, or one is on PATH."""
    return bool(os.environ.get("CXX")) or any(shutil.which(name) for name in _COMPILERS)


def zig_environment(folder: Path) -> dict[str, str]:
    """The environment variables that make CMake use zig.

    Args:
        folder: Where to write the programs that call zig.

    Returns:
        CC, CXX and CMAKE_ARGS.
    """
    folder.mkdir(parents=True, exist_ok=True)
    commands = {command: _write_command(folder, command) for command in ("cc", "c++", "ar", "ranlib")}
    arguments = [
        os.environ.get("CMAKE_ARGS", ""),
        f"-DCMAKE_AR={shlex.quote(str(commands['ar']))}",
        f"-DCMAKE_RANLIB={shlex.quote(str(commands['ranlib']))}",
    ]
    return {"CC": str(commands["cc"]), "CXX": str(commands["c++"]), "CMAKE_ARGS": " ".join(arguments).strip()}


def _write_command(folder: Path, command: str) -> Path:
    """A program that calls one of zig's commands: CMake wants a compiler to be one file."""
    if os.name == "nt":
        path = folder / f"{command}.cmd"
        path.write_text(f'@"{sys.executable}" "{_WRAPPER}" {command} %*\n', encoding="utf-8")
        return path
    path = folder / command
    call = shlex.join([sys.executable, str(_WRAPPER), command])
    path.write_text(f'#!/bin/sh\nexec {call} "$@"\n', encoding="utf-8")
    path.chmod(0o755)
    return path

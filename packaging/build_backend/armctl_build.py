"""The build backend of armctl: scikit-build-core, with zig as the compiler where there is none, and editable installs in place.

An editable install is a path to this repository, and the extension lies beside the Python files. So each checkout, and each git
worktree, uses the extension that was built from its own sources. As a script this file builds that extension:

    python packaging/build_backend/armctl_build.py [--sanitize]
"""

from __future__ import annotations

import argparse
import base64
import hashlib
import os
import shlex
import shutil
import subprocess
import sys
import sysconfig
import tempfile
import time
import zipfile
from collections.abc import Mapping
from pathlib import Path

from build_progress import show_progress
from compilers import ZIG_REQUIREMENT, has_compiler, zig_environment
from scikit_build_core import build as backend
from scikit_build_core.build import (
    build_sdist,
    get_requires_for_build_sdist,
    prepare_metadata_for_build_editable,
    prepare_metadata_for_build_wheel,
)

__all__ = [
    "build_editable",
    "build_sdist",
    "build_wheel",
    "get_requires_for_build_editable",
    "get_requires_for_build_sdist",
    "get_requires_for_build_wheel",
    "prepare_metadata_for_build_editable",
    "prepare_metadata_for_build_wheel",
]

ROOT = Path(__file__).resolve().parents[2]
MAX_JOBS = 2  # each job of the compiler takes up to 500 MiB

ConfigSettings = Mapping[str, "str | list[str]"] | None


def get_requires_for_build_wheel(config_settings: ConfigSettings = None) -> list[str]:
    """What a build needs beside pyproject.toml's list: CMake and ninja if they are missing, and zig if there is no compiler."""
    return backend.get_requires_for_build_wheel(config_settings) + ([] if has_compiler() else [ZIG_REQUIREMENT])


def get_requires_for_build_editable(config_settings: ConfigSettings = None) -> list[str]:
    """As `get_requires_for_build_wheel`."""
    return backend.get_requires_for_build_editable(config_settings) + ([] if has_compiler() else [ZIG_REQUIREMENT])


def build_wheel(wheel_directory: str, config_settings: ConfigSettings = None, metadata_directory: str | None = None) -> str:
    """Builds a wheel with the extension in it."""
    announce_build()
    os.environ.update(compiler_environment())
    return backend.build_wheel(wheel_directory, config_settings, metadata_directory)


def build_editable(wheel_directory: str, config_settings: ConfigSettings = None, metadata_directory: str | None = None) -> str:
    """Builds the extension in place, and a wheel that contains the path of this repository and nothing else.

    The editable modes of scikit-build-core add an import hook, which would find this repository's package from other worktrees.
    """
    build_in_place()
    without_cmake = {**(config_settings or {}), "wheel.cmake": "false"}
    with tempfile.TemporaryDirectory() as folder:
        metadata = Path(folder) / backend.prepare_metadata_for_build_wheel(folder, without_cmake)
        (metadata.parent / "_mujoco_armctl.pth").write_text(f"{ROOT}\n", encoding="utf-8")
        return _pack_wheel(metadata, Path(wheel_directory))


def _pack_wheel(metadata: Path, wheel_directory: Path) -> str:
    """Packs the folder that contains a wheel's metadata; returns the name of the wheel."""
    name = f"{metadata.name.removesuffix('.dist-info')}-py3-none-any.whl"
    record = metadata / "RECORD"
    record.unlink(missing_ok=True)
    files = sorted(path for path in metadata.parent.rglob("*") if path.is_file())
    lines = []
    with zipfile.ZipFile(wheel_directory / name, "w", zipfile.ZIP_DEFLATED) as wheel:
        for path in files:
            inside = path.relative_to(metadata.parent).as_posix()
            digest = base64.urlsafe_b64encode(hashlib.sha256(path.read_bytes()).digest()).rstrip(b"=").decode()
            lines.append(f"{inside},sha256={digest},{path.stat().st_size}")
            wheel.write(path, inside)
        inside = record.relative_to(metadata.parent).as_posix()
        wheel.writestr(inside, "\n".join([*lines, f"{inside},,"]) + "\n")
    return name


def announce_build() -> None:
    """Prints what is being built, and about how long it takes."""
    if has_compiler():
        print("building armctl's compiled core from armctl/cpp: one to four minutes", flush=True)
    else:
        print(
            "building armctl's compiled core from armctl/cpp with zig, for there is no C++ compiler: three to eight minutes, "
            "most of it zig's own libraries, which are kept for the next build",
            flush=True,
        )


def compiler_environment() -> dict[str, str]:
    """Environment variables that make CMake use zig; none if there is a compiler."""
    return {} if has_compiler() else zig_environment(ROOT / "build" / "zig")


def find_tool(name: str) -> str:
    """The path of CMake or ninja: that of this Python's environment, of its package, or on PATH.

    Raises:
        SystemExit: There is none.
    """
    beside_python = shutil.which(name, path=sysconfig.get_path("scripts"))
    found = beside_python or shutil.which(name)
    if found is None:
        raise SystemExit(f"{name} is missing; install it with `{sys.executable} -m pip install {name}`")
    return found


def build_in_place(sanitize: bool = False) -> None:
    """Builds the extension into armctl/, or with sanitizers into build/sanitize/; compiles only what has changed.

    Raises:
        SystemExit: The build failed; the compiler's messages are above.
    """
    environment = {**os.environ, **compiler_environment()}
    # A folder for each Python: its headers, and the place of nanobind, are in the folder's cache.
    tag = sysconfig.get_config_var("SOABI") or sys.implementation.cache_tag
    folder = ROOT / "build" / ("sanitize" if sanitize else "core") / tag
    cmake = find_tool("cmake")
    started = time.monotonic()
    if not (folder / "build.ninja").is_file():
        announce_build()
    configure = [
        cmake,
        "-S", str(ROOT),
        "-B", str(folder),
        "-G", "Ninja",
        f"-DCMAKE_MAKE_PROGRAM={find_tool('ninja')}",
        f"-DPython_EXECUTABLE={sys.executable}",
        f"-DARMCTL_IN_PLACE={'OFF' if sanitize else 'ON'}",
        f"-DARMCTL_SANITIZE={'ON' if sanitize else 'OFF'}",
        *shlex.split(environment.get("CMAKE_ARGS", "")),
    ]  # fmt: skip
    jobs = str(min(MAX_JOBS, os.cpu_count() or 1))
    for command in (configure, [cmake, "--build", str(folder), "--parallel", jobs]):
        with subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, text=True) as process:
            messages = show_progress(process.stdout or (), sys.stdout)
        if process.returncode != 0:
            raise SystemExit(f"{messages}armctl's compiled core could not be built; the reason is above")
    print(f"armctl's compiled core is up to date, after {time.monotonic() - started:.1f} s", flush=True)


def main() -> None:
    """Builds the extension in place."""
    parser = argparse.ArgumentParser(description="Builds armctl's compiled core in place.")
    parser.add_argument("--sanitize", action="store_true", help="with AddressSanitizer and UndefinedBehaviorSanitizer")
    options = parser.parse_args()
    build_in_place(sanitize=options.sanitize)


if __name__ == "__main__":
    main()

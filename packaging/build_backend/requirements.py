"""Prints what the build of the compiled core needs, for `pip install`. Imports the standard library only."""

import tomllib
from pathlib import Path

from compilers import ZIG_REQUIREMENT, has_compiler

ROOT = Path(__file__).resolve().parents[2]
TOOLS = ("cmake>=3.20", "ninja>=1.11")


def main() -> None:
    """Prints the requirements."""
    build_system = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["build-system"]
    print(*build_system["requires"], *TOOLS, *([] if has_compiler() else [ZIG_REQUIREMENT]), sep="\n")


if __name__ == "__main__":
    main()

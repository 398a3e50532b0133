"""Prints what the build of the compiled core needs, or `--run EXTRA` what armctl needs with an extra, for `pip install`.

Imports the standard library only.
"""

import argparse
import tomllib
from pathlib import Path
from typing import Any

from compilers import ZIG_REQUIREMENT, has_compiler

ROOT = Path(__file__).resolve().parents[2]
TOOLS = ("cmake>=3.20", "ninja>=1.11")


def main() -> None:
    """Prints the requirements."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--run", metavar="EXTRA")
    extra = parser.parse_args().run
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    if extra:
        project = settings["project"]
        print(*project["dependencies"], *_of_extra(extra, project), sep="\n")
    else:
        print(*settings["build-system"]["requires"], *TOOLS, *([] if has_compiler() else [ZIG_REQUIREMENT]), sep="\n")


def _of_extra(extra: str, project: dict[str, Any]) -> list[str]:
    """The requirements of an extra; those of another extra for `mujoco-armctl[other]`."""
    requirements = []
    for each in project["optional-dependencies"][extra]:
        name, _, others = each.removesuffix("]").partition("[")
        if name == project["name"]:
            requirements += [part for other in others.split(",") for part in _of_extra(other, project)]
        else:
            requirements.append(each)
    return requirements


if __name__ == "__main__":
    main()

"""Writes down afresh what the commands and examples that the pages show print: `make outputs`."""

import re
import subprocess
import sys
from pathlib import Path

HERE = Path(__file__).parent
ROOT = HERE.parent.parent
TABLE = re.compile(r"(?<=<!-- armctl compare ur5e -->\n).*?(?=<!-- end -->)", re.DOTALL)


def printed(*command: str | Path) -> str:
    """What a Python command prints, without the folders of this machine."""
    text = subprocess.run([sys.executable, *command], cwd=ROOT, capture_output=True, text=True, check=True).stdout
    return re.sub(r"/\S+/", "", text)


if __name__ == "__main__":
    for example in sorted((ROOT / "examples").glob("*.py")):
        (HERE / f"{example.stem}.txt").write_text(printed(example), encoding="utf-8")
    (HERE / "info.txt").write_text(printed("-m", "armctl", "info", "robot_arm_3dof"), encoding="utf-8")
    readme = ROOT / "README.md"
    table = printed("-m", "armctl", "compare", "ur5e")
    readme.write_text(TABLE.sub(f"\n{table}\n", readme.read_text(encoding="utf-8")), encoding="utf-8")

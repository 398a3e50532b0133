"""Writes down afresh what the commands and examples that the pages show print: `make outputs`."""

import re
import subprocess
import sys
from pathlib import Path

HERE = Path(__file__).parent
ROOT = HERE.parent.parent
COMPARE = (
    "compare",
    "panda",
    "--controllers",
    "pd,pd-feedforward,computed-torque,computed-torque-observer",
    "--plants",
    "nominal,payload=1",
)
TABLE = re.compile(rf"(?<=<!-- armctl {re.escape(' '.join(COMPARE))} -->\n).*?(?=<!-- end -->)", re.DOTALL)
REACHED = re.compile(r"reached within .*")


def printed(*command: str | Path) -> str:
    """What a Python command prints, without the folders of this machine.

    Raises:
        ModuleNotFoundError: An example needs a package that is not installed.
        RuntimeError: The command failed.
    """
    done = subprocess.run([sys.executable, *command], cwd=ROOT, capture_output=True, text=True, check=False)
    if "is not installed; pip install" in done.stderr:
        raise ModuleNotFoundError(done.stderr)
    if done.returncode:
        raise RuntimeError(done.stderr)
    return re.sub(r"/\S+/", "", done.stdout)


if __name__ == "__main__":
    for example in sorted((ROOT / "examples").glob("*.py")):
        try:
            (HERE / f"{example.stem}.txt").write_text(printed(example), encoding="utf-8")
        except ModuleNotFoundError as error:
            print(f"{example.stem}: the old output stays: {error}", file=sys.stderr)
    (HERE / "info.txt").write_text(printed("-m", "armctl", "info", "robot_arm_3dof"), encoding="utf-8")
    readme, panda = ROOT / "README.md", (HERE / "05_menagerie_panda.txt").read_text(encoding="utf-8")
    text = TABLE.sub(f"\n{printed('-m', 'armctl', *COMPARE)}\n", readme.read_text(encoding="utf-8"))
    readme.write_text(REACHED.sub(REACHED.findall(panda)[0], text), encoding="utf-8")

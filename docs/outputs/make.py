"""Writes the outputs of the commands and examples in the pages again: `make outputs`."""

import re
import subprocess
import sys
import tempfile
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
    "--delay-margin",
    "0.005",
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


def printed_with_franky_sim(example: Path, address: str = "127.0.0.5") -> str:
    """What an example prints with the address of a simulated controller, from there on.

    Raises:
        ModuleNotFoundError: The simulator is not installed.
    """
    server = [sys.executable, ROOT / "tests" / "links" / "franky_server.py", address]
    with subprocess.Popen(server, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True) as process:
        try:
            if process.stdout is None or process.stdout.readline() != "ready\n":
                raise ModuleNotFoundError("franky-sim is not installed")
            return printed(example, address).removeprefix(printed(example))
        finally:
            process.kill()


def compared() -> str:
    """The table of the comparison in README.md, in Markdown; the command prints it for terminals of 80 columns."""
    with tempfile.TemporaryDirectory() as folder:
        printed("-m", "armctl", *COMPARE, "--report", folder)
        page = (Path(folder) / "comparison.md").read_text(encoding="utf-8")
    return "\n".join(line for line in page.splitlines() if line.startswith("|"))


if __name__ == "__main__":
    for example in sorted((ROOT / "examples").glob("*.py")):
        try:
            (HERE / f"{example.stem}.txt").write_text(printed(example), encoding="utf-8")
        except ModuleNotFoundError as error:
            print(f"{example.stem}: the old output stays: {error}", file=sys.stderr)
    try:
        output = printed_with_franky_sim(ROOT / "examples" / "64_the_same_program_on_a_robot.py")
        (HERE / "franky_sim.txt").write_text(output, encoding="utf-8")
    except ModuleNotFoundError as error:
        print(f"franky_sim: the old output stays: {error}", file=sys.stderr)
    (HERE / "info.txt").write_text(printed("-m", "armctl", "info", "robot_arm_3dof"), encoding="utf-8")
    readme, panda = ROOT / "README.md", (HERE / "05_menagerie_panda.txt").read_text(encoding="utf-8")
    text = TABLE.sub(f"\n{compared()}\n\n", readme.read_text(encoding="utf-8"))
    readme.write_text(REACHED.sub(REACHED.findall(panda)[0], text), encoding="utf-8")

"""Writes the outputs of the commands and examples in the pages again: `make outputs`."""

import argparse
import re
import subprocess
import sys
import tempfile
from pathlib import Path

sys.path.append(str(Path(__file__).parents[2] / "tests" / "helpers"))

from printed_outputs import own_words

HERE = Path(__file__).parent
ROOT = HERE.parent.parent

TABLE = re.compile(r"(<!-- armctl (compare [^|>]*?)(?: [|] ([^>]*?))? -->\n).*?(<!-- end -->)", re.DOTALL)
PROGRAM = re.compile(r"^```python\n(.*?)^```", re.MULTILINE | re.DOTALL)
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
    return own_words(done.stdout)


def printed_with_franky_sim(example: Path, address: str = "127.0.0.5") -> str:
    """What an example prints with the address of a simulated controller, from there on.

    Raises:
        ModuleNotFoundError: The simulator is not installed.
    """
    server = [sys.executable, ROOT / "tests" / "helpers" / "franky_server.py", address]
    with subprocess.Popen(server, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True) as process:
        try:
            if process.stdout is None or process.stdout.readline() != "ready\n":
                raise ModuleNotFoundError("franky-sim is not installed")
            return printed(example, address).removeprefix(printed(example))
        finally:
            process.kill()


def compared(table: re.Match[str]) -> str:
    """A table of a comparison, in Markdown, of the command above it, with the columns that follow the command.

    The command itself prints the table for terminals.
    """
    heading, command, columns, end = table.groups()
    with tempfile.TemporaryDirectory() as folder:
        printed("-m", "armctl", *command.split(), "--out", folder)
        page = (Path(folder) / "comparison.md").read_text(encoding="utf-8")
    rows = [[cell.strip() for cell in line.strip("|\n").split("|")] for line in page.splitlines() if line.startswith("|")]
    names = rows[0] if columns is None else columns.split("; ")
    shown = [f"| {' | '.join(row[rows[0].index(name)] for name in names)} |" for row in rows]
    return "\n".join([f"{heading}", *shown, "", end])


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "names", nargs="*", metavar="NAME", help="an example, franky_sim, info or README; all that are here if none is named"
    )
    names = parser.parse_args().names

    for example in sorted((ROOT / "examples").glob("*.py")):
        output = HERE / f"{example.stem}.txt"
        if example.stem not in names and (names or not output.is_file()):
            continue
        try:
            output.write_text(printed(example), encoding="utf-8")
        except ModuleNotFoundError as error:
            print(f"{example.stem}: the old output stays: {error}", file=sys.stderr)
    if not names or "franky_sim" in names:
        try:
            output = printed_with_franky_sim(ROOT / "examples" / "64_the_same_program_on_a_robot.py")
            (HERE / "franky_sim.txt").write_text(output, encoding="utf-8")
        except ModuleNotFoundError as error:
            print(f"franky_sim: the old output stays: {error}", file=sys.stderr)
    if not names or "info" in names:
        (HERE / "info.txt").write_text(printed("-m", "armctl", "info", "robot_arm_3dof"), encoding="utf-8")
    if not names or "README" in names:
        readme = ROOT / "README.md"
        text = TABLE.sub(compared, readme.read_text(encoding="utf-8"))
        readme.write_text(REACHED.sub(printed("-c", PROGRAM.findall(text)[0]).strip(), text), encoding="utf-8")

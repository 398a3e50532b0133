"""What README and the pages tell a reader to type and to open is really there."""

import re
import shlex
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import matplotlib
import pytest
from arms import MISSING, some_of

import armctl
from armctl.cli.main import command_parser

ROOT = Path(__file__).parents[2]
PAGES = [*ROOT.glob("*.md"), ROOT / "llms.txt", *(ROOT / "docs").glob("*.md")]
TEXTS = {page.relative_to(ROOT): page.read_text(encoding="utf-8") for page in PAGES}


def blocks(text: str, language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```", text, flags=re.MULTILINE | re.DOTALL)


EACH_CONTINUES = "The snippets go on from each other."
CONTINUES = "# continues the program above\n"


def programs(text: str) -> list[list[str]]:
    """The Python programs of a page: a block and those below it that say that they continue it."""
    if EACH_CONTINUES in text:
        return [blocks(text, "python")]
    found: list[list[str]] = []
    for block in blocks(text, "python"):
        if block.startswith(CONTINUES):
            found[-1].append(block)
        else:
            found.append([block])
    return found


COMMANDS = sorted(
    {
        line
        for text in TEXTS.values()
        for block in blocks(text, "sh")
        for line in block.splitlines()
        if line.startswith("armctl ")
    }
)
FILES = [
    (page, file) for page, text in TEXTS.items() for file in re.findall(r"(?:^|`)python (\S+\.py)", text, flags=re.MULTILINE)
]
LINKS = [(page, link) for page, text in TEXTS.items() for link in re.findall(r"\]\(([^)#:\s]+)\)", text)]


@pytest.mark.parametrize("command", COMMANDS)
def test_a_command_in_the_pages_is_one_that_armctl_takes(command: str):
    assert command_parser().parse_args(shlex.split(command, comments=True)[1:]).run


README_COMMANDS = [line for line in blocks(TEXTS[Path("README.md")], "sh")[-1].splitlines() if line.startswith("armctl ")]


@pytest.mark.full
@pytest.mark.parametrize("command", [line for line in README_COMMANDS if not line.startswith("armctl view")])
def test_a_command_of_the_readme_succeeds(command: str, tmp_path: Path):
    words = [sys.executable, "-m", *shlex.split(command)]
    done = subprocess.run(words, cwd=tmp_path, capture_output=True, text=True, stdin=subprocess.DEVNULL)
    if MISSING in done.stderr:
        pytest.skip(f"{words[4]}: {MISSING}")
    assert done.returncode == 0, done.stdout + done.stderr


@pytest.mark.parametrize(("page", "file"), FILES)
def test_a_file_that_the_pages_run_is_there(page: Path, file: str):
    assert (ROOT / file).is_file()


@pytest.mark.parametrize("output", sorted((ROOT / "docs" / "outputs").glob("*.txt")), ids=lambda path: path.stem)
def test_what_the_commands_print_is_on_a_page(output: Path):
    assert any(f"{{literalinclude}} outputs/{output.name}\n" in text for text in TEXTS.values())


PROGRAMS = sorted(page for page, text in TEXTS.items() if blocks(text, "python"))
# Pages whose programs take seconds, or a notebook.
LONG = {
    "llms.txt",
    "coming-from.md",
    "grippers.md",
    "how-to.md",
    "identification.md",
    "learning.md",
    "many-runs.md",
    "motion.md",
    "notebooks.md",
    "own-controller.md",
    "plants.md",
}


@pytest.fixture
def backend() -> Iterator[None]:
    """Restores Matplotlib's backend, of which a page may choose another one."""
    before = matplotlib.get_backend()
    yield
    matplotlib.use(before)


@pytest.mark.usefixtures("backend")
@pytest.mark.parametrize("page", some_of(PROGRAMS, [page for page in PROGRAMS if page.name not in LONG], PROGRAMS), ids=str)
@pytest.mark.filterwarnings("ignore::armctl.ArmctlWarning")
def test_the_python_of_a_page_runs(page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    if page.name == "notebooks.md":
        pytest.importorskip("matplotlib_inline", reason="pip install -e '.[ci]'")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MPLBACKEND", "agg")
    if page.name == "notebooks.md":
        matplotlib.use("module://matplotlib_inline.backend_inline")
    for number, program in enumerate(programs(TEXTS[page])):
        try:
            run(program, f"{page}, program {number}")
        except (armctl.UnknownNameError, armctl.ModelError, ImportError) as error:
            if isinstance(error, ImportError) or MISSING in str(error):
                pytest.skip(str(error))
            raise


def run(program: list[str], name: str) -> dict[str, Any]:
    """Runs the blocks of a program one after the other, and returns what they define."""
    names: dict[str, Any] = {}
    for block in program:
        exec(compile(block, name, "exec"), names)
    return names


def pairs_of_programs(text: str) -> dict[str, list[list[str]]]:
    """The programs of each section, where the other library's program runs here and both have a `tip`."""
    sections = [part.split("\n", maxsplit=1) for part in re.split(r"^## ", text, flags=re.MULTILINE)[1:]]
    found = {heading: programs(section) for heading, section in sections}
    return {heading: pair for heading, pair in found.items() if len(pair) > 1}


PAIRS = pairs_of_programs(TEXTS[Path("docs/coming-from.md")])


def test_four_libraries_are_compared_by_running_them():
    assert list(PAIRS) == ["mink", "ruckig", "Pinocchio", "python-control"]


@pytest.mark.parametrize("library", PAIRS)
@pytest.mark.filterwarnings("ignore::armctl.ArmctlWarning")
def test_two_libraries_bring_the_same_point_to_the_same_place(library: str):
    theirs, ours = PAIRS[library]
    try:
        there = run(theirs, f"{library}, theirs")["tip"]
        here = run(ours, f"{library}, armctl's")["tip"]
    except (armctl.UnknownNameError, armctl.ModelError, ImportError) as error:
        if isinstance(error, ImportError) or MISSING in str(error):
            pytest.skip(str(error))
        raise
    assert here == pytest.approx(there, abs=1e-5)  # m


@pytest.mark.parametrize("page", TEXTS, ids=str)
def test_a_page_hides_no_python_that_its_programs_need(page: Path):
    assert "<!-- python\n" not in TEXTS[page]


def test_a_program_goes_on_only_in_blocks_that_say_so():
    first, second, other = "a = 1\n", f"{CONTINUES}b = a\n", "b = a\n"
    page = "".join(f"```python\n{block}```\n" for block in (first, second, other))
    assert programs(page) == [[first, second], [other]]
    run([first, second], "complete")
    with pytest.raises(NameError):
        run([other], "without its first line")


@pytest.mark.parametrize(("page", "link"), LINKS)
def test_a_link_in_the_pages_leads_somewhere(page: Path, link: str):
    assert (ROOT / page).parent.joinpath(link).exists() or link == "reference.md", "the build writes reference.md alone"


def test_every_make_target_in_the_pages_is_in_the_makefile():
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    in_code = {t for text in TEXTS.values() for t in re.findall(r"(?:^|`)make (\w[\w-]*)", text, flags=re.MULTILINE)}
    assert in_code
    assert all(re.search(rf"^{target}:", makefile, flags=re.MULTILINE) for target in in_code), in_code


def test_no_text_tells_to_install_the_foreign_distribution_called_armctl():
    foreign = re.compile(r"""pip3? install[^\n`#]*?["' ]armctl\b(?![/.])""")
    endings = {".md", ".py", ".pyi", ".toml", ".yml", ".txt", ""}
    folders = ["armctl", "docs", "examples", "benchmarks", ".github", ".ci"]
    files = [path for folder in folders for path in (ROOT / folder).rglob("*") if path.is_file() and path.suffix in endings]
    files += [ROOT / name for name in ("Makefile", "pyproject.toml", *(page.name for page in ROOT.glob("*.md")))]
    found = [path for path in files if "_build" not in path.parts and foreign.search(path.read_text(encoding="utf-8"))]
    assert not found
    assert foreign.search("pip install 'armctl[view]'")
    assert foreign.search("python -m pip install -U armctl")
    assert not foreign.search("pip install -e '.[view]'  # armctl")

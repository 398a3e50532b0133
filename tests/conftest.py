"""What all tests share: the environment, the arms at hand, and a loud word about those that are not."""

import os
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # seven-vectors gain nothing from threads, and two workers lose
os.environ.setdefault("MPLBACKEND", "agg")
os.environ.setdefault("XLA_FLAGS", "--xla_backend_optimization_level=0")  # JAX compiles in half the time
os.environ.setdefault("MALLOC_MMAP_THRESHOLD_", "1000000")  # glibc of a worker returns the memory of large models at once
os.environ["MENAGERIE_BASE_URL"] = "file:///nowhere"  # a test downloads nothing, and is told so at once
if not os.environ.get("DISPLAY"):
    os.environ.setdefault("MUJOCO_GL", "egl")

import importlib.util
import sys

if sanitized := os.environ.get("ARMCTL_SANITIZED_CORE"):  # `make sanitize` tests another build of the compiled core
    spec = importlib.util.spec_from_file_location("armctl._core", sanitized)
    sys.modules["armctl._core"] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(sys.modules["armctl._core"])

import hypothesis
import mujoco
import pytest
from arms import ARMS, MISSING, ROBOTS, arm_of, some_of
from robot_notes import RobotNotes
from synthetic import mjcf

import armctl

_MEMORY = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") if hasattr(os, "sysconf") else 8_000_000_000  # bytes
mujoco.mj_setCacheCapacity(mujoco.mj_getCache(), _MEMORY // 16)  # of a worker: meshes of earlier models, 0.9 GB of all robots

hypothesis.settings.register_profile("armctl", deadline=None, derandomize=True, print_blob=True)
hypothesis.settings.load_profile("armctl")


@pytest.fixture(params=some_of(ARMS))
def arm(request: pytest.FixtureRequest) -> armctl.Arm:
    """Every arm at hand."""
    return arm_of(request.param)


@pytest.fixture(params=some_of(ROBOTS))
def robot(request: pytest.FixtureRequest) -> str:
    """The name of every robot at hand, arm or not."""
    return request.param


@pytest.fixture(scope="session")
def bundled() -> armctl.Arm:
    """The arm that comes with armctl."""
    return arm_of("robot_arm_3dof")


@pytest.fixture
def load(tmp_path: Path):
    """Loads an arm from MJCF bodies, as `synthetic.mjcf` takes them."""

    def loaded(bodies: str, rest: str = "", **how) -> armctl.Arm:
        path = tmp_path / "trap.xml"
        path.write_text(mjcf(bodies, rest))
        return armctl.load(path, **how)

    return loaded


def pytest_addoption(parser: pytest.Parser) -> None:
    group = parser.getgroup("fuzz", "tests/fuzz/; `make fuzz SEED=1 MINUTES=10` sets both")
    group.addoption("--fuzz-seed", type=int, default=0, help="seed of the random cases (default: %(default)s)")
    group.addoption(
        "--fuzz-minutes", type=float, default=0.0, help="time for all fuzz tests together (default: a fixed number of cases)"
    )
    group.addoption("--fuzz-first", type=int, default=0, help="number of the first case, to go on after an earlier run")
    group.addoption(
        "--fuzz-motions", type=int, default=5, help="least number of motions of every kind for each arm (default: %(default)s)"
    )
    group = parser.getgroup("robots", "tests that need not run again without robots; .ci/run uses both")
    group.addoption("--note-without-robots", type=Path, help="append the tests to this file that asked for no installed robot")
    group.addoption("--skip-noted", type=Path, help="leave out the tests in this file")


def pytest_configure(config: pytest.Config) -> None:
    if config.option.note_without_robots:
        config.pluginmanager.register(RobotNotes(config.option.note_without_robots))


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    if config.option.skip_noted:
        noted = set(config.option.skip_noted.read_text(encoding="utf-8").splitlines())
        left_out = [item for item in items if item.nodeid in noted]
        config.hook.pytest_deselected(items=left_out)
        items[:] = [item for item in items if item.nodeid not in noted]
    items.sort(key=lambda item: item.path.name != "test_page.py")  # it mostly waits, so it must not come last


def pytest_report_header() -> str:
    return f"arms at hand: {', '.join(ARMS)}"


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    reasons = [str(report.longrepr[-1]) for report in terminalreporter.stats.get("skipped", [])]
    robots = sorted({reason.removeprefix("Skipped: ").partition(":")[0] for reason in reasons if MISSING in reason})
    if robots:
        count = sum(MISSING in reason for reason in reasons)
        terminalreporter.write_line(
            f"{count} tests skipped, since these robots are not installed: {', '.join(robots)}. "
            "Set MENAGERIE_ROOT to a checkout of MuJoCo Menagerie, or run `mujoco-menagerie prefetch` with their names there.",
            yellow=True,
        )

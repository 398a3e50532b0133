"""What is installed from a wheel is whole: the bundled model is in it, and it works without the checkout."""

import ast
import importlib
import importlib.metadata
import io
import os
import re
import shutil
import subprocess
import sys
import sysconfig
import tarfile
import tomllib
import venv
import zipfile
from pathlib import Path

import pytest

import armctl
from armctl.model.loading.catalog import bundled_models

ROOT = Path(__file__).parents[2]
BUILD = ROOT / "build" / "core" / str(sysconfig.get_config_var("SOABI"))
ENVIRONMENT = {name: value for name, value in os.environ.items() if name not in ("PYTHONPATH", "ARMCTL_COMPILE_AT_ONCE")}


def run(*command: str | Path, cwd: Path) -> str:
    done = subprocess.run(command, cwd=cwd, env=ENVIRONMENT, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def call_backend(hook: str, folder: Path) -> None:
    code = f"import sys; sys.path.append('packaging/build_backend'); import armctl_build; armctl_build.{hook}({str(folder)!r})"
    run(sys.executable, "-c", code, cwd=ROOT)


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("wheel")
    pip = (sys.executable, "-m", "pip", "wheel", "--no-deps", "--no-build-isolation", "--no-index")
    # `make core` has compiled the same sources with the same options into this folder; again that would take two minutes.
    run(*pip, f"--config-settings=build-dir={BUILD}", "--wheel-dir", folder, ROOT, cwd=folder)
    return next(folder.glob("mujoco_armctl-*.whl"))


@pytest.fixture(scope="module")
def installed(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A new environment with armctl from the wheel; what armctl depends on is lent to it by this one."""
    folder = tmp_path_factory.mktemp("fresh")
    venv.create(folder, symlinks=True)
    python = folder / "bin" / "python"
    run(sys.executable, "-m", "pip", "--python", python, "install", "--no-deps", "--no-index", wheel, cwd=folder)
    purelib = run(python, "-c", "import sysconfig; print(sysconfig.get_path('purelib'))", cwd=folder).strip()
    lend = f"import site; site.addsitedir({sysconfig.get_path('purelib')!r})\n"
    (Path(purelib) / "lent.pth").write_text(lend, encoding="utf-8")
    return folder


@pytest.mark.full
def test_a_wheel_holds_the_package_the_core_the_models_and_the_license_and_nothing_else(wheel: Path):
    names = {name for name in zipfile.ZipFile(wheel).namelist() if ".dist-info/" not in name}
    modules = {path.relative_to(ROOT).as_posix() for path in (ROOT / "armctl").rglob("*.py")}
    models = {f"armctl/models/{path.name}" for path in (ROOT / "models").iterdir()}
    extension = f"armctl/_core{sysconfig.get_config_var('EXT_SUFFIX')}"
    assert names == modules | models | {
        "armctl/__init__.pyi",
        "armctl/_core.pyi",
        "armctl/envs/__init__.pyi",
        "armctl/run/links/__init__.pyi",
        "armctl/py.typed",
        "armctl/view/devices.js",
        extension,
    }
    assert "armctl/models/robot_arm_3dof.xml" in names
    assert any(name.endswith(".dist-info/licenses/LICENSE") for name in zipfile.ZipFile(wheel).namelist())


@pytest.mark.nightly
def test_a_source_distribution_holds_the_tests_and_what_they_read(tmp_path: Path):
    call_backend("build_sdist", tmp_path)
    [sdist] = tmp_path.glob("mujoco_armctl-*.tar.gz")
    with tarfile.open(sdist) as archive:
        names = {name.partition("/")[2] for name in archive.getnames()}
    assert {
        "CMakeLists.txt",
        "armctl/__init__.pyi",
        "armctl/cpp/bindings/module.cpp",
        "packaging/build_backend/armctl_build.py",
        "models/robot_arm_3dof.xml",
        "tests/conftest.py",
        "docs/conf.py",
        "Makefile",
        "README.md",
    } <= names
    assert {"LICENSE", "examples/01_reach.py", "tests/models/gantry.xml", ".ci/run", "packaging/conda/meta.yaml"} <= names
    ignored = ("docs/_build", "docs/reference", "build/", "armctl/_core.cpython")
    stray = [name for name in names if "__pycache__" in name or name.startswith(ignored)]
    assert not stray


def declared() -> set[str]:
    """The distributions that pyproject.toml names as dependencies, or in the extras that armctl imports."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    extras = project["optional-dependencies"]
    lines = [*project["dependencies"]]
    for extra in ("view", "design", "study", "ros", "envs", "jax", "mcp"):
        lines += extras[extra]
    return {re.split(r"[<>=\[]", line)[0] for line in lines}


def test_every_package_that_armctl_imports_is_a_declared_dependency():
    trees = [ast.parse(path.read_text(encoding="utf-8")) for path in (ROOT / "armctl").rglob("*.py")]
    nodes = [node for tree in trees for node in ast.walk(tree)]
    modules = {alias.name for node in nodes if isinstance(node, ast.Import) for alias in node.names}
    modules |= {node.module or "" for node in nodes if isinstance(node, ast.ImportFrom) and node.level == 0}
    packages = {module.partition(".")[0] for module in modules} - set(sys.stdlib_module_names) - {"armctl"}
    distributions = importlib.metadata.packages_distributions()
    names = {package: {package, *distributions.get(package, [])} for package in packages - {"pinocchio"}}
    names["pinocchio"] = {"pin"}
    spelled = {package: {name.lower().replace("_", "-") for name in known} for package, known in names.items()}
    undeclared = {package for package, known in spelled.items() if not declared() & known}
    assert not undeclared


def test_a_foreign_distribution_called_armctl_is_warned_of(tmp_path: Path):
    foreign = tmp_path / "armctl-3.1.4.dist-info"
    foreign.mkdir()
    (foreign / "METADATA").write_text("Name: armctl\nVersion: 3.1.4\n", encoding="utf-8")
    code = f"import sys; sys.path[:0] = [{str(ROOT)!r}, {str(tmp_path)!r}]; import armctl; print(armctl.__file__)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert Path(done.stdout.strip()).is_relative_to(ROOT)
    assert done.stderr.count("Warning:") == 1
    assert "armctl-3.1.4.dist-info: the distribution 'armctl' is another project's" in done.stderr


@pytest.mark.full
def test_the_own_distribution_is_not_warned_of(installed: Path):
    python = installed / "bin" / "python"
    assert run(
        python, "-W", "error", "-c", "import armctl, importlib.metadata as m; print(m.version('mujoco-armctl'))", cwd=installed
    )


@pytest.mark.full
def test_an_installed_wheel_loads_the_bundled_arm(installed: Path):
    code = "import armctl, armctl.model.loading.catalog as c; "
    code += "print(c.bundled_models(), armctl.__version__, armctl.load('robot_arm_3dof').n)"
    models, version, joints = run(installed / "bin" / "python", "-c", code, cwd=installed).split()
    assert Path(models).is_relative_to(installed)
    assert version == armctl.__version__
    assert joints == "3"


@pytest.mark.full
def test_the_installed_command_reaches_the_target(installed: Path):
    assert run(installed / "bin" / "armctl", "reach", "robot_arm_3dof", cwd=installed).startswith("reached")


@pytest.mark.skipif(
    "ARMCTL_TEST_ZIG" not in os.environ, reason="compiles zig's C++ library, in minutes; CI sets ARMCTL_TEST_ZIG"
)
def test_a_computer_without_a_compiler_builds_the_core_and_reaches_the_target(tmp_path: Path):
    """With an empty PATH, in a new environment, from the registry that pip uses."""
    checkout = tmp_path / "checkout"
    ignored = shutil.ignore_patterns(".git", ".venv", "build", "_core.*so", "__pycache__", "_build")
    shutil.copytree(ROOT, checkout, ignore=ignored)
    venv.create(tmp_path / "fresh", symlinks=True, with_pip=True)
    python = tmp_path / "fresh" / "bin" / "python"
    environment = {name: value for name, value in ENVIRONMENT.items() if name not in ("CC", "CXX", "CMAKE_ARGS")}
    environment |= {"PATH": "", "ZIG_GLOBAL_CACHE_DIR": str(tmp_path / "zig")}
    install = [python, "-m", "pip", "install", "--verbose", checkout]
    done = subprocess.run(install, cwd=tmp_path, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "with zig, for there is no C++ compiler" in done.stdout + done.stderr
    assert run(tmp_path / "fresh" / "bin" / "armctl", "reach", "robot_arm_3dof", cwd=tmp_path).startswith("reached")


@pytest.mark.full
def test_an_editable_install_is_a_path_to_the_checkout(tmp_path: Path):
    """So a git worktree on PYTHONPATH uses its own extension, and no import hook finds another."""
    call_backend("build_editable", tmp_path)
    [wheel] = [zipfile.ZipFile(path) for path in tmp_path.glob("mujoco_armctl-*.whl")]
    [path] = [name for name in wheel.namelist() if ".dist-info/" not in name]
    assert path.endswith(".pth")
    assert Path(wheel.read(path).decode().strip()).resolve() == ROOT


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


@pytest.mark.parametrize(("out", "shown"), [(Terminal(), "\rcompiled 1 of 2\rcompiled 2 of 2\n"), (io.StringIO(), "")])
def test_a_build_shows_its_steps_on_one_line_of_a_terminal_and_keeps_messages(
    monkeypatch: pytest.MonkeyPatch, out: io.StringIO, shown: str
):
    monkeypatch.syspath_prepend(ROOT / "packaging" / "build_backend")
    build_progress = importlib.import_module("build_progress")
    lines = ["[1/2] Building CXX object law.cpp.o\n", "law.cpp:3: error: no such type\n", "[2/2] Linking\n"]
    assert build_progress.show_progress(lines, out) == "law.cpp:3: error: no such type\n"
    assert out.getvalue() == shown


def test_a_checkout_finds_the_bundled_models():
    assert (bundled_models() / "robot_arm_3dof.xml").is_file()


def test_the_conda_recipe_requires_what_pyproject_requires():
    conda_names = {"mujoco": "mujoco-python", "pin": "pinocchio", "matplotlib": "matplotlib-base"}
    dependencies = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["dependencies"]
    required = set()
    for dependency in dependencies:
        name, bounds = re.fullmatch(r"([a-z0-9-]+)(.+)", dependency).groups()
        required.add(f"{conda_names.get(name, name)} {bounds}")
    recipe = (ROOT / "packaging" / "conda" / "meta.yaml").read_text(encoding="utf-8")
    run = recipe.partition("  run:\n")[2].partition("\n\n")[0]
    assert set(re.findall(r"- (.+)", run)) - {"python >=3.11"} == required

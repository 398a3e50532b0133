"""What is installed from a wheel is whole: the bundled model is in it, and it works without the checkout."""

import os
import subprocess
import sys
import sysconfig
import venv
import zipfile
from pathlib import Path

import pytest

import armctl
from armctl.loading.catalog import bundled_models

ROOT = Path(__file__).parents[2]
ENVIRONMENT = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}


def run(*command: str | Path, cwd: Path) -> str:
    done = subprocess.run(command, cwd=cwd, env=ENVIRONMENT, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("wheel")
    pip = (sys.executable, "-m", "pip", "wheel", "--no-deps", "--no-build-isolation", "--no-index")
    run(*pip, "--wheel-dir", folder, ROOT, cwd=folder)
    return next(folder.glob("armctl-*.whl"))


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


def test_a_wheel_holds_the_models_the_license_and_the_types(wheel: Path):
    names = zipfile.ZipFile(wheel).namelist()
    assert "armctl/models/robot_arm_3dof.xml" in names
    assert "armctl/py.typed" in names
    assert any(name.endswith("licenses/LICENSE") for name in names)
    assert not any(name.startswith(("tests/", "docs/")) for name in names)


def test_an_installed_wheel_loads_the_bundled_arm(installed: Path):
    code = "import armctl, armctl.loading.catalog as c; "
    code += "print(c.bundled_models(), armctl.__version__, armctl.load('robot_arm_3dof').n)"
    models, version, joints = run(installed / "bin" / "python", "-c", code, cwd=installed).split()
    assert Path(models).is_relative_to(installed)
    assert version == armctl.__version__
    assert joints == "3"


def test_the_installed_command_reaches_the_target(installed: Path):
    assert run(installed / "bin" / "armctl", "reach", "robot_arm_3dof", cwd=installed).startswith("reached")


def test_a_checkout_finds_the_bundled_models():
    assert (bundled_models() / "robot_arm_3dof.xml").is_file()

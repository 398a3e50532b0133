"""Names of robot_descriptions, with a package made for the test: importing one of its modules provides files."""

import subprocess
import sys
from pathlib import Path

import pytest
from synthetic import FIRST, SECOND, THIRD, TOOL, limb, mjcf, motors, urdf

import armctl


@pytest.fixture
def package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An importable robot_descriptions without any robot."""
    folder = tmp_path / "robot_descriptions"
    folder.mkdir()
    (folder / "__init__.py").write_text("")
    for name in [name for name in sys.modules if name.partition(".")[0] == "robot_descriptions"]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.syspath_prepend(str(tmp_path))
    yield folder
    for name in [name for name in sys.modules if name.partition(".")[0] == "robot_descriptions"]:
        del sys.modules[name]


def test_a_urdf_is_loaded_by_its_name(package: Path):
    (package / "r.urdf").write_text(urdf(FIRST, SECOND, THIRD, TOOL))
    (package / "arm_description.py").write_text(f"URDF_PATH = {str(package / 'r.urdf')!r}\n")
    arm = armctl.load("arm_description")
    assert (arm.name, arm.n, arm.sources["v_max"]) == ("arm_description", 2, "URDF")


def test_an_mjcf_is_preferred(package: Path):
    (package / "r.xml").write_text(mjcf(limb("a b c"), motors("a b c")))
    (package / "arm_mj_description.py").write_text(f"URDF_PATH = 'none'\nMJCF_PATH = {str(package / 'r.xml')!r}\n")
    assert armctl.load("arm_mj_description").n == 3


def test_a_failed_download_is_one_sentence(package: Path):
    (package / "far_description.py").write_text("raise OSError('no\\nnetwork')\n")
    with pytest.raises(armctl.ModelError, match="far_description: robot_descriptions cannot provide it: no network"):
        armctl.load("far_description")


def test_an_unknown_name_shows_near_ones(package: Path):
    (package / "panda_description.py").write_text("")
    with pytest.raises(armctl.UnknownNameError, match="panda_description"):
        armctl.load("pandas_description")
    with pytest.raises(armctl.ModelError, match="neither an MJCF nor a URDF"):
        armctl.load("panda_description")


def test_a_file_that_does_not_exist_is_one_sentence(package: Path):
    (package / "gone_description.py").write_text("URDF_PATH = '/nowhere/r.urdf'\n")
    with pytest.raises(armctl.ModelError, match=r"its file is /nowhere/r\.urdf, which does not exist"):
        armctl.load("gone_description")


def test_without_the_package_the_message_says_how_to_install_it(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("importlib.util.find_spec", lambda _name: None)
    with pytest.raises(armctl.ModelError, match="which is not installed: `pip install robot_descriptions`"):
        armctl.load("panda_description")


def test_importing_armctl_does_not_import_the_package(package: Path):
    (package / "__init__.py").write_text("raise RuntimeError('imported')\n")
    code = "import sys, armctl; armctl.load; armctl.load('robot_arm_3dof'); assert 'robot_descriptions' not in sys.modules"
    environment = {"PYTHONPATH": f"{package.parent}:{Path(armctl.__file__).parents[1]}", "PATH": ""}
    subprocess.run([sys.executable, "-c", code], check=True, env=environment)

import pytest

import armctl


@pytest.fixture(scope="session")
def short(tmp_path_factory) -> str:
    """The file of a short motion."""
    arm = armctl.load("robot_arm_3dof")
    motion = armctl.move_j(arm, arm.home, arm.home + 0.1)
    return str(motion.save(tmp_path_factory.mktemp("motion") / "short.npz"))


@pytest.fixture(scope="session")
def study(short):
    """Makes a study of short runs."""

    def made(**changes) -> armctl.Study:
        arguments = {
            "name": "trial",
            "robot": "robot_arm_3dof",
            "controllers": ["pd-gravity", "computed-torque"],
            "motion": short,
            "factors": {"payload": armctl.Range(0.0, 1.0), "delay": [0, 2], "noise": 1.0},
            "samples": 8,
            "dwell": 0.02,
        }
        return armctl.Study(**(arguments | changes))

    return made


@pytest.fixture(scope="session")
def toml(short) -> str:
    """The file of `study()`."""
    return f"""
name = "trial"
robot = "robot_arm_3dof"
controllers = ["pd-gravity", "computed-torque"]
motion = '{short}'
samples = 8
dwell = 0.02

[factors]
payload = {{ low = 0.0, high = 1.0 }}
delay = [0, 2]
noise = 1.0
"""


@pytest.fixture(scope="session")
def finished(study, tmp_path_factory):
    """The result of `study()`, made in this process."""
    return study().run(folder=tmp_path_factory.mktemp("finished"))

"""Impossible and missing inertias: one behaviour for URDF, MJCF, specifications and compiled models."""

from pathlib import Path

import mujoco
import numpy as np
import pytest
from synthetic import mjcf, motors

import armctl

PUMA_LINK = (0.066, 0.086, 0.0125)  # link 3 of the Puma 560 in textbooks: the second exceeds the sum of the others
IMPOSSIBLE = {"Puma": PUMA_LINK, "negative": (-0.01, 0.02, 0.02), "a rod too thin": (0.1, 0.01, 0.01)}


def of_mjcf(inertial: str) -> str:
    return mjcf(
        f'<body name="A"><joint name="a" axis="0 0 1" range="-2 2" armature="0.1"/>{inertial}'
        '<body name="B" pos="0 0 0.3"><joint name="b" axis="0 1 0" range="-2 2" armature="0.1"/>'
        '<inertial pos="0 0 0.1" mass="1" diaginertia="0.01 0.01 0.01"/></body></body>',
        motors("a b"),
    )


def of_urdf(xx: float, yy: float, zz: float, mass: float = 3.0) -> str:
    def link(name: str, mass: float, moments: tuple[float, float, float]) -> str:
        ixx, iyy, izz = moments
        inertia = f'<inertia ixx="{ixx}" ixy="0" ixz="0" iyy="{iyy}" iyz="0" izz="{izz}"/>'
        return f'<link name="{name}"><inertial><mass value="{mass}"/>{inertia}</inertial></link>'

    def joint(name: str, parent: str, child: str, axis: str) -> str:
        limit = '<limit lower="-2" upper="2" effort="20" velocity="2"/>'
        return (
            f'<joint name="{name}" type="revolute"><parent link="{parent}"/><child link="{child}"/>'
            f'<origin xyz="0 0 0.3"/><axis xyz="{axis}"/>{limit}</joint>'
        )

    end = '<joint name="end" type="fixed"><parent link="B"/><child link="tool"/><origin xyz="0 0 0.2"/></joint>'
    links = '<link name="base"/><link name="tool"/>' + link("A", mass, (xx, yy, zz)) + link("B", 1.0, (0.01, 0.01, 0.01))
    return f'<robot name="arm">{links}{joint("a", "base", "A", "0 0 1")}{joint("b", "A", "B", "0 1 0")}{end}</robot>'


def inertia_of(arm: armctl.Arm, body: str) -> np.ndarray:
    """(3, 3) the inertia of a body in its own axes, from the compiled model."""
    turn = np.zeros(9)
    mujoco.mju_quat2Mat(turn, arm.model.body(body).iquat)
    turn = turn.reshape(3, 3)
    return turn @ np.diag(arm.model.body(body).inertia) @ turn.T


def loaded(how: str, moments: tuple[float, float, float], folder: Path) -> armctl.Arm:
    xx, yy, zz = moments
    text = of_mjcf(f'<inertial pos="0 0 0.1" mass="3" diaginertia="{xx} {yy} {zz}"/>')
    if how == "URDF":
        (folder / "arm.urdf").write_text(of_urdf(xx, yy, zz))
        return armctl.load(folder / "arm.urdf")
    if how == "MJCF":
        (folder / "arm.xml").write_text(text)
        return armctl.load(folder / "arm.xml")
    if how == "full inertia":
        full = of_mjcf(f'<inertial pos="0 0 0.1" mass="3" fullinertia="{xx} {yy} {zz} 0 0 0"/>')
        return armctl.load(mujoco.MjSpec.from_string(full))
    if how == "MjSpec":
        return armctl.load(mujoco.MjSpec.from_string(text))
    model = mujoco.MjModel.from_xml_string(of_mjcf('<inertial pos="0 0 0.1" mass="3" diaginertia="0.1 0.1 0.1"/>'))
    model.body("A").inertia[:] = moments
    return armctl.load(model)


@pytest.mark.parametrize("how", ["URDF", "MJCF", "full inertia", "MjSpec", "MjModel"])
@pytest.mark.parametrize("moments", IMPOSSIBLE.values(), ids=IMPOSSIBLE)
def test_an_impossible_inertia_is_replaced_in_every_kind_of_file(how: str, moments: tuple[float, float, float], tmp_path: Path):
    with pytest.warns(armctl.ArmctlWarning, match="the inertia of A is impossible"):
        arm = loaded(how, moments, tmp_path)
    # Closed form: second moments of mass along the axes, none of them negative.
    spread = np.maximum(0.5 * sum(moments) - np.array(moments), 0.0)
    assert inertia_of(arm, "A") == pytest.approx(np.diag(spread.sum() - spread), abs=1e-6)
    assert arm.model.body("A").mass == pytest.approx(3.0)
    assert np.linalg.eigvalsh(arm.mass_matrix(arm.home)).min() > 0.0


def test_a_possible_inertia_stays_as_it_is_written(recwarn):
    text = of_mjcf('<inertial pos="0 0 0.1" mass="3" diaginertia="0.066 0.086 0.0325"/>')
    arm = armctl.load(mujoco.MjSpec.from_string(text))
    assert np.sort(arm.model.body("A").inertia) == pytest.approx([0.0325, 0.066, 0.086], rel=1e-12)
    assert not [each for each in recwarn.list if "inertia" in str(each.message)]


@pytest.mark.parametrize(
    ("mass", "moment", "said"),
    [
        (3.0, 0.0, "no inertia given for A: 1e-06 kg m\\^2 is used"),
        (0.0, 0.02, "no mass given for A: 0.001 kg is used"),
        (0.0, 0.0, "no mass or inertia given for A: 0.001 kg and 1e-06 kg m\\^2 are used"),
    ],
)
@pytest.mark.parametrize("how", ["URDF", "MJCF"])
def test_only_what_is_missing_is_called_missing(how: str, mass: float, moment: float, said: str, tmp_path: Path):
    path = tmp_path / ("arm.urdf" if how == "URDF" else "arm.xml")
    inertial = f'<inertial pos="0 0 0.1" mass="{mass}" diaginertia="{moment} {moment} {moment}"/>'
    path.write_text(of_urdf(moment, moment, moment, mass) if how == "URDF" else of_mjcf(inertial))
    with pytest.warns(armctl.ArmctlWarning, match=said):
        arm = armctl.load(path)
    assert arm.model.body("A").mass == pytest.approx(mass or 1e-3)
    assert arm.model.body("A").inertia == pytest.approx(np.full(3, moment or 1e-6))

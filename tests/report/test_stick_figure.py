"""A robot without visible shapes is drawn as a stick figure, from joint to joint and to the tip."""

import warnings
from pathlib import Path

import mujoco
import numpy as np
import pytest
from PIL import Image
from synthetic import limb, mjcf, motors
from test_video import draws

import armctl
from armctl.report.render.camera import box_corners
from armctl.report.render.stick_figure import StickFigure, has_shapes, needed_stick_figure

WITH_SHAPES = mjcf(f'<body name="base" pos="0 0 0.2">{limb("a b c")}</body>', motors("a b c"))
HIDDEN = WITH_SHAPES.replace("<geom ", '<geom group="3" ')
CLEAR = WITH_SHAPES.replace("<geom ", '<geom rgba="1 1 1 0" ')
ON_A_PEDESTAL = HIDDEN.replace('<body name="base" pos="0 0 0.2">', '<body name="base" pos="0 0 0.2"><geom size="0.1"/>')


def loaded(text: str) -> armctl.Arm:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", armctl.ArmctlWarning)
        return armctl.load(mujoco.MjSpec.from_string(text), tip="C")


@pytest.mark.parametrize(("text", "are_there"), [(WITH_SHAPES, True), (HIDDEN, False), (CLEAR, False), (ON_A_PEDESTAL, False)])
def test_shapes_count_if_they_are_drawn_and_move(text: str, are_there: bool):
    arm = loaded(text)
    assert has_shapes(arm) is are_there
    assert (needed_stick_figure(arm) is None) is are_there


def test_the_lines_go_from_the_base_through_the_joints_to_the_tip():
    arm = loaded(HIDDEN)
    q = np.array([0.3, -0.5, 0.7])
    data = mujoco.MjData(arm.model)
    data.qpos[:] = arm.qpos(q)
    mujoco.mj_kinematics(arm.model, data)
    segments = StickFigure(arm).segments(data)
    a, b, c = (data.joint(name).xanchor for name in "abc")
    expected = [[[0.0, 0.0, 0.2], a], [a, b], [b, c], [c, arm.fk(q).position]]
    assert segments == pytest.approx(np.array(expected), abs=1e-12)
    assert box_corners(arm, data) == pytest.approx(segments.reshape(-1, 3))


@draws
def test_a_film_of_an_arm_without_shapes_shows_lines_and_says_so(tmp_path: Path):
    arm = loaded(HIDDEN)
    log = armctl.simulate(arm, "computed-torque", armctl.move_j(arm, arm.home, arm.home + 0.3))
    with pytest.warns(armctl.ArmctlWarning, match="no visible shapes, so a stick figure is drawn"):
        path = armctl.still(log, arm, tmp_path / "still.png", size=(320, 240))
    gray = np.asarray(Image.open(path).convert("RGB")).astype(int)
    is_stick = (gray.min(axis=2) > 60) & (np.ptp(gray, axis=2) < 40)
    rows, columns = np.nonzero(is_stick)
    assert is_stick.sum() > 300
    assert max(np.ptp(rows), np.ptp(columns)) > 40

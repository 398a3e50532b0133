"""Grippers as other people's URDFs describe them: mimic joints, overlapping shapes, missing shapes, motors of any strength."""

from pathlib import Path

import numpy as np
import pytest
from synthetic import INERTIA, JOINT, LIMIT

import armctl
from armctl.model.gripper.gripper_model import find_gripper_model

LINK = '<link name="{}"><inertial><origin xyz="0 {} 0.05"/><mass value="0.05"/>{}</inertial>{}</link>'
FINGER_INERTIA = INERTIA.replace("0.01", "0.00001")
BOX = '<collision><origin xyz="0 {} 0.06"/><geometry><box size="{} 0.04"/></geometry></collision>'
FINGER = (
    '<joint name="{0}" type="prismatic"><parent link="palm"/><child link="{0}_link"/><axis xyz="0 {1} 0"/>'
    '<limit lower="{2}" upper="{3}" effort="{4}" velocity="1"/>{5}</joint>'
)
MIMIC = '<mimic joint="left" multiplier="{}"/>'
WHEEL = '<link name="wheel"/><joint name="wheel" type="continuous"><parent link="palm"/><child link="wheel"/></joint>'


def fingers(right_axis: str = "-1", right_range: str = "0 0.04", ratio: str = "1", effort: str = "20", box: str = "0.02 0.008"):
    """Two fingers that slide 0..40 mm from the middle; the inner faces of narrow boxes meet when closed."""
    low, high = right_range.split()
    half = 0.004 if box else 0.01
    shapes = [BOX.format(side * half, box) if box else "" for side in (1, -1)]
    return (
        LINK.format("left_link", half, FINGER_INERTIA, shapes[0])
        + LINK.format("right_link", -half, FINGER_INERTIA, shapes[1])
        + FINGER.format("left", "1", "0", "0.04", effort, "")
        + FINGER.format("right", right_axis, low, high, effort, MIMIC.format(ratio))
    )


# Their greatest width is 80 mm, twice the travel of each finger.
GRIPPERS = {
    "a mimic joint": fingers(),
    "a range that contradicts the mimic joint's ratio": fingers("1", "0 0.04", "-1"),
    "a motor that could destroy it": fingers(effort="1000"),
    "shapes that overlap in every position": fingers(box="0.02 0.3"),
    "no shapes": fingers(box=""),
    "a wheel that shows a motor": fingers() + WHEEL,
}


def gripper_arm(folder: Path, gripper: str) -> armctl.Arm:
    first = JOINT.format("j1", "revolute", "base", "one", LIMIT)
    second = JOINT.format("j2", "revolute", "one", "palm", LIMIT)
    mount = '<joint name="mount" type="fixed"><parent link="palm"/><child link="tool0"/><origin xyz="0 0 0.06"/></joint>'
    links = "".join(LINK.format(name, 0, INERTIA, "") for name in ("one", "palm"))
    path = folder / "robot.urdf"
    path.write_text(f'<robot name="r"><link name="base"/>{links}<link name="tool0"/>{first}{second}{mount}{gripper}</robot>')
    return armctl.load(path, tip="tool0")


@pytest.mark.filterwarnings("ignore::armctl.ArmctlWarning")
@pytest.mark.parametrize("kind", GRIPPERS)
def test_a_gripper_of_a_urdf_opens_and_goes_where_it_is_told(tmp_path: Path, kind: str):
    sim = armctl.Simulation(gripper_arm(tmp_path, GRIPPERS[kind]))
    assert sim.gripper.width_max == pytest.approx(0.08, abs=1e-3)
    for share in (1.0, 0.4):
        result = sim.gripper.move(share * sim.gripper.width_max)
        assert result.ok, result
        moved = sim.data.joint("left").qpos[0]
        assert moved == pytest.approx(0.5 * share * 0.08, abs=1.5e-3)
        assert abs(sim.data.joint("right").qpos[0]) == pytest.approx(moved, abs=5e-4)
    assert np.abs(sim.state.q - sim.arm.home).max() < 1e-3


@pytest.mark.filterwarnings("ignore::armctl.ArmctlWarning")
def test_reset_restores_contacts_and_limits_of_a_gripper(tmp_path: Path):
    sim = armctl.Simulation(gripper_arm(tmp_path, fingers("1", "0 0.04", "-1", box="0.02 0.3")))
    before = [sim.model.geom_contype.copy(), sim.model.geom_conaffinity.copy(), sim.model.jnt_limited.copy()]
    sim.gripper.open()
    during = [sim.model.geom_contype.copy(), sim.model.geom_conaffinity.copy(), sim.model.jnt_limited.copy()]
    sim.reset()
    after = [sim.model.geom_contype, sim.model.geom_conaffinity, sim.model.jnt_limited]
    assert not np.array_equal(before[2], during[2])
    for given, restored in zip(before, after, strict=True):
        assert np.array_equal(given, restored)


@pytest.mark.filterwarnings("ignore::armctl.ArmctlWarning")
def test_a_finger_without_a_range_is_refused_and_says_what_to_write(tmp_path: Path):
    locked = fingers().replace('lower="0" upper="0.04"', 'lower="0" upper="0"')
    with pytest.raises(armctl.ModelError, match="'left' has no range; give its joint one"):
        find_gripper_model(gripper_arm(tmp_path, locked))


@pytest.mark.filterwarnings("ignore::armctl.ArmctlWarning")
def test_what_moves_behind_the_tip_without_opening_is_no_gripper(tmp_path: Path):
    """A body without shape whose center of mass lies on its axis: nothing tells what it is."""
    knob = WHEEL.replace("continuous", "revolute").replace(
        "</joint>", '<limit lower="0" upper="1" effort="1" velocity="1"/></joint>'
    )
    with pytest.raises(armctl.ModelError, match="nothing attached to the tip opens or closes; the tip is 'tool0'"):
        find_gripper_model(gripper_arm(tmp_path, knob))

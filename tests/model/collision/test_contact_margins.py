"""Contact margins: MuJoCo's contacts act as soon as they meet, so proofs keep them free."""

import mujoco
import numpy as np
import pytest
from synthetic import mjcf

import armctl
from armctl.model.collision.checker import CollisionChecker

SHAPES = {
    "sphere": 'type="sphere" size="0.05"',
    "capsule": 'type="capsule" size="0.04 0.06"',
    "box": 'type="box" size="0.06 0.04 0.05"',
    "cylinder": 'type="cylinder" size="0.05 0.06"',
    "ellipsoid": 'type="ellipsoid" size="0.06 0.04 0.05"',
    "plane": 'type="plane" size="1 1 1"',
}

pytestmark = [pytest.mark.core, pytest.mark.filterwarnings("ignore::armctl.ArmctlWarning")]


def arm_before(folder, obstacle: str, margin: float, tip: str = "sphere") -> armctl.Arm:
    """A shape on two slides and a hinge, and an obstacle; both have a contact margin."""
    more = f'margin="{margin}"'
    limits = 'range="-1 1" armature="1"'
    bodies = (
        f'<geom name="obstacle" {SHAPES[obstacle]} {more}/><body name="tool" pos="0 0 0.5">'
        f'<joint name="x" type="slide" axis="1 0 0" {limits}/><joint name="z" type="slide" axis="0 0 1" {limits}/>'
        f'<joint name="turn" axis="0 1 0" {limits}/><geom name="tool" {SHAPES[tip]} mass="1" {more}/></body>'
    )
    path = folder / "arm.xml"
    motors = "".join(f'<motor joint="{joint}" ctrlrange="-100 100"/>' for joint in ("x", "z", "turn"))
    path.write_text(mjcf(bodies, f'<option gravity="0 0 0"/><actuator>{motors}</actuator>'))
    return armctl.load(path)


def force_of_contacts(arm: armctl.Arm, q: np.ndarray) -> float:
    """N, the largest constraint force of MuJoCo at rest."""
    data = mujoco.MjData(arm.model)
    data.qpos[:] = arm.qpos(q)
    mujoco.mj_forward(arm.model, data)
    return float(np.abs(data.qfrc_constraint).max())


@pytest.mark.parametrize("obstacle", SHAPES)
@pytest.mark.parametrize("tip", ["sphere", "box", "cylinder", "ellipsoid"])
def test_the_checker_sees_a_contact_where_mujoco_exerts_a_force(tmp_path, obstacle, tip):
    arm = arm_before(tmp_path, obstacle, 0.03, tip)
    checker = CollisionChecker(arm)
    rng = np.random.default_rng(0)
    forces = 0
    for _ in range(60):
        q = rng.uniform([-0.15, -0.5, -1.0], [0.15, -0.3, 1.0])
        has_force = force_of_contacts(arm, q) > 0.0
        forces += has_force
        if has_force:
            assert checker.at(q), q
    assert forces > 10


@pytest.mark.parametrize("obstacle", SHAPES)
def test_the_distance_of_a_sphere_is_that_of_its_surfaces_less_both_margins(tmp_path, obstacle):
    q = np.array([0.02, -0.2, 0.1])
    distances = []
    for margin in (0.0, 0.03):
        folder = tmp_path / f"{margin}"
        folder.mkdir()
        distances.append(CollisionChecker(arm_before(folder, obstacle, margin)).nearest(q)[1])
    assert distances[0] - distances[1] == pytest.approx(0.06, abs=1e-6)


def test_a_motion_inside_the_margins_is_not_proved(tmp_path):
    arm = arm_before(tmp_path, "box", 0.03)
    motion = armctl.move_j(arm, [-0.3, -0.37, 0.0], [0.3, -0.37, 0.0])  # 30 mm between the surfaces, 60 mm of margins
    check = armctl.check_clearance(arm, motion)
    assert not check.ok
    assert check.distance == pytest.approx(-0.03, abs=1e-3)

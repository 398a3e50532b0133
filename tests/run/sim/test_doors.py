"""Doors and cranks: a hand holds the handle, moves on its arc and turns as it has to; contacts are MuJoCo's."""

import numpy as np
import pytest
from arms import MISSING, at_hand
from gantry import GANTRY

import armctl

ON_ARC_M = 1e-3
GRIP_N = 30.0
COMPILER = '<compiler angle="radian"/>'
# A door that stands on its hinge, with a post on it that a hand holds from above.
DOOR = f"""<mujoco>{COMPILER}<worldbody><body name="door" pos="0.1 -0.25 0.1">
<joint name="hinge" axis="0 0 1" range="-0.1 1.9" damping="1" frictionloss="0.3"/>
<geom name="leaf" type="box" size="0.01 0.14 0.05" pos="0 0.15 0" mass="2"/>
<geom name="handle" type="capsule" size="0.012" fromto="0 0.28 0.05 0 0.28 0.15" mass="0.1"/></body></worldbody></mujoco>"""
# In front of an arm: a leaf with a vertical handle, or a crank with a peg along its axis.
FRONT_DOOR = f"""<mujoco>{COMPILER}<worldbody><body name="door" pos="0.75 0.3 0.45">
<joint name="hinge" axis="0 0 1" range="-1.9 0.1" damping="2" frictionloss="0.5"/>
<geom name="leaf" type="box" size="0.015 0.2 0.2" pos="0 -0.2 0" mass="3"/>
<geom name="handle" type="capsule" size="0.012" fromto="-0.075 -0.35 -0.05 -0.075 -0.35 0.05" mass="0.1"/>
<geom type="capsule" fromto="-0.075 -0.35 0.05 0 -0.35 0.05" size="0.008" mass="0.05"/>
<geom type="capsule" fromto="-0.075 -0.35 -0.05 0 -0.35 -0.05" size="0.008" mass="0.05"/></body></worldbody></mujoco>"""
CRANK = f"""<mujoco>{COMPILER}<worldbody><body name="crank" pos="0.7 0 0.6">
<joint name="hinge" axis="1 0 0" damping="0.2" frictionloss="0.1"/>
<geom type="capsule" size="0.01" fromto="0 0 0 0 0 -0.12" mass="0.3"/>
<geom name="handle" type="capsule" size="0.012" fromto="0 0 -0.12 -0.08 0 -0.12" mass="0.1"/></body></worldbody></mujoco>"""


def opened(sim: armctl.Simulation, at: armctl.Pose, axis: list[float], angle: float, play: list[float]) -> armctl.MoveResult:
    """Grasps the handle at a pose of the tip, and turns it about the hinge; the hand may turn in it by roll, pitch and yaw."""
    hinge = sim.data.joint("hinge").xanchor.copy()
    hand = [(sim.model.body(geom.bodyid[0]).name, "handle") for geom in map(sim.model.geom, range(sim.model.ngeom))]
    others = [pair for pair in dict.fromkeys(hand) if pair[0] not in ("world", "door", "crank")]
    assert sim.gripper.open()
    retreat = at @ armctl.Pose([0, 0, -0.08])
    assert (reached := sim.move_to(retreat)), reached
    assert (reached := sim.move_l(at.position if sim.arm.n < 6 else at, allow=others)), reached
    grip = sim.gripper.grasp(min(GRIP_N, sim.gripper.model.force_max))
    assert grip.grasped, grip
    assert grip.held in ("door", "crank")
    bounds = np.outer([0, 0, 0, *play], [-1, 1])
    arc = [sim.tip.turned_about(hinge, axis, share * angle) for share in np.linspace(0.0, 1.0, 100)]
    return sim.move_path(armctl.Region.union(armctl.Region(pose, bounds) for pose in arc), tip_speed=0.15, avoid=False)


def radius_changes(log: armctl.Log, hinge: np.ndarray, axis: list[float]) -> float:
    """m, by which the distance of the tip from the hinge's axis changes."""
    away = log.tip - hinge
    radii = np.linalg.norm(away - np.outer(away @ axis, axis), axis=1)
    return float(np.ptp(radii))


def loaded(robot: str, text: str, tmp_path) -> armctl.Arm:
    file = tmp_path / "scene.xml"
    file.write_text(text)
    if robot == "gantry":
        arm = tmp_path / "gantry.xml"
        arm.write_text(GANTRY)
        return armctl.load(arm, scene=file)
    if not at_hand(robot):
        pytest.skip(f"{robot}: {MISSING}")
    return armctl.load(robot, scene=file)


def test_a_hand_opens_a_door_and_turns_with_its_handle(tmp_path):
    arm = loaded("gantry", DOOR, tmp_path)
    sim = armctl.Simulation(arm, "computed-torque-observer")
    at = armctl.Pose([0.1, 0.03, 0.22], rpy=[np.pi, 0, 0])
    result = opened(sim, at, [0, 0, 1], 1.2, [0, 0, np.inf])
    assert result.ok, result.reason
    assert sim.data.joint("hinge").qpos[0] == pytest.approx(1.2, abs=0.01)
    assert radius_changes(result.log, sim.data.joint("hinge").xanchor, [0, 0, 1]) < ON_ARC_M


@pytest.mark.full
@pytest.mark.parametrize("robot", ["panda"])
def test_an_arm_opens_a_door_in_front_of_it_and_turns_a_crank(robot, tmp_path):
    arm = loaded(robot, FRONT_DOOR, tmp_path)
    sim = armctl.Simulation(arm, "computed-torque-observer")
    result = opened(sim, armctl.Pose([0.675, -0.05, 0.45], rpy=[0, np.pi / 2, 0]), [0, 0, 1], -1.0, [0.5, 0, 0])
    assert result.ok, result.reason
    assert sim.data.joint("hinge").qpos[0] == pytest.approx(-1.0, abs=0.01)
    assert radius_changes(result.log, sim.data.joint("hinge").xanchor, [0, 0, 1]) < ON_ARC_M
    crank = armctl.Simulation(loaded(robot, CRANK, tmp_path), "computed-torque-observer")
    result = opened(crank, armctl.Pose([0.635, 0, 0.48], rpy=[0, np.pi / 2, 0]), [1, 0, 0], -2 * np.pi, [0, 0, np.inf])
    assert result.ok, result.reason
    assert crank.data.joint("hinge").qpos[0] == pytest.approx(-2 * np.pi, abs=0.02)
    assert radius_changes(result.log, crank.data.joint("hinge").xanchor, [1, 0, 0]) < ON_ARC_M

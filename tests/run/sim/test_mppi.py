"""Sampling MPC: its futures are those of the simulation, its bits those of the seed, and it pushes a box to a pose."""

from pathlib import Path

import mujoco
import numpy as np
import pytest

import armctl

FILE = Path(__file__).parents[3] / "examples" / "models" / "desk_arm.urdf"
STICK = """<mujoco model="stick"><option cone="elliptic"/><worldbody><body name="stick">
<geom type="capsule" fromto="0 0 0 0 0 0.09" size="0.01" mass="0.1" friction="0.2" priority="1"/>
<site name="tip" pos="0 0 0.09"/></body></worldbody></mujoco>"""
BOX = np.array([0.35, 0.0, 0.025])
DOWN = [np.pi, 0.0, 0.0]

pytestmark = pytest.mark.filterwarnings("ignore::armctl.ArmctlWarning")


@pytest.fixture(scope="module")
def arm() -> armctl.Arm:
    scene = armctl.World().add("table", armctl.Box([0.6, 0.8, 0.02]), [0.35, 0.0, -0.01])
    scene.add("box", armctl.Box([0.08, 0.06, 0.05]), BOX + at(z=1e-4), mass=0.2)
    return armctl.load(FILE, tool=mujoco.MjSpec.from_string(STICK), scene=scene)


def at(x: float = 0.0, y: float = 0.0, z: float = 0.0) -> np.ndarray:
    return np.array([x, y, z])


def beside(arm: armctl.Arm, offset: np.ndarray) -> armctl.Simulation:
    """A simulation with the tip beside the box."""
    simulation = armctl.Simulation(arm, "computed-torque-observer")
    start = armctl.solve_ik(arm, armctl.Pose(BOX + offset, rpy=DOWN), np.zeros(arm.n), free_axis="z")
    simulation.reset(start.q)
    return simulation


@pytest.mark.full
def test_any_cost_can_be_given(arm):
    simulation = beside(arm, at(y=-0.1, z=0.02))
    goal = BOX + at(-0.1, -0.08, 0.1)
    axes = np.eye(3)
    mppi = armctl.MPPI(
        simulation, lambda futures: np.linalg.norm(futures.tip - goal, axis=2).mean(axis=1), axes=axes, threads=1
    )
    assert mppi.run(lambda sim: np.linalg.norm(sim.tip.position - goal) < 5e-3, 3.0)
    assert mppi.plans < 30
    downwards = simulation.tip.rotation[:, 2]
    np.testing.assert_allclose(downwards, [0.0, 0.0, -1.0], atol=0.02)


def test_the_futures_are_those_of_the_simulation(arm):
    """The tip and the box after one interval, while the arm pushes it straight ahead."""
    simulation = beside(arm, at(y=-0.06))
    futures = []

    def forwards(rollouts):
        futures.append(rollouts)
        return -rollouts.tip[:, -1, 1] + np.abs(rollouts.tip[:, :, 0] - BOX[0]).max(axis=1)

    mppi = armctl.MPPI(simulation, forwards, samples=32, temperature=1e-6, threads=1)
    mppi.run(lambda _: False, 1.0)
    plan = futures[-1]
    best = int(np.argmin(-plan.tip[:, -1, 1] + np.abs(plan.tip[:, :, 0] - BOX[0]).max(axis=1)))
    expected = plan.tip[best, 1], plan.pose("box")[0][best, 1]  # after one interval
    np.testing.assert_allclose(simulation.tip.position, expected[0], atol=3e-3)
    np.testing.assert_allclose(simulation.data.body("box").xpos, expected[1], atol=3e-3)
    assert simulation.data.body("box").xpos[1] > 5e-3


@pytest.mark.full
def test_the_same_seed_gives_the_same_bits_with_any_number_of_threads(arm):
    logs = []
    for threads, seed in ((1, 2), (3, 2), (1, 3)):
        simulation = beside(arm, at(y=-0.06))
        goal = armctl.Pose(BOX + at(y=0.2))
        armctl.push(simulation, "box", goal, timeout=0.6, samples=12, seed=seed, threads=threads)
        logs.append(simulation.log)
    np.testing.assert_array_equal(logs[0].q, logs[1].q)
    assert (logs[0].q != logs[2].q).any()


@pytest.mark.full
def test_it_pushes_a_box_to_a_pose(arm):
    goal = armctl.Pose(BOX + at(0.02, 0.07), rpy=[0.0, 0.0, 0.1])
    simulation = beside(arm, at(-0.02, -0.08))
    result = armctl.push(simulation, "box", goal, timeout=15.0, seed=1)
    assert result, result.reason
    place = simulation.data.body("box")
    assert np.linalg.norm(place.xpos - goal.position) == pytest.approx(result.position_error)
    assert result.position_error < 0.01
    assert np.arccos((np.trace(place.xmat.reshape(3, 3) @ goal.rotation.T) - 1) / 2) == pytest.approx(
        result.angle_error, abs=1e-6
    )
    assert result.angle_error < 0.1
    assert result.plans * 0.1 == pytest.approx(result.duration, abs=0.01)
    assert arm.limits.contains(simulation.log.q, tolerance=1e-6)


def test_what_was_not_reached_is_reported(arm):
    result = armctl.push(beside(arm, at(y=-0.1)), "box", armctl.Pose(BOX + at(y=0.2)), timeout=0.2)
    assert not result
    assert result.reason == "box is 200.0 mm and 0.00 rad from its goal after 0.2 s"
    assert result.plans == 2


def test_wrong_arguments_are_explained(arm):
    simulation = armctl.Simulation(arm)
    goal = armctl.Pose(BOX)
    for wrong, message in (
        (lambda: armctl.push(simulation, "table", goal), "body: 'table' is not loose; give it a mass in the scene"),
        (lambda: armctl.push(arm, "box", goal), "simulation: "),
        (lambda: armctl.push(simulation, "box", BOX), "goal: "),
        (lambda: armctl.MPPI(simulation, 3.0), "cost: expected a function"),
        (lambda: armctl.MPPI(simulation, np.sum, axes=[[1.0, 1.0, 0.0]]), "axes: expected directions of length 1"),
        (lambda: armctl.MPPI(simulation, lambda futures: np.zeros(3), samples=4).plan(), "cost: "),
    ):
        with pytest.raises(armctl.InputError, match=message):
            wrong()
    with pytest.raises(armctl.UnknownNameError, match="bux"):
        armctl.push(simulation, "bux", goal)

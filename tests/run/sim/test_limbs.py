"""All arms, legs or fingers of a robot in one simulation: none shakes another, and all move as each does alone."""

from collections.abc import Iterator

import mujoco
import numpy as np
import pytest
from arms import MISSING, at_hand, some_of
from synthetic import PAIR, mjcf, motors

import armctl

pytestmark = pytest.mark.filterwarnings("ignore::armctl.ArmctlWarning")


@pytest.fixture
def pair(tmp_path) -> armctl.Arm:
    path = tmp_path / "pair.xml"
    path.write_text(mjcf(PAIR, motors("a b c d e f")))
    return armctl.load(path, tips=["C", "F"])


def test_both_arms_move_as_each_does_alone(pair, tmp_path):
    together = armctl.simulate(pair, "computed-torque", armctl.move_j(pair, pair.home, pair.home + 0.5), dwell=0.0)
    for tip in pair.tips:
        one = armctl.load(tmp_path / "pair.xml", tip=tip)
        alone = armctl.simulate(one, "computed-torque", armctl.move_j(one, one.home, one.home + 0.5), dwell=0.0)
        own = list(pair.joints_to(tip))
        assert alone.joint_names == tuple(pair.joint_names[i] for i in own)
        assert np.allclose(alone.q, together.q[:, own], atol=1e-9)
        assert np.allclose(alone.tau, together.tau[:, own], atol=1e-6)


def test_each_arm_can_have_gains_of_its_own(pair, tmp_path):
    law = armctl.PDGravity(pair, stiffness=np.repeat([400.0, 200.0], 3), damping=np.repeat([40.0, 20.0], 3))
    together = armctl.simulate(pair, law, armctl.move_j(pair, pair.home, pair.home + 0.5), dwell=0.0)
    for tip, stiffness in (("C", 400.0), ("F", 200.0)):
        one = armctl.load(tmp_path / "pair.xml", tip=tip)
        own = armctl.PDGravity(one, stiffness=stiffness, damping=0.1 * stiffness)
        alone = armctl.simulate(one, own, armctl.move_j(one, one.home, one.home + 0.5), dwell=0.0)
        assert np.allclose(alone.q, together.q[:, list(pair.joints_to(tip))], atol=1e-9)


LIMBS = {
    "aloha": {},
    "anybotics_anymal_c/anymal_c": {},
    "unitree_go1/go1": {},
    "unitree_go2/go2": {},
    "unitree_h1/h1": {"tips": ["left_elbow_link", "right_elbow_link", "left_ankle_link", "right_ankle_link"]},
    "wonik_allegro/left_hand": {},
    "shadow_hand/left_hand": {
        "tips": ["lh_ffproximal", "lh_mfproximal", "lh_rfproximal", "lh_lfproximal", "lh_thdistal"],
        "base": "lh_palm",
    },
}


@pytest.fixture(scope="module", params=some_of(LIMBS, ["unitree_go2/go2"], ["wonik_allegro/right"]))
def robot(request: pytest.FixtureRequest) -> armctl.Arm:
    """All arms, legs or fingers of a robot."""
    if not at_hand(request.param.partition("/")[0]):
        pytest.skip(f"{request.param}: {MISSING}")
    return armctl.load(request.param, **LIMBS[request.param])


def test_limbs_at_rest_feel_nothing_of_one_that_moves(robot: armctl.Arm):
    moving = robot.joints_to(robot.tip)[-1]  # the last joint to the first tip, whose small motion touches nothing
    goal = robot.home.copy()
    goal[moving] += 0.05
    motion = armctl.move_j(robot, robot.home, robot.limits.clamp(goal))
    log = armctl.simulate(robot, "computed-torque", motion, dwell=0.1)
    assert log.failure == ""
    assert np.abs(log.q - log.q_ref).max() < 1e-6
    others = [i for i in range(robot.n) if i not in robot.joints_to(robot.tip)]
    assert others
    assert np.abs(log.q[:, others] - robot.home[others]).max() < 1e-9


def test_the_limb_whose_target_is_out_of_reach_is_named(robot: armctl.Arm):
    targets = {tip: robot.fk(robot.home, tip).position for tip in robot.tips[:-1]} | {robot.tips[-1]: [9, 9, 9]}
    result = armctl.Simulation(robot).move_to(targets)
    assert not result
    assert f"{robot.tips[-1]} is " in result.reason
    assert result.log is None


def test_the_arms_of_aloha_go_around_each_other():
    if not at_hand("aloha"):
        pytest.skip(f"aloha: {MISSING}")
    sim = armctl.Simulation("aloha")
    arm = sim.arm
    start, goal = next(pair for pair in _ends(arm) if _touching(arm, np.linspace(*pair, 300)))
    sim.reset(q=start)
    result = sim.move_to({tip: arm.fk(goal, tip) for tip in arm.tips})
    assert result, result.reason
    assert not _touching(arm, result.log.q)


def _ends(arm: armctl.Arm) -> Iterator[np.ndarray]:
    """Pairs of configurations, (2, n), in which nothing touches."""
    for pair in np.random.default_rng(0).uniform(arm.limits.q_min, arm.limits.q_max, (10_000, 2, arm.n)):
        ends = arm.home + 0.4 * (pair - arm.home)
        if not _touching(arm, ends):
            yield ends


def _touching(arm: armctl.Arm, configurations: np.ndarray) -> bool:
    """Whether MuJoCo finds that something touches at one of some configurations, (k, n)."""
    data = mujoco.MjData(arm.model)
    for q in configurations:
        data.qpos[:] = arm.qpos(q)
        mujoco.mj_kinematics(arm.model, data)
        mujoco.mj_collision(arm.model, data)
        if any(contact.dist < 0.0 for contact in data.contact):
            return True
    return False

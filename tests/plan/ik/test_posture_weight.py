"""Steps with a weight of the posture: robots find back from targets far out of reach. MuJoCo judges where the tips are."""

import mujoco
import numpy as np
import pytest
from arms import MISSING, at_hand
from synthetic import ON_A_TORSO, TWO_ARMS

import armctl
from armctl import STAY, InputError

pytestmark = pytest.mark.filterwarnings("ignore::armctl.ArmctlWarning")
DT = 0.005
JUMPS = 6  # of the targets, each followed for two seconds
SEEDS = 10
FEET = ("left_ankle_link", "right_ankle_link")
HANDS = ("left_elbow_link", "right_elbow_link")


class Places:
    """Where tips are by MuJoCo."""

    def __init__(self, arm: armctl.Arm):
        self.arm = arm
        self.data = mujoco.MjData(arm.model)

    def of(self, tips: tuple[str, ...], q: np.ndarray) -> dict[str, np.ndarray]:
        self.data.qpos[:] = self.arm.qpos(q)
        mujoco.mj_kinematics(self.arm.model, self.data)
        frames = {frame.name: frame for frame in self.arm.tip_frames}
        found = {}
        for tip in tips:
            rotation = self.data.xmat[frames[tip].body].reshape(3, 3)
            found[tip] = self.data.xpos[frames[tip].body] + rotation @ frames[tip].T_body_tip.position
        return found


def bent(arm: armctl.Arm) -> np.ndarray:
    return arm.limits.clamp(arm.home + 0.3)


@pytest.fixture(scope="module")
def torso() -> armctl.Arm:
    return armctl.load(mujoco.MjSpec.from_string(ON_A_TORSO))


def left_over(arm: armctl.Arm, posture: np.ndarray, weight: float, seed: int, tips: tuple[str, ...], stay: tuple = ()) -> float:
    """How far tips are from their first places, m, after targets at random and eight seconds with targets there again."""
    rng = np.random.default_rng(seed)
    places = Places(arm)
    first = places.of(tips, posture)
    feet = places.of(stay, posture)
    ik = armctl.DifferentialIk(arm, posture=posture, posture_weight=weight)
    q = posture.copy()
    for jump in range(JUMPS + 4):
        scale = rng.choice([0.1, 0.3, 2.0]) if jump < JUMPS else 0.0
        targets = {tip: place + scale * rng.normal(size=3) for tip, place in first.items()} | dict.fromkeys(stay, STAY)
        for _ in range(400):
            q = q + DT * ik.step(q, targets, DT)
        assert all(np.linalg.norm(place - feet[tip]) < 1e-6 for tip, place in places.of(stay, q).items())
    return max(float(np.linalg.norm(place - first[tip])) for tip, place in places.of(tips, q).items())


def test_arms_on_a_torso_find_back_more_often(torso: armctl.Arm):
    lost = {
        weight: sum(left_over(torso, bent(torso), weight, seed, torso.tips) > 1e-3 for seed in range(SEEDS))
        for weight in (0.0, 0.1)
    }
    assert lost[0.0] > 2
    assert lost[0.1] < 0.5 * lost[0.0]


@pytest.mark.skipif(not at_hand("unitree_h1"), reason=MISSING)
def test_a_humanoid_finds_back_with_both_hands_while_its_feet_stay():
    arm = armctl.load("unitree_h1", base="free")
    for seed in range(100, 100 + SEEDS):
        assert left_over(arm, arm.home, 0.1, seed, HANDS, FEET) < 1e-5


def settled(arm: armctl.Arm, targets: dict, weight: float) -> np.ndarray:
    ik = armctl.DifferentialIk(arm, posture=bent(arm), posture_weight=weight)
    q = bent(arm)
    for _ in range(1200):
        q = q + DT * ik.step(q, targets, DT)
    return q


def test_it_makes_no_difference_at_targets_that_are_reached(torso: armctl.Arm):
    targets = Places(torso).of(torso.tips, bent(torso) + 0.2)
    ends = [settled(torso, targets, weight) for weight in (0.0, 0.1)]
    for q in ends:
        for tip, place in Places(torso).of(torso.tips, q).items():
            assert np.linalg.norm(place - targets[tip]) < 1e-6
    assert ends[0] == pytest.approx(ends[1], abs=1e-3)


def test_a_tip_stays_farther_away_from_a_target_out_of_reach_and_the_other_arm_does_not_notice():
    arm = armctl.load(mujoco.MjSpec.from_string(TWO_ARMS))
    first = Places(arm).of(arm.tips, bent(arm))
    targets = {"l": first["l"] + [0.0, 0.05, 0.05], "r": first["r"] + [2.0, -1.0, 0.0]}
    far = {}
    for weight in (0.0, 0.1):
        places = Places(arm).of(arm.tips, settled(arm, targets, weight))
        far[weight] = np.linalg.norm(places["r"] - targets["r"])
        assert np.linalg.norm(places["l"] - targets["l"]) < 1e-6
    assert far[0.0] < far[0.1] < far[0.0] + 0.15


def test_a_single_target_has_the_weight_too():
    arm = armctl.load("robot_arm_3dof")
    target = arm.fk(arm.home + 0.3).position
    ik = armctl.DifferentialIk(arm, posture_weight=0.1)
    q = arm.home.copy()
    by_tip = armctl.DifferentialIk(arm, posture_weight=0.1)
    for _ in range(600):
        v = ik.step(q, target, DT)
        assert np.array_equal(v, by_tip.step(q, {arm.tip: target}, DT))
        q = q + DT * v
    assert np.linalg.norm(arm.fk(q).position - target) < 1e-6


@pytest.mark.parametrize("weight", [-0.1, np.inf, "much", 1e9])
def test_a_wrong_weight_is_one_sentence(torso: armctl.Arm, weight: object):
    with pytest.raises(InputError, match="posture_weight: "):
        armctl.DifferentialIk(torso, posture_weight=weight)  # type: ignore[arg-type]


def test_a_weight_that_could_not_act_is_refused_and_so_is_a_pose_for_several_tips(torso: armctl.Arm):
    arm = armctl.load("robot_arm_3dof")
    with pytest.raises(InputError, match="posture_weight: without a gain"):
        armctl.DifferentialIk(arm, posture_weight=0.1, posture_gain=0.0)
    with pytest.raises(InputError, match="posture_weight: it is for targets by tip"):
        armctl.DifferentialIk(arm, posture_weight=0.1, avoid=True)
    for options in ({"posture_weight": 0.1}, {"center_of_mass_within": [[0, 0], [1, 0], [0, 1]]}):
        with pytest.raises(InputError, match="a pose is for one"):
            armctl.DifferentialIk(torso, **options).step(torso.home, [0.5, 0.0, 0.5], DT)

"""Several arms in one simulation: each with its own target, controller and verdict, and none shakes another."""

import warnings

import numpy as np
import pytest
from arms import MISSING, at_hand
from synthetic import limb, mjcf, motors

import armctl

PAIR = limb("a b c") + limb("d e f").replace('pos="0.1 0 0.1"', 'pos="-0.5 0 0.1"', 1)


@pytest.fixture
def pair(tmp_path):
    def loaded(bodies: str = PAIR, names: str = "a b c d e f", tips: tuple[str, ...] = ("C", "F"), **how):
        path = tmp_path / "pair.xml"
        path.write_text(mjcf(bodies, motors(names)))
        return armctl.load_arms(path, tips, **how)

    return loaded


def test_one_moves_and_the_other_feels_nothing(pair):
    first, second = pair()
    team = armctl.Team([first, second])
    logs = team.run({"C": armctl.move_j(first, first.home, first.home + 0.8)}, dwell=0.1)
    assert np.abs(logs["C"].q - logs["C"].q_ref).max() < 1e-9
    assert np.abs(logs["F"].q - second.home).max() < 1e-9
    assert np.ptp(logs["F"].tau, axis=0).max() < 1e-6


def test_a_team_moves_as_its_arms_do_alone(pair):
    first, second = pair()
    motions = {arm.tip: armctl.move_j(arm, arm.home, arm.home + sign * 0.5) for arm, sign in ((first, 1), (second, -1))}
    together = armctl.Team([first, second]).run(motions)
    for arm in (first, second):
        alone = armctl.simulate(arm, "computed-torque", motions[arm.tip], dwell=0.0)
        rows = min(len(alone.t), len(together[arm.tip].t))
        assert np.allclose(alone.q[:rows], together[arm.tip].q[:rows], atol=1e-9)
        assert together[arm.tip].joint_names == arm.joint_names


def test_verdicts_apiece(pair):
    first, second = pair()
    team = armctl.Team([first, second], controllers={"F": "pd"})
    results = team.move_to({"C": first.fk(first.home + 0.3).position, "F": [9, 9, 9]})
    assert results["C"].ok
    assert not results["F"].ok
    assert results["F"].reason.startswith("out of reach by ")
    assert armctl.Report.from_log(results["C"].log).to_dict()["controller"] == "computed-torque"
    team.reset()
    assert team.data.time == 0


def test_arms_that_would_shake_each_other_are_refused(pair):
    trunk = limb("t", limb("a b") + limb("d e"))
    with pytest.raises(armctl.ModelError, match="share joint 't', which only one of them could move; base='T' holds"):
        pair(trunk, "t a b d e", ("B", "E"))
    held = pair(trunk, "t a b d e", ("B", "E"), base="T")
    assert [arm.joint_names for arm in held] == [("a", "b"), ("d", "e")]
    with pytest.raises(armctl.ModelError, match="share joints 't', 'u', which only one of them could move; base='U' holds"):
        pair(limb("t u", limb("a b") + limb("d e")), "t u a b d e", ("B", "E"))
    with pytest.raises(armctl.ModelError, match="one of the chains to 'B' and 'A' is part of the other; give each chain once"):
        pair(trunk, "t a b d e", ("B", "A"))
    with pytest.raises(armctl.InputError, match="tips: 'B' is no list of names"):
        armctl.load_arms("robot_arm_3dof", "B")


def test_each_chain_can_stand_on_a_base_of_its_own(pair):
    trunk = limb("r", limb("t", limb("a b") + limb("d e")) + limb("f g"))
    arms = pair(trunk, "r t a b d e f g", ("B", "E", "G"), base=["T", "T", "R"])
    assert [arm.joint_names for arm in arms] == [("a", "b"), ("d", "e"), ("f", "g")]
    with pytest.raises(armctl.InputError, match="base: 2 given for 3 tips; give one for each, or one for all"):
        pair(trunk, "r t a b d e f g", ("B", "E", "G"), base=["T", "R"])


def test_wrong_calls_are_refused(pair, bundled: armctl.Arm):
    arms = pair()
    with pytest.raises(armctl.InputError, match=r"arms of one model wanted; armctl\.load_arms gives them"):
        armctl.Team([arms[0], bundled])
    with pytest.raises(armctl.UnknownNameError, match="unknown tip 'X'; known: C, F"):
        armctl.Team(arms).move_to({"X": [0, 0, 0]})
    with pytest.raises(armctl.InputError, match="a team has no single tip for a payload"):
        armctl.Team(arms, plant=armctl.Plant(payload=1.0))


TEAMS = {
    "aloha": (["left/gripper", "right/gripper"], {}),
    "anybotics_anymal_c/anymal_c": (["LF_SHANK", "RF_SHANK", "LH_SHANK", "RH_SHANK"], {"hold_base": True}),
    "unitree_go1/go1": (["FR", "FL", "RR", "RL"], {"hold_base": True}),
    "unitree_go2/go2": (["FR", "FL", "RR", "RL"], {"hold_base": True}),
    "unitree_h1/h1": (
        ["left_elbow_link", "right_elbow_link", "left_ankle_link", "right_ankle_link"],
        {"hold_base": True, "base": ["torso_link", "torso_link", None, None]},
    ),
    "wonik_allegro/left_hand": (["ff_tip", "mf_tip", "rf_tip", "th_tip"], {}),
    "shadow_hand/left_hand": (
        ["lh_ffproximal", "lh_mfproximal", "lh_rfproximal", "lh_lfproximal", "lh_thdistal"],
        {"base": "lh_palm"},
    ),
}


@pytest.fixture(scope="module", params=TEAMS)
def limbs(request: pytest.FixtureRequest) -> tuple[armctl.Arm, ...]:
    """All arms, legs or fingers of a robot."""
    if not at_hand(request.param.partition("/")[0]):
        pytest.skip(f"{request.param}: {MISSING}")
    tips, how = TEAMS[request.param]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", armctl.ArmctlWarning)
        return armctl.load_arms(request.param, tips, **how)


def test_two_arms_four_legs_five_fingers_move_at_once(limbs: tuple[armctl.Arm, ...]):
    logs = armctl.Team(limbs).run({arm.tip: _small_motion(arm) for arm in limbs})
    for tip, log in logs.items():
        assert log.failure == ""
        assert np.abs(log.q - log.q_ref).max() < 1e-6, tip


def test_limbs_at_rest_feel_nothing_of_one_that_moves(limbs: tuple[armctl.Arm, ...]):
    moving, *still = limbs
    logs = armctl.Team(limbs).run({moving.tip: _small_motion(moving)}, dwell=0.1)
    assert np.ptp(logs[moving.tip].q, axis=0).max() > 0.01
    for arm in still:
        assert np.abs(logs[arm.tip].q - arm.home).max() < 1e-9, arm
        assert np.ptp(logs[arm.tip].tau, axis=0).max() < 1e-6 * arm.limits.tau_max.max(), arm


def test_each_limb_gets_a_verdict_of_its_own(limbs: tuple[armctl.Arm, ...]):
    targets = {arm.tip: arm.fk(_bent(arm)).position for arm in limbs[:-1]} | {limbs[-1].tip: [9, 9, 9]}
    results = armctl.Team(limbs).move_to(targets)
    assert [result.ok for result in results.values()] == [True] * (len(limbs) - 1) + [False]
    assert results[limbs[-1].tip].reason.startswith("out of reach by")


def _small_motion(arm: armctl.Arm):
    """A small motion of the last joint, which touches nothing."""
    return armctl.move_j(arm, arm.home, _bent(arm))


def _bent(arm: armctl.Arm) -> np.ndarray:
    return arm.limits.clamp(arm.home + np.append(np.zeros(arm.n - 1), 0.05))

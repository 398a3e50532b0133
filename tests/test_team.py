"""Several arms in one simulation: each with its own target, controller and verdict, and none shakes another."""

import numpy as np
import pytest
from arms import arm_of, at_hand
from test_chain import limb, mjcf, motors

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
    logs = team.run({"C": armctl.move_j(first, first.home, first.home + 0.8)}, settle=0.1)
    assert np.abs(logs["C"].q - logs["C"].q_ref).max() < 1e-9
    assert np.abs(logs["F"].q - second.home).max() < 1e-9
    assert np.ptp(logs["F"].tau, axis=0).max() < 1e-6


def test_a_team_moves_as_its_arms_do_alone(pair):
    first, second = pair()
    motions = {arm.tip: armctl.move_j(arm, arm.home, arm.home + sign * 0.5) for arm, sign in ((first, 1), (second, -1))}
    together = armctl.Team([first, second]).run(motions)
    for arm in (first, second):
        alone = armctl.simulate(arm, "computed-torque", motions[arm.tip], settle=0.0)
        rows = min(len(alone.t), len(together[arm.tip].t))
        assert np.allclose(alone.q[:rows], together[arm.tip].q[:rows], atol=1e-9)
        assert together[arm.tip].joint_names == arm.joint_names


def test_verdicts_apiece(pair):
    first, second = pair()
    team = armctl.Team([first, second], controllers={"F": "pd"})
    results = team.move_to({"C": first.fk(first.home + 0.3).position, "F": [9, 9, 9]})
    assert results["C"].reached
    assert not results["F"].reached
    assert results["F"].reason.startswith("out of reach by ")
    assert armctl.Report.from_log(results["C"].log).to_dict()["controller"] == "computed-torque"
    team.reset()
    assert team.data.time == 0


def test_arms_that_would_shake_each_other_are_refused(pair):
    trunk = limb("t", limb("a b") + limb("d e"))
    with pytest.raises(armctl.ModelError, match="the chains to 'B' and 'E' share joint 't'; base= can be a body behind it"):
        pair(trunk, "t a b d e", ("B", "E"))
    held = pair(trunk, "t a b d e", ("B", "E"), base="T")
    assert [arm.joint_names for arm in held] == [("a", "b"), ("d", "e")]
    with pytest.raises(armctl.InputError, match="tips: 'B' given, a list of names wanted"):
        armctl.load_arms("robot_arm_3dof", "B")


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
    "unitree_go1/go1": (["FR", "FL", "RR", "RL"], {"hold_base": True}),
    "wonik_allegro/left_hand": (["ff_tip", "mf_tip", "rf_tip", "th_tip"], {}),
    "shadow_hand/left_hand": (
        ["lh_ffproximal", "lh_mfproximal", "lh_rfproximal", "lh_lfproximal", "lh_thdistal"],
        {"base": "lh_palm"},
    ),
}


@pytest.mark.filterwarnings("ignore::armctl.ArmctlWarning")
@pytest.mark.parametrize("robot", TEAMS)
def test_two_arms_four_legs_five_fingers(robot: str):
    if not at_hand(robot.partition("/")[0]):
        arm_of(robot)
    tips, how = TEAMS[robot]
    arms = armctl.load_arms(robot, tips, **how)
    assert len(arms) == len(tips)
    logs = armctl.Team(arms).run({arm.tip: _small_motion(arm) for arm in arms})
    for tip, log in logs.items():
        assert log.end == ""
        assert np.abs(log.q - log.q_ref).max() < 1e-6, tip


def _small_motion(arm: armctl.Arm):
    """A small motion of the last joint, which touches nothing."""
    bent = np.append(np.zeros(arm.n - 1), 0.05)
    return armctl.move_j(arm, arm.home, arm.limits.clamp(arm.home + bent))

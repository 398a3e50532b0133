"""Several arms in one simulation: each with its own target, controller and verdict, and none shakes another."""

import warnings
from dataclasses import replace

import mujoco
import numpy as np
import pytest
from arms import MISSING, at_hand, some_of
from synthetic import PAIR, limb, mjcf, motors

import armctl


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


def test_a_planning_controller_in_a_team_foresees_the_reference_of_its_own_arm(pair):
    first, second = pair()
    motion = armctl.move_j(second, second.home, second.home + 0.5)
    torques = armctl.simulate(second, "computed-torque", motion).tau_cmd
    weak = second.with_limits(replace(second.limits, tau_max=0.9 * np.abs(torques).max(axis=0)))  # so that MPC has to plan
    together = armctl.Team([first, weak], controllers={"F": armctl.MPC(weak)}).run({"F": motion})["F"]
    alone = armctl.simulate(weak, armctl.MPC(weak), motion, dwell=0.0)
    rows = min(len(alone.t), len(together.t))
    assert np.allclose(alone.tau_cmd[:rows], together.tau_cmd[:rows], atol=1e-6)


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
    with pytest.raises(armctl.InputError, match="tips: 'B' is not a list of names"):
        armctl.load_arms("robot_arm_3dof", "B")


def test_each_chain_can_stand_on_a_base_of_its_own(pair):
    trunk = limb("r", limb("t", limb("a b") + limb("d e")) + limb("f g"))
    arms = pair(trunk, "r t a b d e f g", ("B", "E", "G"), base=["T", "T", "R"])
    assert [arm.joint_names for arm in arms] == [("a", "b"), ("d", "e"), ("f", "g")]
    with pytest.raises(armctl.InputError, match="base: 2 given for 3 tips; give one for each, or one for all"):
        pair(trunk, "r t a b d e f g", ("B", "E", "G"), base=["T", "R"])


def test_wrong_calls_are_refused(pair, bundled: armctl.Arm):
    arms = pair()
    with pytest.raises(armctl.InputError, match=r"expected arms of one model; armctl\.load_arms returns them"):
        armctl.Team([arms[0], bundled])
    with pytest.raises(armctl.UnknownNameError, match="unknown tip 'X'; known: C, F"):
        armctl.Team(arms).move_to({"X": [0, 0, 0]})
    with pytest.raises(armctl.InputError, match="a team has no single tip for a payload"):
        armctl.Team(arms, plant=armctl.Plant(payload=1.0))


class Failing:
    """Raises an exception, or returns something that is no torque, from a time on."""

    name = "failing"

    def __init__(self, value=None, error: BaseException | None = None):
        self.value = value
        self.error = error

    def torque(self, state, setpoint):
        if state.t < 0.1 - 1e-9:
            return np.zeros(3)
        if self.error is not None:
            raise self.error
        return self.value


@pytest.mark.parametrize("tip", ["C", "F"])
@pytest.mark.parametrize(
    ("law", "cause"),
    [
        (Failing(error=ZeroDivisionError("division by zero")), "division by zero"),
        (Failing(None), "torque: expected 3 numbers, but the controller returned None"),
        (Failing(np.zeros(2)), "torque: expected 3 numbers, got 2"),
        (Failing(["a", "b", "c"]), "torque: .* is not an array of numbers"),
    ],
)
@pytest.mark.parametrize("command", ["run", "move_to"])
def test_a_controller_that_fails_raises_simulation_error_with_the_log_of_its_arm(pair, tip, law, cause, command):
    arms = pair()
    team = armctl.Team(arms, {tip: law})
    motions = {arm.tip: armctl.move_j(arm, arm.home, arm.home + 0.5) for arm in arms}
    targets = {arm.tip: arm.fk(arm.home + 0.5).position for arm in arms}
    with pytest.raises(armctl.SimulationError, match=f"the controller failing of '{tip}' failed at 0.100 s: {cause}") as caught:
        team.run(motions) if command == "run" else team.move_to(targets)
    assert caught.value.log is team.logs[tip]
    assert caught.value.log.controller == "failing"
    assert {name: len(log) for name, log in team.logs.items()} == {"C": 50, "F": 50}
    team.controllers[tip] = armctl.PD(team.arms[tip])
    assert team.run({}, dwell=0.1)[tip].failure == ""
    team.reset()
    assert team.data.time == 0


def test_ctrl_c_leaves_the_logs_of_all_arms(pair):
    team = armctl.Team(pair(), {"F": Failing(error=KeyboardInterrupt())})
    with pytest.raises(KeyboardInterrupt):
        team.run({}, dwell=1.0)
    assert {tip: len(log) for tip, log in team.logs.items()} == {"C": 50, "F": 50}
    assert team.logs["C"].failure == "interrupted at 0.100 s by KeyboardInterrupt"


def test_a_team_prefers_a_solution_without_contact_as_a_simulation_does(pair):
    arms = pair()
    target = arms[0].fk(arms[0].home + 0.4).position
    alone = armctl.Simulation(arms[0]).move_to(target)
    together = armctl.Team(arms).move_to({"C": target})["C"]
    rows = min(len(alone.log), len(together.log))
    assert np.array_equal(alone.log.q_ref[:rows], together.log.q_ref[:rows])


def test_speed_slows_a_team(pair):
    arms = pair()
    target = {"C": arms[0].fk(arms[0].home + 0.4).position}
    full = armctl.Team(arms).move_to(target)["C"]
    half = armctl.Team(arms).move_to(target, speed=0.5)["C"]
    assert half.log.motion_duration == pytest.approx(2 * full.log.motion_duration, rel=1e-6)


@pytest.mark.parametrize(
    ("call", "sentence"),
    [
        (lambda arms: armctl.Team(arms, {"C": 3}), "controller: 3 has no method torque"),
        (lambda arms: armctl.Team(arms, {"C": None}), "controller: None has no method torque"),
        (lambda arms: armctl.Team(arms, ["pd", "pd"]), "controllers: .* is not a mapping by tip"),
        (lambda arms: armctl.Team(arms, plant=3), "plant: expected Plant, got 3"),
        (lambda arms: armctl.Team(arms).run([]), r"trajectories: \[\] is not a mapping by tip"),
        (lambda arms: armctl.Team(arms).run({"C": 3}), "trajectory: 3 is not a trajectory"),
        (lambda arms: armctl.Team(arms).run({}, dwell=1e9), "at most 10,000,000 fit into a log"),
        (lambda arms: armctl.Team(arms).run({}, dwell="1"), "dwell: '1' is not a number"),
        (lambda arms: armctl.Team(arms).move_to([0, 0, 0]), "targets: .* is not a mapping by tip"),
        (lambda arms: armctl.Team(arms).move_to({"C": [0, 0]}), "target: expected 3 numbers, got 2"),
        (lambda arms: armctl.Team(arms).move_to({"C": [0, 0, 9]}, speed=0), "speed: expected .*got 0"),
        (lambda arms: armctl.Team(arms).tip(["C"]), r"tip: \['C'\] is not a name"),
        (lambda arms: armctl.Team(arms).gripper("X"), "unknown tip 'X'; known: C, F"),
        (
            lambda arms: armctl.Team(arms).run({"C": armctl.move_j(arms[1], arms[1].home, arms[1].home)}),
            "planned for the joints",
        ),
    ],
)
def test_a_wrong_call_of_a_team_is_one_sentence(pair, call, sentence: str):
    with pytest.raises(armctl.ArmctlError, match=sentence) as caught:
        call(pair())
    assert len(str(caught.value)) <= 400


TEAMS = {
    "aloha": (["left/gripper", "right/gripper"], {}),
    "anybotics_anymal_c/anymal_c": (["LF_SHANK", "RF_SHANK", "LH_SHANK", "RH_SHANK"], {}),
    "unitree_go1/go1": (["FR", "FL", "RR", "RL"], {}),
    "unitree_go2/go2": (["FR", "FL", "RR", "RL"], {}),
    "unitree_h1/h1": (
        ["left_elbow_link", "right_elbow_link", "left_ankle_link", "right_ankle_link"],
        {"base": ["torso_link", "torso_link", None, None]},
    ),
    "wonik_allegro/left_hand": (["ff_tip", "mf_tip", "rf_tip", "th_tip"], {}),
    "shadow_hand/left_hand": (
        ["lh_ffproximal", "lh_mfproximal", "lh_rfproximal", "lh_lfproximal", "lh_thdistal"],
        {"base": "lh_palm"},
    ),
}


@pytest.fixture(scope="module", params=some_of(TEAMS, ["unitree_go2/go2"], ["unitree_go1/go1", "anybotics_anymal_c/anymal_c"]))
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


def test_the_arms_of_aloha_exchange_places_without_contact():
    if not at_hand("aloha"):
        pytest.skip(f"aloha: {MISSING}")
    team = armctl.Team(armctl.load_arms("aloha", ["left/gripper", "right/gripper"]))
    left, right = team.arms
    places = {left: team.tip(right).position, right: team.tip(left).position}
    assert _touching_ticks(team, team.move_to(places, avoid=False)) > 0
    team.reset()
    results = team.move_to(places)
    assert all(result.ok for result in results.values()), results
    assert _touching_ticks(team, results) == 0


def _touching_ticks(team: armctl.Team, results: dict[str, armctl.MoveResult]) -> int:
    """At how many logged ticks MuJoCo finds something of one arm in something else."""
    data = mujoco.MjData(team.model)
    data.qpos[:] = next(iter(team.arms.values())).home_qpos
    touching = 0
    for rows in zip(*(results[tip].log.q for tip in team.arms), strict=True):
        for arm, q in zip(team.arms.values(), rows, strict=True):
            data.qpos[arm.joint_map.qpos_adr] = arm.joint_map.positions(q)
        mujoco.mj_kinematics(team.model, data)
        mujoco.mj_collision(team.model, data)
        touching += any(contact.dist < 0.0 for contact in data.contact)
    return touching


def _small_motion(arm: armctl.Arm):
    """A small motion of the last joint, which touches nothing."""
    return armctl.move_j(arm, arm.home, _bent(arm))


def _bent(arm: armctl.Arm) -> np.ndarray:
    return arm.limits.clamp(arm.home + np.append(np.zeros(arm.n - 1), 0.05))

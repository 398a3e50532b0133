"""Environments with a gate: what a policy asks for touches nothing, and what is free has the same bits."""

from typing import Any

import gymnasium
import numpy as np
import pytest
from arms import BUNDLED, some_of

import armctl
from armctl.envs import ArmEnv, ArmVectorEnv

STEPS = 60
MODES = ["joint_target", "joint_delta", "cartesian_delta"]


def actions(size: int, seed: int) -> np.ndarray:
    """Of a policy that is not trained: full actions that keep their direction for some steps."""
    rng = np.random.default_rng(seed)
    return np.repeat(rng.uniform(-1.0, 1.0, (STEPS // 10, size)), 10, axis=0).clip(-1, 1)


def episode(task: str, action: str, seed: int, **options: Any) -> tuple[list[np.ndarray], list[dict[str, Any]]]:
    """Observations and information of an episode."""
    env = ArmEnv(BUNDLED, task, action, horizon=STEPS, **options)
    first, _ = env.reset(seed=seed)
    seen = [first]
    found = []
    for each in actions(env.action_space.shape[0], seed):
        observation, _, _, _, information = env.step(each)
        seen.append(observation)
        found.append(information)
    env.close()
    return seen, found


@pytest.mark.parametrize(
    "action", some_of(["joint_delta", "joint_target", "cartesian_delta"], ["joint_target"], ["joint_delta", "cartesian_delta"])
)
def test_a_policy_that_touches_the_obstacle_does_not_with_a_gate(action: str):
    touched = 0
    refused = 0
    for seed in range(2 if action == "joint_target" else 4):
        touched += sum(bool(each["touched"]) for each in episode("ReachPast", action, seed)[1])
        gated = episode("ReachPast", action, seed, gate=True)[1]
        refused += sum(bool(each["refusal"]) for each in gated)
        assert not any(each["touched"] for each in gated)
    assert refused > 0
    assert touched > 0 or action != "joint_target"


def test_what_passes_has_the_same_bits_with_and_without_a_gate():
    free = [np.zeros(3)] * 5
    seen = []
    for gate in (False, True):
        env = ArmEnv(BUNDLED, "Reach", "joint_delta", gate=gate)
        env.reset(seed=1)
        results = [env.step(0.1 * np.ones(3)) for _ in free]
        seen.append(np.array([result[0] for result in results]))
        assert all(result[4].get("refusal", "") == "" for result in results)
        assert ("refusal" in results[0][4]) == gate
    assert (seen[0] == seen[1]).all()


def test_a_vector_of_environments_has_the_refusals_of_single_ones():
    env = ArmVectorEnv(BUNDLED, "ReachPast", "joint_delta", num_envs=2, horizon=STEPS, gate=True)
    env.reset(seed=3)
    single = episode("ReachPast", "joint_delta", 3, gate=True)[1]
    both = [env.step(np.stack([each, each]))[4]["refusal"] for each in actions(3, 3)]
    assert [str(each[0]) for each in both] == [each["refusal"] for each in single]


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        ({"action": "torque"}, "gate: the actions must be joint_delta"),
        ({"action": "cartesian_pose"}, "gate: the actions must be joint_delta"),
        ({"action": "joint_delta_smooth"}, "gate: the actions must be joint_delta"),
        ({"gate": 1}, "gate: expected True or False"),
    ],
)
def test_a_gate_that_cannot_prove_is_refused(options: dict[str, Any], sentence: str):
    with pytest.raises(armctl.InputError, match=sentence):
        ArmEnv(BUNDLED, "Reach", **{"action": "joint_delta", "gate": True, **options})


def test_gymnasium_makes_an_environment_with_a_gate():
    env = gymnasium.make("armctl.envs:armctl/Reach-v0", robot=BUNDLED, action="joint_delta", gate=True)
    env.reset(seed=0)
    assert env.step(env.action_space.sample())[4]["refusal"] == ""

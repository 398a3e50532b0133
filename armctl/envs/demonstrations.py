"""save_demonstrations: episodes of a scripted expert as a data set for imitation learning."""

from __future__ import annotations

import os
import secrets
import shutil
from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import ArrayLike, NDArray

from armctl.core.atomic import file_path
from armctl.core.errors import ArmctlError, InputError
from armctl.core.progress import progress_bar
from armctl.core.result import Verdict
from armctl.core.validation import integer, shown
from armctl.envs.arm_env import ArmEnv
from armctl.envs.experts import ExpertPolicy
from armctl.envs.lerobot import FRONT, Feature, LeRobotWriter, film_name
from armctl.envs.pictures import SceneState, Screen
from armctl.report.render.renderer import Image

_HOLD_TIME = 0.25  # s at the goal, after which an episode ends
_MAX_FAILURES = 20  # in a row
_FREQUENCY_TOLERANCE = 1e-6  # relative

_Policy = Callable[[Any], ArrayLike]


@dataclass(frozen=True)
class DemonstrationsResult(Verdict):
    """How saving demonstrations ended. `bool(result)` is `result.ok`.

    Attributes:
        ok: Whether as many episodes were saved as were asked for.
        folder: The data set.
        episodes: How many episodes it has.
        frames: How many frames.
        failures: Episodes that the policy did not solve; they are not in the data set.
        reason: Why it is not ok, in words; empty if it is.
    """

    ok: bool
    folder: Path
    episodes: int
    frames: int
    failures: int
    reason: str

    def __str__(self) -> str:
        done = f"{self.episodes} episodes, {self.frames} frames in {self.folder.name}, {self.failures} failures left out"
        return done if self.ok else f"{done}: {self.reason}"


class _EpisodeRecording:
    """What happens in an episode."""

    def __init__(self) -> None:
        self.observations: list[NDArray[np.float32]] = []
        self.actions: list[NDArray[np.float32]] = []
        self.rewards: list[float] = []
        self.successes: list[bool] = []
        self.states: list[SceneState] = []

    def values(self) -> dict[str, NDArray[Any]]:
        """(k, size) or (k,) of each feature."""
        done = np.zeros(len(self.actions), bool)
        done[-1] = True
        return {
            "observation.state": np.array(self.observations),
            "action": np.array(self.actions),
            "next.reward": np.array(self.rewards, np.float32),
            "next.success": np.array(self.successes),
            "next.done": done,
        }


def save_demonstrations(
    env: gymnasium.Env, folder: str | os.PathLike[str], episodes: int, *, seed: int = 0, policy: _Policy | None = None
) -> DemonstrationsResult:
    """Saves episodes of the scripted expert, or of a teleoperator, as a data set in the format LeRobotDataset v3.0.

    Each frame has the observation, the action that is taken then, and the reward and success after it; with
    `render_mode="rgb_array"` also a picture, and one of each of the environment's `cameras`. An episode ends when the goal is
    held for a quarter of a second, in Track at the horizon. Only solved episodes are saved. The same seed gives the same
    episodes.

    Args:
        env: A single environment of armctl, whose steps are 1/20 s, 1/40 s, or another fraction with a whole denominator.
        folder: The data set; it does not exist yet.
        episodes: How many.
        seed: That of the first episode; the next numbers are those of the following ones.
        policy: Returns the action (k,) for an observation, such as that of a joystick; the scripted expert if left out.

    Returns:
        How it ended; it gives up after twenty failures in a row.

    Raises:
        InputError: It is another environment, the folder exists, or a second has no whole number of steps.
        ArmctlError: The data set cannot be written.
        NotInstalledError: Packages for Parquet or films are missing.
    """
    own = getattr(env, "unwrapped", env)
    if not isinstance(own, ArmEnv):
        raise InputError(f"env: {shown(env)} is no single environment of armctl; armctl.envs.ArmEnv('panda') is one")
    if policy is not None and not callable(policy):
        raise InputError(f"policy: expected a function of an observation, got {shown(policy)}")
    final = file_path("folder", folder)
    if final.exists():
        raise InputError(f"folder: {str(final)!r:.150} exists already; give another name")
    episodes = integer("episodes", episodes, 1)
    seed = integer("seed", seed, 0)
    screen = own.screen if own.render_mode != "human" else None
    temporary = final.with_name(f".{final.name[:100]}.{secrets.token_hex(4)}")
    try:
        temporary.mkdir(parents=True)
        writer = _writer(own, temporary, screen)
        failures = _record(own, writer, screen, episodes, seed, policy)
        if writer.episodes:
            writer.finish()
            os.replace(temporary, final)
    except OSError as error:
        raise ArmctlError(f"{final}: cannot be written: {error.strerror or error}") from None
    finally:
        with suppress(OSError):
            shutil.rmtree(temporary, ignore_errors=True)
    ok = writer.episodes == episodes
    reason = "" if ok else f"the policy failed in {_MAX_FAILURES} episodes in a row"
    return DemonstrationsResult(
        ok=ok, folder=final, episodes=writer.episodes, frames=writer.frames, failures=failures, reason=reason
    )


def _record(env: ArmEnv, writer: LeRobotWriter, screen: Screen | None, episodes: int, seed: int, policy: _Policy | None) -> int:
    """Records episodes; returns how many failed."""
    if policy is None:
        expert = ExpertPolicy(env)
        policy = lambda _: expert()  # noqa: E731
    failures = 0
    failures_in_a_row = 0
    with progress_bar("demonstrations", episodes, "episodes") as progress:
        while writer.episodes < episodes and failures_in_a_row < _MAX_FAILURES:
            recording = _play(env, policy, screen, seed + writer.episodes + failures)
            if recording is None:
                failures += 1
                failures_in_a_row += 1
                continue
            failures_in_a_row = 0
            images = {} if screen is None else _pictures(env, screen, recording.states)
            writer.add(env.batch.task.instruction, recording.values(), images)
            progress.update()
    writer.close()
    return failures


def _pictures(env: ArmEnv, screen: Screen, states: list[SceneState]) -> dict[str, Iterable[Image]]:
    """The pictures of an episode, by the names of their films."""
    found: dict[str, Iterable[Image]] = {}
    if env.render_mode is not None:
        found[FRONT] = (screen.picture(state) for state in states)
    for name in screen.cameras:
        found[film_name(name)] = (screen.see(name, state).colour for state in states)
    return found


def _films(env: ArmEnv, screen: Screen | None) -> dict[str, tuple[int, int]]:
    """The size of each film."""
    if screen is None:
        return {}
    front = {} if env.render_mode is None else {FRONT: screen.size}
    return {**front, **{film_name(name): screen.size for name in screen.cameras}}


def _play(env: ArmEnv, policy: _Policy, screen: Screen | None, seed: int) -> _EpisodeRecording | None:
    """An episode; None if the policy does not solve it."""
    batch = env.batch
    held = 0
    held_at_end = max(1, int(batch.task.held_fraction * batch.horizon))
    recording = _EpisodeRecording()
    observation, _ = env.reset(seed=seed)
    truncated = False
    while not truncated:
        action = np.asarray(policy(observation), np.float32)
        recording.observations.append(observation["observation"] if isinstance(observation, dict) else observation)
        recording.actions.append(action)
        if screen is not None:
            recording.states.append(screen.state())
        observation, reward, _, truncated, information = env.step(action)
        recording.rewards.append(reward)
        recording.successes.append(information["is_success"])
        held = held + 1 if information["is_success"] else 0
        if not batch.task.moves_goal and held * batch.step_time >= _HOLD_TIME:
            return recording
    return recording if held >= held_at_end else None


def _writer(env: ArmEnv, folder: Path, screen: Screen | None) -> LeRobotWriter:
    batch = env.batch
    rate = round(1.0 / batch.step_time)
    if abs(rate * batch.step_time - 1.0) > _FREQUENCY_TOLERANCE:
        raise InputError(
            f"env: a second has {1.0 / batch.step_time:.3f} of its steps, and a data set needs a whole number; choose ticks so "
            f"that {batch.arm.dt:g} s times ticks divides a second"
        )
    features = {
        "observation.state": Feature("float32", _observation_names(env)),
        "action": Feature("float32", batch.action_names),
        "next.reward": Feature("float32"),
        "next.success": Feature("bool"),
        "next.done": Feature("bool"),
    }
    films = _films(env, screen)
    return LeRobotWriter(folder, frames_per_second=rate, robot=batch.arm.name, features=features, films=films)


def _observation_names(env: ArmEnv) -> list[str]:
    joints = env.batch.arm.joint_names
    tips = env.batch.arm.tips
    names: list[str] = []
    for quantity, columns in env.batch.observer.columns.items():
        width = columns.stop - columns.start
        if quantity in ("q", "v", "to_target"):
            names += [f"{quantity}/{joint}" for joint in joints]
        elif width == 3:
            names += [f"{quantity}/{axis}" for axis in "xyz"]
        elif width == 3 * len(tips):
            names += [f"{quantity}/{tip}/{axis}" for tip in tips for axis in "xyz"]
        else:
            names.append(quantity)
    return names

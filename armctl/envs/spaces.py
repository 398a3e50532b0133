"""Spaces of actions and observations."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np

from armctl.envs.batch import Batch


def action_space(batch: Batch) -> gymnasium.spaces.Box:
    """The actions of one environment: numbers in [-1, 1]."""
    return gymnasium.spaces.Box(-1.0, 1.0, (batch.rows.action.shape[1],), np.float32)


def observation_space(batch: Batch, has_goals: bool) -> gymnasium.spaces.Space[Any]:
    """The observations of one environment, a vector or a dictionary with goals."""
    box = gymnasium.spaces.Box(-np.inf, np.inf, (batch.observer.size,), np.float32)
    if not has_goals:
        return box
    goal = gymnasium.spaces.Box(-np.inf, np.inf, (3,), np.float32)
    return gymnasium.spaces.Dict({"observation": box, "achieved_goal": goal, "desired_goal": goal})

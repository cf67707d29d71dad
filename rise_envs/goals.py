"""The goal API shared by every RISE environment: rewards and ends as pure functions of goals.

The signatures are those of ``gymnasium_robotics.core.GoalEnv`` and accept single goals (D,) or batches
(B, D), so that hindsight replay can relabel what was achieved.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rise_envs.actions import finite_action

REWARD_TYPES = ("dense", "sparse")


def distance(achieved_goal: NDArray, desired_goal: NDArray) -> NDArray:
    """Euclidean distance (m) over the last axis."""
    gap = np.subtract(achieved_goal, desired_goal)
    return np.sqrt(np.add.reduce(gap * gap, axis=-1))  # the bits of np.linalg.norm, at a third of its cost


def gap(here: Sequence[float], there: Sequence[float]) -> float:
    """`distance` of two points given as plain numbers, to the same bit, in no time."""
    total = 0.0
    for a, b in zip(here, there, strict=True):
        total += (a - b) * (a - b)
    return math.sqrt(total)


def step_reward(before: float, after: float, reached: bool, goal_radius: float, reward_type: str) -> float:
    """`reward` of a step that begins and ends at these distances from the goal (m), to the same bit."""
    if reward_type == "sparse":
        return reached - 1.0
    return (before - after) * (1.0 / goal_radius) + reached


def check_reward_type(reward_type: str) -> str:
    """``reward_type`` itself; raises ``ValueError`` if it is unknown."""
    if reward_type not in REWARD_TYPES:
        raise ValueError(f"reward_type must be one of {REWARD_TYPES}, got {reward_type!r}")
    return reward_type


def checked_placement(goal: Any, obstacle: Any, dim: int, n_obstacles: int) -> tuple[NDArray, NDArray]:
    """A goal (D,) and true readings (N, 2D + 1) that are put into an environment, as arrays of their own.

    Raises:
        ValueError: wrong shapes, numbers that are not finite, or a radius that is not positive.
    """
    width = 2 * dim + 1
    place = finite_action(goal, (dim,), "goal").copy()
    balls = finite_action(obstacle, (n_obstacles * width,), "obstacle").reshape(-1, width).copy()
    if not (balls[:, -1] > 0).all():
        raise ValueError(f"radii of obstacles must be positive, got {balls[:, -1].tolist()}")
    return place, balls


def reward(
    achieved_goal: NDArray, desired_goal: NDArray, info: Any, goal_radius: float, reward_type: str
) -> NDArray:
    """Reward of arriving at ``achieved_goal``.

    ``sparse``: 0 within ``goal_radius`` of the goal, −1 elsewhere. ``dense``: progress towards the goal in
    this step in units of ``goal_radius``, plus 1 on reaching it. Progress needs where the step began:
    ``info["previous_achieved_goal"]``, of one info or of each info in a batch.

    Raises:
        ValueError: dense reward without that entry (hindsight replay that drops the infos).
    """
    gap = distance(achieved_goal, desired_goal)
    reached = gap <= goal_radius
    if reward_type == "sparse":
        return reached - 1.0
    infos = [info] if isinstance(info, dict) else list(info)
    try:
        before = np.array([entry["previous_achieved_goal"] for entry in infos])
    except KeyError:
        raise ValueError(
            "the dense reward needs info['previous_achieved_goal']: keep the infos "
            "(HerReplayBuffer(copy_info_dict=True)) or make the environment with reward_type='sparse'"
        ) from None
    before = before[0] if isinstance(info, dict) else before
    return (distance(before, desired_goal) - gap) * (1.0 / goal_radius) + reached


def terminated(
    achieved_goal: NDArray, desired_goal: NDArray, info: Any, goal_radius: float, on_collision: bool
) -> NDArray:
    """Whether the goal is reached or, with ``on_collision``, the step had a cost (of one info or of each)."""
    ended = distance(achieved_goal, desired_goal) <= goal_radius
    if not on_collision:
        return ended
    cost = info["cost"] if isinstance(info, dict) else [entry["cost"] for entry in info]
    return ended | (np.asarray(cost) > 0)


class GoalAPI:
    """The goal API of an environment with ``reward_type``, ``terminate_on_collision`` and ``params``."""

    reward_type: str
    terminate_on_collision: bool
    params: Any

    def compute_reward(self, achieved_goal: NDArray, desired_goal: NDArray, info: Any) -> Any:
        """Reward of one transition or of a batch: see :func:`reward`."""
        return reward(achieved_goal, desired_goal, info, self.params.goal_radius, self.reward_type)

    def compute_terminated(self, achieved_goal: NDArray, desired_goal: NDArray, info: Any) -> Any:
        """Whether the goal is reached (or, with ``terminate_on_collision``, the step cost something)."""
        return terminated(
            achieved_goal, desired_goal, info, self.params.goal_radius, self.terminate_on_collision
        )

    def compute_truncated(self, achieved_goal: NDArray, desired_goal: NDArray, info: Any) -> Any:
        """Never: the time limit truncates."""
        return np.zeros(np.shape(achieved_goal)[:-1], bool)[()]

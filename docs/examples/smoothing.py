"""A filter of your own: readings averaged over the last few steps.

python -m benchmarks.run --import docs/examples/smoothing.py --agents pcbc --filter smooth kalman
"""

from __future__ import annotations

from typing import Any

import numpy as np

from rise_agents.agent import initial_state
from rise_agents.filters import register_filter
from rise_agents.readings import checked_batch
from rise_envs.task import Task


class Smooth:
    """An exponential average of positions (moved along with the velocity), velocities and radii.

    Args:
        policy: an agent or an expert, which is handed the averages.
        task: what the numbers of a reading mean.
        noise_level: of the readings: the more noise, the longer the memory; at level 0 readings pass as they are.
    """

    label = "behind an average"

    def __init__(self, policy: Any, task: Task, noise_level: float) -> None:
        self.policy, self.task, self.memory = policy, task, noise_level / (1 + noise_level)
        self.evaluate_deterministic = getattr(policy, "evaluate_deterministic", True)

    def initial_state(self, keys: Any) -> Any:
        """The averages (B, C), how many readings there were (B,), and the policy's own state."""
        blank = np.zeros((len(keys), self.task.widths["obstacle"]))
        return (blank, np.zeros(len(keys), np.int64), *(initial_state(self.policy, keys) or ()))

    def predict(
        self, observation: Any, state: Any = None, episode_start: Any = None, deterministic: bool = False
    ) -> tuple[Any, Any]:
        """The policy's actions on averaged readings."""
        rows, single = checked_batch(self.task, observation)
        reading = rows["obstacle"]
        if state is None:
            state = (np.zeros_like(reading), np.zeros(len(reading), np.int64))
        average, seen, *inner = state
        if episode_start is not None:
            seen = np.where(np.reshape(episode_start, len(seen)), 0, seen)
        position, velocity, radius = self.task.split(average)
        ahead = np.concatenate((position + self.task.dt * velocity, velocity, radius[..., None]), -1)
        kept = np.where(seen > 0, self.memory, 0.0)[:, None]
        average = kept * ahead.reshape(reading.shape) + (1 - kept) * reading
        observation = {**observation, "obstacle": average[0] if single else average}
        action, after = self.policy.predict(observation, tuple(inner) or None, episode_start, deterministic)
        return action, (average, seen + 1, *(after or ()))


register_filter("smooth", Smooth)

"""The policies that are evaluated: trained agents, experts, and chance."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from benchmarks.labels import split_row
from rise_agents import load_agent
from rise_agents.agent import State, draw_state, fresh_state
from rise_agents.cloning import ActionUnits
from rise_agents.experts import make_expert
from rise_agents.filters import FILTERS, make_filter
from rise_agents.readings import checked_parts, observation_ranks
from rise_agents.vec_env import action_bounds
from rise_envs import streams
from rise_envs.task import env_class


class Random:
    """Uniform actions: within the bounds, or any of a number.

    Raises:
        ValueError: actions that are neither a bounded box nor discrete, or observations that are no numbers.
    """

    evaluate_deterministic = False

    def __init__(self, env_id: str) -> None:
        env = env_class(env_id)()
        self.space, self.ranks = env.action_space, observation_ranks(env.observation_space)
        env.close()
        bounds = action_bounds(self.space)
        if bounds is None and not isinstance(self.space, spaces.Discrete):
            raise ValueError(f"chance plays boxes and discrete actions, those of {env_id} are {self.space}")
        self.units = None if bounds is None else ActionUnits(*bounds)
        self.size = 1 if self.units is None else self.units.size

    def initial_state(self, keys: NDArray[np.uint64]) -> State:
        """Streams for episodes with the given keys (B,)."""
        return fresh_state(keys)

    def predict(
        self, observation: Any, state: State = None, episode_start: Any = None, deterministic: bool = False
    ) -> tuple[NDArray, State]:
        """Actions (B, A), or (A,) for one observation."""
        parts, single = checked_parts(observation, self.ranks)
        rows = len(next(iter(parts.values())))
        keys, counter = draw_state(state, episode_start, rows, np.random.default_rng(0))
        draws = counter[:, None] * np.uint64(self.size) + np.arange(self.size, dtype=np.uint64)
        action = self._actions(streams.uniform(keys[:, None], draws))
        return (action[0] if single else action), (keys, counter + np.uint64(1))

    def _actions(self, share: NDArray[np.float64]) -> NDArray:
        """Actions (B, A), or (B,) where they are discrete, of draws (B, A) in [0, 1)."""
        if self.units is None:
            return self.space.start + (share[:, 0] * self.space.n).astype(np.int64)
        return self.units.to_action(2 * share - 1)


def make_policy(
    env_id: str,
    row: str,
    checkpoint: Path | None,
    settings: dict[str, Any] | None = None,
    noise_level: float = 0.0,
) -> Any:
    """The policy of a row of the tables: a trained agent, an expert, or chance; behind its filter, if it has one.

    Args:
        env_id: a registered environment.
        row: its name.
        checkpoint: of a trained agent.
        settings: how that agent acts, laid over what is stored.
        noise_level: of the readings, which a filter knows.
    """
    base, filtered = split_row(row)
    if checkpoint is not None:
        policy: Any = load_agent(checkpoint, env_id, "cpu", settings)
    elif base == "random":
        policy = Random(env_id)
    else:
        policy = make_expert(base.removeprefix("expert-"), env_id)
    return make_filter(filtered, policy, env_id, noise_level) if filtered in FILTERS else policy

"""The policies that are evaluated: trained agents, experts, and chance."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.labels import split_row
from rise_agents import load_agent
from rise_agents.agent import State, draw_state, fresh_state
from rise_agents.cloning import ActionUnits
from rise_agents.experts import make_expert
from rise_agents.filters import FILTERS, make_filter
from rise_agents.readings import checked_parts, observation_ranks
from rise_envs import streams
from rise_envs.task import env_class


class Random:
    """Uniform actions within the bounds."""

    evaluate_deterministic = False

    def __init__(self, env_id: str) -> None:
        self.units, self.ranks = (
            ActionUnits.of(env_id),
            observation_ranks(env_class(env_id)().observation_space),
        )

    def initial_state(self, keys: NDArray[np.uint64]) -> State:
        """Streams for episodes with the given keys (B,)."""
        return fresh_state(keys)

    def predict(
        self, observation: Any, state: State = None, episode_start: Any = None, deterministic: bool = False
    ) -> tuple[NDArray[np.float32], State]:
        """Actions (B, A), or (A,) for one observation."""
        parts, single = checked_parts(observation, self.ranks)
        rows = len(next(iter(parts.values())))
        keys, counter = draw_state(state, episode_start, rows, np.random.default_rng(0))
        size = len(self.units.low)
        draws = counter[:, None] * np.uint64(size) + np.arange(size, dtype=np.uint64)
        action = self.units.to_action(2 * streams.uniform(keys[:, None], draws) - 1)
        return (action[0] if single else action), (keys, counter + np.uint64(1))


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

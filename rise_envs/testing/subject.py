"""An environment under test, and recordings of its episodes."""

from __future__ import annotations

import copy
import functools
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from rise_envs.cost import cost_of
from rise_envs.task import describes_task, task_of

STEPS = 8  # too few to reach any goal
Record = dict[str, np.ndarray]


class ContractError(AssertionError):
    """What an environment, or an agent, does not keep."""


def hold(condition: Any, text: str) -> None:
    """Raise :class:`ContractError` that says ``text`` unless ``condition`` holds."""
    if not condition:
        raise ContractError(text)


class Subject:
    """An environment under test.

    Args:
        env_id: registered with :func:`rise_envs.register_env`.
        episodes: how many of its episodes are looked at.
    """

    def __init__(self, env_id: str, episodes: int = 20) -> None:
        self.env_id, self.episodes = env_id, episodes
        self.task: Any = task_of(env_id) if describes_task(env_id) else None

    def make(self, **kwargs: Any) -> Any:
        """The environment."""
        return gym.make(self.env_id, **kwargs)

    @functools.cached_property
    def records(self) -> list[Record]:
        """Each of the first episodes, recorded once."""
        env = self.make()
        found = [record(env, seed) for seed in range(self.episodes)]
        env.close()
        return found


def actions(space: Any, seed: int, n: int = STEPS) -> np.ndarray:
    """``n`` random actions (n, …) that belong to ``seed``."""
    if isinstance(space, spaces.Box):
        rng = np.random.default_rng(seed)
        return rng.uniform(space.low, space.high, (n, *space.shape)).astype(space.dtype)
    space.seed(seed)
    return np.array([space.sample() for _ in range(n)])


def _row(observation: Any, reward: Any, info: dict[str, Any]) -> dict[str, Any]:
    """All that a step says, by name."""
    parts = observation if isinstance(observation, dict) else {"": observation}
    known = {name: info[name] for name in ("cost", "clearance", "is_success") if name in info}
    return {**parts, "reward": reward, **known}


def record(env: Any, seed: int, n: int = STEPS) -> Record:
    """All that an environment says in ``n`` steps of the episode ``seed``, one array per quantity."""
    observation, info = env.reset(seed=seed)
    rows = [_row(observation, 0.0, {**info, "cost": 0.0})]
    for action in actions(env.action_space, seed, n):
        observation, reward, terminated, truncated, info = env.step(action)
        rows.append(_row(observation, reward, {**info, "cost": cost_of(info)}))
        if terminated or truncated:
            break
    known = [key for key in rows[1] if all(key in row for row in rows)]
    return {key: np.array([row[key] for row in rows]) for key in known}


def record_batch(env: Any, seeds: list[int], n: int = STEPS) -> list[Record]:
    """The same from a vector environment, one record per seed."""
    observation, info = env.reset(seed=seeds)
    blank = np.zeros(len(seeds))
    rows = [copy.deepcopy(_row(observation, blank, {**info, "cost": blank}))]
    space: Any = env.single_action_space
    for action in np.stack([actions(space, seed, n) for seed in seeds], axis=1):
        observation, reward, _, _, info = env.step(action)
        rows.append(copy.deepcopy(_row(observation, reward, info)))
    known = [key for key in rows[1] if all(key in row for row in rows)]
    return [{key: np.array([row[key][i] for row in rows]) for key in known} for i in range(len(seeds))]


def assert_same(a: Record, b: Record) -> None:
    """Two records agree to the last bit, as far as the shorter one goes; raises ``AssertionError``."""
    hold(a.keys() == b.keys(), f"one episode has {sorted(a)}, the other {sorted(b)}")
    for key in a:
        n = min(len(a[key]), len(b[key]))
        np.testing.assert_array_equal(a[key][:n], b[key][:n], err_msg=key)


def refused(env: Any, action: Any) -> None:
    """Raise :class:`ContractError` unless an action is a ``ValueError`` that names it."""
    try:
        env.step(action)
    except ValueError as error:
        hold("action" in str(error), f"an action {action!r} is refused by {error}, which does not name it")
    else:
        raise ContractError(f"an action {action!r} is not refused")

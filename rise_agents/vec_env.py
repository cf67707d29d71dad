"""A bridge from Gymnasium's vector environments to stable-baselines3 that keeps arrays as arrays.

SB3's own ``DummyVecEnv`` steps one environment after the other. This bridge steps a Gymnasium ``VectorEnv``
(natively batched, processes, or serial), turns a whole batch of observations into network inputs with one
call, and rescales actions from [−1, 1] to the environment's bounds, which need not be symmetric.

Shapes: B sub-environments, K network inputs, A action dimensions.
"""

from __future__ import annotations

import importlib
import inspect
import multiprocessing
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv, VectorEnv
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import VecEnv

from rise_agents.pool import end_with_parent
from rise_agents.seeds import episode_seeds
from rise_envs.cost import checked_cost, cost_of

# From observations with a leading batch dimension to network inputs (B, K), float32.
Encode = Callable[[Any], NDArray[np.float32]]


def make_training_env(env_id: str, num_envs: int, **kwargs: Any) -> VectorEnv:
    """``num_envs`` sub-environments that start anew in the step that ends an episode.

    The environment's own batched form where it has one that can do this, else one process each; in a daemonic
    process, which may have no children, one after the other.
    """
    spec = gym.spec(env_id)
    if _resets_in_step(spec.vector_entry_point):
        return gym.make_vec(
            env_id,
            num_envs,
            vectorization_mode="vector_entry_point",
            autoreset_mode=AutoresetMode.SAME_STEP,
            **kwargs,
        )
    makers = [partial(_make, env_id, kwargs)] * num_envs
    if num_envs == 1 or multiprocessing.current_process().daemon:
        return SyncVectorEnv(makers, autoreset_mode=AutoresetMode.SAME_STEP)
    return AsyncVectorEnv(makers, autoreset_mode=AutoresetMode.SAME_STEP)


def _make(env_id: str, kwargs: dict[str, Any]) -> gym.Env:
    end_with_parent()  # a sub-environment's process would wait for ever for one that was killed
    return gym.make(env_id, **kwargs)


def _resets_in_step(entry: Any) -> bool:
    if isinstance(entry, str):
        module, _, name = entry.partition(":")
        entry = getattr(importlib.import_module(module), name)
    return entry is not None and "autoreset_mode" in inspect.signature(entry).parameters


def as_vector_env(env: gym.Env | VectorEnv) -> VectorEnv:
    """A ready environment as a vector environment that the bridge accepts.

    Raises:
        ValueError: a vector environment that resets at another time than in the step that ends an episode.
    """
    if isinstance(env, gym.Env):
        return SyncVectorEnv([lambda: env], autoreset_mode=AutoresetMode.SAME_STEP)
    mode = env.metadata.get("autoreset_mode")
    if mode != AutoresetMode.SAME_STEP:
        raise ValueError(f"training needs a vector environment with autoreset_mode=SAME_STEP, got {mode}")
    return env


def random_inputs(
    venv: VectorEnv, encode: Callable[[Any], NDArray], seeds: NDArray[np.int64], samples: int
) -> NDArray:
    """About ``samples`` encoded observations (·, K) of episodes with uniformly random actions.

    Args:
        venv: is left in some state: reset it afterwards.
        encode: from batched observations to (B, K).
        seeds: of the first episodes, (B,); the first of them seeds the actions too.
        samples: how many rows to gather, rounded up to whole steps.

    Raises:
        ValueError: observations that are no arrays of NumPy (those of a backend of torch, say).
    """
    venv.action_space.seed(int(seeds[0]))
    named: Any = [int(seed) for seed in seeds]  # a list is allowed, whatever the annotation says
    first = venv.reset(seed=named)[0]
    for key, part in first.items() if isinstance(first, dict) else [("", first)]:
        if not isinstance(part, np.ndarray):
            kind = f"{type(part).__module__}.{type(part).__name__}"
            raise ValueError(f"training needs observations of NumPy, {venv} gives {key!r} as {kind}")
    rows = [encode(first)]
    while len(rows) * venv.num_envs < samples:
        rows.append(encode(venv.step(venv.action_space.sample())[0]))
    return np.concatenate(rows)


class Bridge(VecEnv):
    """A Gymnasium vector environment as SB3 wants it.

    Args:
        venv: steps B sub-environments, with ``autoreset_mode=SAME_STEP``.
        encode: from its batched observations to network inputs.
        n_inputs: K.

    Attributes:
        costs: ``info["cost"]`` of the last step, (B,).

    The infos hold what SB3 reads at the end of an episode: ``terminal_observation``, ``TimeLimit.truncated``,
    ``is_success`` and ``episode`` with its return ``r``, length ``l`` and undiscounted cost ``c``.
    """

    def __init__(self, venv: VectorEnv, encode: Encode, n_inputs: int) -> None:
        self.venv, self.encode = venv, encode
        inputs = spaces.Box(-np.inf, np.inf, (n_inputs,), np.float32)
        self._bounds = action_bounds(venv.single_action_space)
        actions = venv.single_action_space
        if self._bounds is not None:
            actions = spaces.Box(-1.0, 1.0, venv.single_action_space.shape, np.float32)
        super().__init__(venv.num_envs, inputs, actions)
        self.costs = np.zeros(venv.num_envs)
        self._sums = np.zeros((3, venv.num_envs))  # return, length, cost of the running episodes
        self._actions: NDArray = np.zeros(0)

    def seed(self, seed: int | None = None) -> Sequence[int | None]:
        """Name the episodes of the next reset: the first training episodes of run ``seed``."""
        self._run = seed or 0
        self._seeds = episode_seeds("train", self._run, 0, self.num_envs).tolist()
        return self._seeds

    def restart(self, number: int) -> NDArray[np.float32]:
        """Start all episodes anew, named by the run's seed and ``number``; encoded observations (B, K)."""
        first = number * self.num_envs
        self._seeds = episode_seeds("train", self._run, first, self.num_envs).tolist()
        return self.reset()

    def reset(self) -> NDArray[np.float32]:
        """Start all episodes; encoded observations (B, K)."""
        seeds: Any = None if self._seeds[0] is None else self._seeds
        observation, _ = self.venv.reset(seed=seeds)
        self._reset_seeds()
        self._sums[:] = 0
        return self.encode(observation)

    def step_async(self, actions: NDArray) -> None:
        """Keep the actions (B, A) for :meth:`step_wait`."""
        self._actions = actions if self._bounds is None else rescale(actions, *self._bounds)

    def step_wait(self) -> tuple[NDArray[np.float32], NDArray, NDArray[np.bool_], list[dict[str, Any]]]:
        """Step; encoded observations (B, K), rewards (B,), ends (B,) and infos.

        Raises:
            ValueError: a sub-environment reported no cost.
        """
        observation, reward, terminated, truncated, infos = self.venv.step(self._actions)
        dones = terminated | truncated
        self.costs = step_costs(infos, dones)
        for total, part in zip(self._sums, (reward, 1.0, self.costs), strict=True):
            total += part
        notes: list[dict[str, Any]] = [{}] * self.num_envs  # one empty dict: SB3 only reads
        ended = np.flatnonzero(dones)
        if len(ended):
            last = self.encode(_stacked([infos["final_obs"][i] for i in ended]))
            success = infos["final_info"].get("is_success", np.full(self.num_envs, None))
            for i, inputs in zip(ended, last, strict=True):
                notes[i] = {
                    "terminal_observation": inputs,
                    "TimeLimit.truncated": bool(truncated[i] and not terminated[i]),
                    "episode": dict(zip("rlc", self._sums[:, i].tolist(), strict=True)),
                    "is_success": success[i],
                }
            self._sums[:, ended] = 0
        return self.encode(observation), reward.astype(np.float32), dones, notes

    def close(self) -> None:
        """Close the vector environment."""
        self.venv.close()

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """The vector environment's attribute, once for each sub-environment asked for."""
        return [getattr(self.venv, attr_name)] * len(list(self._get_indices(indices)))

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Refused: sub-environments of a batch have no attributes of their own."""
        raise NotImplementedError("set attributes before the environment is handed over")

    def env_method(self, method_name: str, *args: Any, indices: Any = None, **kwargs: Any) -> list[Any]:
        """Refused, for the same reason as :meth:`set_attr`."""
        raise NotImplementedError("call methods of the vector environment itself")

    def env_is_wrapped(self, wrapper_class: Any, indices: Any = None) -> list[bool]:
        """Whether the vector environment is wrapped so, once for each sub-environment asked for."""
        return [False] * len(list(self._get_indices(indices)))


def action_bounds(space: spaces.Space) -> tuple[NDArray[np.float64], NDArray[np.float64]] | None:
    """Lower and upper bounds (A,) of a box of actions; None for other spaces.

    Raises:
        ValueError: a box that is not bounded.
    """
    if not isinstance(space, spaces.Box):
        return None
    if not (np.isfinite(space.low).all() and np.isfinite(space.high).all()):
        raise ValueError(f"actions need finite bounds, got {space}: wrap it in gymnasium's RescaleAction")
    return space.low.astype(np.float64), space.high.astype(np.float64)


def rescale(actions: NDArray, low: NDArray[np.float64], high: NDArray[np.float64]) -> NDArray[np.float32]:
    """Actions (B, A) clipped to [−1, 1] and brought to [low, high], float32 and never outside."""
    wanted = low + 0.5 * (np.clip(actions, -1.0, 1.0) + 1.0) * (high - low)
    return np.clip(wanted.astype(np.float32), low.astype(np.float32), high.astype(np.float32))


def step_costs(infos: dict[str, Any], dones: NDArray[np.bool_]) -> NDArray[np.float64]:
    """The cost (B,) of the step, for ended episodes from ``final_info``.

    Raises:
        ValueError: a sub-environment reported none, or one that is no finite number ≥ 0.
    """
    final, nothing = infos.get("final_info", {}), np.zeros(len(dones))
    known = np.where(dones, final.get("_cost", nothing), infos.get("_cost", nothing)).astype(bool)
    if not known.all():
        given = {key: None for key in (*infos, *final) if key != "cost" and not key.startswith("_")}
        cost_of(given, f"sub-environment {np.argmin(known)}")
    cost = np.where(dones, final.get("cost", nothing), infos.get("cost", nothing)).astype(np.float64)
    valid = (cost >= 0) & (cost < np.inf)
    if not valid.all():
        checked_cost(cost[np.argmin(valid)], f"sub-environment {np.argmin(valid)}")
    return cost


def _stacked(observations: list[Any]) -> Any:
    if isinstance(observations[0], dict):
        return {key: np.stack([one[key] for one in observations]) for key in observations[0]}
    return np.stack(observations)

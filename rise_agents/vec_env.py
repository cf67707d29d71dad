"""Gymnasium's vector environments as training uses them: how they are made, their actions and their costs.

Shapes: B sub-environments, K network inputs, A action dimensions.
"""

from __future__ import annotations

import importlib
import inspect
import multiprocessing
from collections.abc import Callable
from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv, VectorEnv
from numpy.typing import NDArray

from rise_agents.plugins import import_modules, imported
from rise_agents.pool import end_with_parent
from rise_envs.cost import checked_cost, cost_of


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
    makers = [partial(_make, env_id, kwargs, imported())] * num_envs
    if num_envs == 1 or multiprocessing.current_process().daemon:
        return SyncVectorEnv(makers, autoreset_mode=AutoresetMode.SAME_STEP)
    return AsyncVectorEnv(makers, autoreset_mode=AutoresetMode.SAME_STEP)


def _make(env_id: str, kwargs: dict[str, Any], modules: tuple[str, ...]) -> gym.Env:
    end_with_parent()  # a sub-environment's process would wait for ever for one that was killed
    import_modules(modules)
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

"""The one roll-out: policies through episodes that are named by seeds, many side by side.

Every number that is reported anywhere (demonstrations, validation, benchmark) comes from this function. An
episode depends on its own seeds only: environment, noise and policy draw from streams of their own.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from numpy.typing import NDArray

import rise_envs  # noqa: F401  registers the environments
from rise_agents.agent import initial_state, merge_states
from rise_envs import streams
from rise_envs.noise_wrappers import VectorObservationNoise

# Slots that run side by side: batched environments share every array operation, the others only the policy's.
BATCHED_SLOTS, SINGLE_SLOTS = 512, 4
_POLICY_TAG = 0x9011C7


@dataclass(frozen=True)
class Episodes:
    """What happened in E episodes, in the order of their seeds (arrays of length E)."""

    safe: NDArray[np.bool_]
    arrived: NDArray[np.bool_]
    steps: NDArray[np.int64]
    cost: NDArray[np.float64]
    min_clearance: NDArray[np.float64]
    episode_return: NDArray[np.float64]

    @property
    def reached(self) -> NDArray[np.bool_]:
        """Arrived, and never collided on the way (the paper's definition)."""
        return self.arrived & self.safe


@dataclass(frozen=True)
class Transitions:
    """Every step of E episodes, flat: rows offsets[i]:offsets[i + 1] belong to episode i."""

    observations: dict[str, NDArray[np.float64]]
    actions: NDArray[np.float64]
    rewards: NDArray[np.float64]
    costs: NDArray[np.float64]
    final: dict[str, NDArray[np.float64]]  # the observation in which each episode ended
    offsets: NDArray[np.int64]


def policy_keys(noise_seeds: Sequence[int] | NDArray[np.int64]) -> NDArray[np.uint64]:
    """The keys that policies draw from in the episodes with these noise seeds, (E,)."""
    return np.array([streams.key_from_seed(int(seed), _POLICY_TAG) for seed in noise_seeds], np.uint64)


def is_batched_env(env_id: str) -> bool:
    """Whether the environment has a native batched form."""
    return gym.spec(env_id).vector_entry_point is not None


def side_by_side(env_id: str, episodes: int) -> int:
    """How many of so many episodes run at a time, unless told: a policy always computes that many rows together."""
    return min(BATCHED_SLOTS if is_batched_env(env_id) else SINGLE_SLOTS, episodes)


def make_slots(env_id: str, slots: int, **kwargs: Any) -> VectorEnv:
    """``slots`` sub-environments whose resets are ours to call."""
    mode: dict[str, Any] = {"autoreset_mode": AutoresetMode.DISABLED}
    if is_batched_env(env_id):
        return gym.make_vec(env_id, slots, vectorization_mode="vector_entry_point", **mode, **kwargs)
    return gym.make_vec(env_id, slots, vectorization_mode="sync", vector_kwargs=mode, **kwargs)


def rollout(
    policy: Any,
    env_id: str,
    env_seeds: Sequence[int] | NDArray[np.int64],
    *,
    noise: str = "step",
    noise_level: float = 0.0,
    noise_seeds: Sequence[int] | NDArray[np.int64] | None = None,
    deterministic: bool = True,
    record: bool = False,
    slots: int | None = None,
    env_kwargs: dict[str, Any] | None = None,
    finished: Callable[[int], None] = lambda count: None,
) -> tuple[Episodes, Transitions | None]:
    """Run the episodes that ``env_seeds`` name.

    Args:
        policy: anything with ``predict``; with ``initial_state(keys)`` too if it draws or remembers.
        env_id: a registered environment.
        env_seeds: (E,), one episode each.
        noise: a noise model's text, see :func:`rise_envs.noise.make_noise`.
        noise_level: multiplies the environment's noise scale; 0 gives true readings.
        noise_seeds: (E,), default ``env_seeds`` (the streams differ all the same).
        deterministic: handed to ``predict``.
        record: keep every transition.
        slots: episodes side by side.
        env_kwargs: arguments of the environment.
        finished: called with the number of episodes that ended since the last call.

    Returns:
        The episodes, and their transitions if they were recorded.
    """
    env_seeds = np.asarray(env_seeds, np.int64)
    noise_seeds = env_seeds if noise_seeds is None else np.asarray(noise_seeds, np.int64)
    total = len(env_seeds)
    slots = min(slots, total) if slots else side_by_side(env_id, total)
    keys = policy_keys(noise_seeds)

    env = make_slots(env_id, slots, **(env_kwargs or {}))
    if noise_level > 0:
        env = VectorObservationNoise(env, noise, noise_level=noise_level)
    tally, log = _Tally(total), _Log(record)
    episode = np.arange(slots)  # which episode each slot runs; ≥ total: a spare one that does not count
    upcoming = slots

    def begin(rows: NDArray[np.bool_]) -> dict[str, Any]:
        pick = np.minimum(episode, total - 1)
        options: dict[str, Any] = {"reset_mask": rows}
        if noise_level > 0:
            options["noise_seed"] = noise_seeds[pick]
        seeds: Any = [int(s) for s in env_seeds[pick]]  # a list is fine, whatever VectorEnv declares
        return env.reset(seed=seeds, options=options)[0]

    try:
        everyone = np.ones(slots, bool)
        observation, state, starts = begin(everyone), initial_state(policy, keys[episode]), everyone
        while (episode < total).any():
            action, state = policy.predict(observation, state, starts, deterministic)
            after, reward, terminated, truncated, infos = env.step(action)
            _check_infos(env_id, infos)
            tally.note(episode, reward, infos)
            starts = terminated | truncated
            log.note(episode, observation, action, reward, infos["cost"], after, starts)
            observation = after
            if starts.any():
                ended = episode[starts & (episode < total)]
                tally.arrived[ended] = infos["is_success"][starts & (episode < total)]
                episode = episode.copy()
                episode[starts] = upcoming + np.arange(starts.sum())
                upcoming += int(starts.sum())
                finished(len(ended))
                if (episode < total).any():
                    observation = begin(starts)
                    fresh = initial_state(policy, keys[np.minimum(episode, total - 1)])
                    state = merge_states(state, fresh, starts)
    finally:
        env.close()
    return tally.episodes(), log.transitions(total)


def check_judged(env_id: str) -> None:
    """Raise ``ValueError`` unless an environment can be stepped, and says all that episodes are judged by."""
    try:
        env = gym.make(env_id)
        env.reset(seed=0)
        env.action_space.seed(0)
        observation, *_, infos = env.step(env.action_space.sample())
        env.close()
    except Exception as error:  # whatever an environment of somebody else raises
        reason = (str(error).strip() or "no message").splitlines()[0]
        raise ValueError(f"{env_id} fails in its first step: {type(error).__name__}: {reason}") from error
    _check_shapes(env_id, observation, env.observation_space)
    _check_infos(env_id, infos)


def _check_shapes(env_id: str, observation: Any, space: gym.Space, what: str = "observation") -> None:
    """Raise ``ValueError`` where an observation is not shaped as its space says: batches are made by that."""
    if isinstance(space, gym.spaces.Dict):
        for key, part in space.items():
            if not isinstance(observation, dict) or key not in observation:
                raise ValueError(f"{env_id} gives no {what}[{key!r}], which its observation_space has")
            _check_shapes(env_id, observation[key], part, f"{what}[{key!r}]")
    elif isinstance(space, gym.spaces.Box) and np.shape(observation) != space.shape:
        shape = np.shape(observation)
        raise ValueError(f"{env_id} gives {what} of shape {shape}, its observation_space says {space.shape}")


def _check_infos(env_id: str, infos: dict[str, Any]) -> None:
    missing = [f"info[{name!r}]" for name in ("cost", "clearance", "is_success") if name not in infos]
    if missing:
        raise ValueError(f"{env_id} gives no {', no '.join(missing)}, by which episodes are judged")
    cost = np.asarray(infos["cost"])
    good = cost.dtype.kind in "biuf" and (cost >= 0) & (cost < np.inf)  # false of NaN, too
    if not np.all(good):
        bad = infos["cost"] if np.ndim(good) == 0 else cost[~good][0]
        raise ValueError(f"{env_id}: the cost of a step must be a finite number ≥ 0, got {bad}")


class _Tally:
    """Running sums of each episode."""

    def __init__(self, total: int) -> None:
        self.cost, self.returns = np.zeros(total), np.zeros(total)
        self.steps, self.clearance = np.zeros(total, np.int64), np.full(total, np.inf)
        self.arrived = np.zeros(total, bool)

    def note(self, episode: NDArray[np.int64], reward: NDArray, infos: dict[str, Any]) -> None:
        counts = episode < len(self.cost)
        rows = episode[counts]
        self.cost[rows] += infos["cost"][counts]
        self.returns[rows] += reward[counts]
        self.steps[rows] += 1
        self.clearance[rows] = np.minimum(self.clearance[rows], infos["clearance"][counts])

    def episodes(self) -> Episodes:
        return Episodes(self.cost == 0, self.arrived, self.steps, self.cost, self.clearance, self.returns)


class _Log:
    """Transitions in the order they happen, put in the order of their episodes at the end."""

    def __init__(self, active: bool) -> None:
        self.active = active
        self.rows: list[tuple[NDArray, ...]] = []
        self.observations: list[dict[str, NDArray]] = []
        self.finals: list[tuple[NDArray, dict[str, NDArray]]] = []

    def note(
        self,
        episode: NDArray[np.int64],
        observation: dict[str, NDArray],
        action: NDArray,
        reward: NDArray,
        cost: NDArray,
        after: dict[str, NDArray],
        ended: NDArray[np.bool_],
    ) -> None:
        if not self.active:
            return
        self.rows.append((episode, np.array(action, np.float64), reward.copy(), np.array(cost, np.float64)))
        self.observations.append({key: value.copy() for key, value in observation.items()})
        if ended.any():
            self.finals.append((episode[ended], {key: value[ended] for key, value in after.items()}))

    def transitions(self, total: int) -> Transitions | None:
        if not self.active:
            return None
        episode, actions, rewards, costs = (np.concatenate(column) for column in zip(*self.rows, strict=True))
        order = np.argsort(episode, kind="stable")
        order = order[episode[order] < total]
        last = np.concatenate([rows for rows, _ in self.finals])
        last_order = np.argsort(last, kind="stable")[:total]
        keys = self.observations[0]
        offsets = np.concatenate(([0], np.cumsum(np.bincount(episode[order], minlength=total))))
        return Transitions(
            observations={
                key: np.concatenate([row[key] for row in self.observations])[order] for key in keys
            },
            actions=actions[order],
            rewards=rewards[order],
            costs=costs[order],
            final={key: np.concatenate([row[key] for _, row in self.finals])[last_order] for key in keys},
            offsets=offsets.astype(np.int64),
        )

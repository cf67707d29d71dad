"""A bridge from Gymnasium's vector environments to stable-baselines3 that keeps arrays as arrays.

SB3's own ``DummyVecEnv`` steps one environment after the other. This bridge steps a Gymnasium ``VectorEnv``
(natively batched, processes, or serial), turns a whole batch of observations into network inputs with one
call, and rescales actions from [−1, 1] to the environment's bounds, which need not be symmetric.

Shapes: B sub-environments, K network inputs, A action dimensions.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from gymnasium import spaces
from gymnasium.vector import VectorEnv
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import VecEnv

from rise_agents.seeds import episode_seeds
from rise_agents.vec_env import action_bounds, rescale, step_costs

# From observations with a leading batch dimension to network inputs (B, K), float32.
Encode = Callable[[Any], NDArray[np.float32]]


class Bridge(VecEnv):
    """A Gymnasium vector environment as SB3 wants it.

    Args:
        venv: steps B sub-environments, with ``autoreset_mode=SAME_STEP``.
        encode: from its batched observations to network inputs.
        n_inputs: how many: K.

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


def _stacked(observations: list[Any]) -> Any:
    if isinstance(observations[0], dict):
        return {key: np.stack([one[key] for one in observations]) for key in observations[0]}
    return np.stack(observations)

"""Small environments with costs whose best policies are known, shared by the tests of C-PPO."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces


class Bandit(gym.Env):
    """One step an episode: reward is the action, cost its positive part: the best action is the limit."""

    observation_space = spaces.Box(0.0, 1.0, (1,), np.float64)
    action_space = spaces.Box(-1.0, 3.0, (1,), np.float32)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None):
        super().reset(seed=seed)
        return np.zeros(1), {}

    def step(self, action):
        return np.zeros(1), float(action[0]), True, False, {"cost": max(0.0, float(action[0]))}


class Walk(gym.Env):
    """Random walk of fixed length; the arguments say what an episode pays, costs and how it ends."""

    action_space = spaces.Box(-1.0, 1.0, (2,), np.float32)

    def __init__(
        self, cost: str = "reward", length: int = 7, ends: str = "truncated", dict_space: bool = False
    ):
        self.cost, self.length, self.ends, self.dict_space = cost, length, ends, dict_space
        self.observation_space: spaces.Space = spaces.Box(-50.0, 50.0, (2,), np.float64)
        if dict_space:
            grid = spaces.Box(-50.0, 50.0, (2, 1), np.float64)
            self.observation_space = spaces.Dict({"place": self.observation_space, "again": grid})
        self.place, self.time = np.zeros(2), 0

    def _observe(self):
        return {"place": self.place, "again": self.place[:, None]} if self.dict_space else self.place

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None):
        super().reset(seed=seed)
        self.place, self.time = self.np_random.normal(size=2), 0
        return self._observe(), {}

    def step(self, action):
        self.place, self.time = self.place + np.asarray(action, np.float64), self.time + 1
        reward = 2.0 + float(np.sin(self.place).sum())
        over = self.time >= self.length
        ends = {name: over and self.ends == name for name in ("terminated", "truncated")}
        info = {"reward": {"cost": reward}, "constant": {"cost": 1.0}, "none": {}, "nan": {"cost": np.nan}}
        return self._observe(), reward, ends["terminated"], ends["truncated"], info[self.cost]


class Lever(gym.Env):
    """Discrete actions: the second pays 1, the others nothing."""

    observation_space = spaces.Box(0.0, 1.0, (1,), np.float64)
    action_space = spaces.Discrete(3)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None):
        super().reset(seed=seed)
        return np.zeros(1), {}

    def step(self, action):
        return np.zeros(1), float(action == 1), True, False, {"cost": 0.0}


for _name, _kind in {"Bandit": Bandit, "Walk": Walk, "Lever": Lever}.items():
    if f"Toy{_name}-v0" not in gym.registry:
        gym.register(f"Toy{_name}-v0", entry_point=_kind)

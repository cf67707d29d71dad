"""The cost convention, its check and the adapters to the six-value convention."""

from __future__ import annotations

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces

from rise_envs.cost import CostFromTuple, CostToTuple, RequireCost, cost_of


class Costly(gym.Env):
    """Returns the costs it was given, one a step; ``None``: no cost."""

    observation_space = spaces.Box(-1, 1, (2,), np.float64)
    action_space = spaces.Discrete(2)

    def __init__(self, costs):
        self.costs = costs

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.t = 0
        return self.np_random.uniform(-1, 1, 2), {"at": "reset"}

    def step(self, action):
        cost = self.costs[self.t]
        self.t += 1
        info = {"t": self.t} | ({} if cost is None else {"cost": cost})
        return self.np_random.uniform(-1, 1, 2), 0.25 * action, self.t == len(self.costs), self.t == 3, info


class SixValues(Costly):
    """safety-gymnasium's way: the cost in the tuple, not in info."""

    def step(self, action):
        observation, reward, terminated, truncated, info = super().step(action)
        return observation, reward, info.pop("cost"), terminated, truncated, info


@pytest.mark.parametrize(
    "cost", [0.0, 1.0, 0, 2, True, np.float32(0.5), np.float64(3), np.int64(4), np.bool_(True), np.array(1.5)]
)
def test_a_valid_cost_becomes_a_plain_float(cost):
    assert cost_of({"cost": cost}) == float(cost)
    assert type(cost_of({"cost": cost})) is float


@pytest.mark.parametrize(
    ("cost", "message"),
    [
        (np.nan, "finite and ≥ 0, Toy gave nan"),
        (np.inf, "finite and ≥ 0, Toy gave inf"),
        (-0.1, "finite and ≥ 0, Toy gave -0.1"),
        (np.float32(-1), "≥ 0, Toy gave -1.0"),
        (None, "one number, Toy gave None"),
        ("1", "one number"),
        (np.zeros(2), "one number"),
        ([1.0], "one number"),
        (1j, "one number"),
    ],
)
def test_an_invalid_cost_raises(cost, message):
    with pytest.raises(ValueError, match=message):
        cost_of({"cost": cost}, "Toy")


def test_a_missing_cost_raises_and_says_what_to_do():
    with pytest.raises(
        ValueError, match=r"Toy gave no info\['cost'\] \(only \['costs', 't'\]\).*CostFromTuple"
    ):
        cost_of({"costs": 1.0, "t": 0}, "Toy")


def test_require_cost():
    env = RequireCost(Costly([np.float32(0), 1, None]))
    env.reset(seed=0)
    infos = [env.step(1)[4] for _ in range(2)]
    assert infos == [{"t": 1, "cost": 0.0}, {"t": 2, "cost": 1.0}]
    assert all(type(info["cost"]) is float for info in infos)
    with pytest.raises(ValueError, match=r"Costly.* gave no info\['cost'\]"):
        env.step(1)


def test_to_six_values():
    env = CostToTuple(Costly([0.0, 2.0, -1.0]))
    assert env.reset(seed=0)[1] == {"at": "reset"}
    observation, reward, cost, terminated, truncated, info = env.step(1)
    assert observation.shape == (2,)
    assert (reward, cost, terminated, truncated, info) == (0.25, 0.0, False, False, {"t": 1, "cost": 0.0})
    assert env.step(1)[2] == 2.0
    with pytest.raises(ValueError, match="finite and ≥ 0"):
        env.step(1)


def test_from_six_values():
    env = CostFromTuple(SixValues([0, np.float32(2), np.nan]))
    env.reset(seed=0)
    assert env.step(1)[1:] == (0.25, False, False, {"t": 1, "cost": 0.0})
    _, _, terminated, truncated, info = env.step(0)
    assert (terminated, truncated, info) == (False, False, {"t": 2, "cost": 2.0})
    assert type(info["cost"]) is float
    with pytest.raises(ValueError, match="SixValues"):
        env.step(1)


def test_five_values_are_not_six():
    env = CostFromTuple(Costly([0.0]))
    env.reset()
    with pytest.raises(ValueError, match="returns 5 values"):
        env.step(0)


@pytest.mark.parametrize("there_and_back", [lambda e: CostFromTuple(CostToTuple(e)), RequireCost])
def test_round_trip_of_five_values(there_and_back):
    plain, travelled = Costly([0.0, 1.5, 0.0]), there_and_back(Costly([0.0, 1.5, 0.0]))
    start, _ = plain.reset(seed=3)
    np.testing.assert_array_equal(travelled.reset(seed=3)[0], start)
    for action in (1, 0, 1):
        ours, theirs = travelled.step(action), plain.step(action)
        np.testing.assert_array_equal(ours[0], theirs[0])
        assert ours[1:] == theirs[1:]


def test_round_trip_of_six_values():
    plain, travelled = SixValues([0.0, 1.5]), CostToTuple(CostFromTuple(SixValues([0.0, 1.5])))
    plain.reset(seed=3), travelled.reset(seed=3)
    for action in (1, 0):
        ours, theirs = travelled.step(action), plain.step(action)
        np.testing.assert_array_equal(ours[0], theirs[0])
        assert ours[1:5] == theirs[1:5]
        assert ours[5] == {**theirs[5], "cost": theirs[2]}


def test_gymnasium_wrappers_go_around_an_adapted_environment():
    env = gym.wrappers.TimeLimit(CostFromTuple(SixValues([0.0] * 9)), 2)
    env.reset(seed=0)
    assert not env.step(0)[3]
    assert env.step(0)[3]

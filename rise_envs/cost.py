"""Cost, the second signal of safe learning: the convention, its check, and adapters to the other convention.

Here, as in FSRL, Bullet-Safety-Gym and DSRL, ``step`` returns the five values of Gymnasium, and
``info["cost"]`` is a float ≥ 0 in every step. safety-gymnasium and OmniSafe return six: ``observation,
reward, cost, terminated, truncated, info``. A step without cost is an error, not a step of cost 0: a misspelt
key would otherwise train an agent that knows of no danger.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.utils import RecordConstructorArgs

_NUMBERS = (float, int, np.floating, np.integer, np.bool_)


def cost_of(info: Mapping[str, Any], source: object = "the environment") -> float:
    """The cost of the step that gave ``info``, as a plain float.

    Args:
        info: of one step.
        source: where it came from, for the message.

    Raises:
        ValueError: no ``"cost"`` in it, or one that is no finite number ≥ 0.
    """
    if "cost" not in info:
        raise ValueError(
            f"{source} gave no info['cost'] (only {sorted(map(str, info))}): set it to a float ≥ 0 in every "
            "step, or wrap an environment that returns six values in rise_envs.cost.CostFromTuple"
        )
    return checked_cost(info["cost"], source)


def checked_cost(cost: Any, source: object = "the environment") -> float:
    """``cost`` as a plain float; raises ``ValueError`` unless it is one finite number ≥ 0."""
    if isinstance(cost, np.ndarray) and cost.ndim == 0:
        cost = cost[()]
    if not isinstance(cost, _NUMBERS):
        raise ValueError(f"the cost of a step must be one number, {source} gave {cost!r}")
    number = float(cost)
    if not 0.0 <= number < math.inf:  # false for NaN too
        raise ValueError(f"the cost of a step must be finite and ≥ 0, {source} gave {number}")
    return number


class RequireCost(gym.Wrapper, RecordConstructorArgs):
    """Any environment, with the promise that every step has a valid ``info["cost"]``, a plain float."""

    def __init__(self, env: gym.Env) -> None:
        RecordConstructorArgs.__init__(self)
        gym.Wrapper.__init__(self, env)

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Step; raises ``ValueError`` where the cost is missing or invalid."""
        observation, reward, terminated, truncated, info = self.env.step(action)
        return observation, reward, terminated, truncated, {**info, "cost": cost_of(info, self.env)}


class CostToTuple(gym.Wrapper, RecordConstructorArgs):
    """An environment in the manner of safety-gymnasium and OmniSafe: ``step`` returns six values.

    The cost stays in ``info`` too. Make it the outermost wrapper: Gymnasium's own unpack five values.
    """

    def __init__(self, env: gym.Env) -> None:
        RecordConstructorArgs.__init__(self)
        gym.Wrapper.__init__(self, env)

    def step(self, action: Any) -> tuple[Any, Any, float, bool, bool, dict[str, Any]]:  # type: ignore[override]
        """Observation, reward, cost, terminated, truncated, info.

        Raises:
            ValueError: the cost is missing or invalid.
        """
        observation, reward, terminated, truncated, info = self.env.step(action)
        return observation, reward, cost_of(info, self.env), terminated, truncated, info


class CostFromTuple(gym.Wrapper, RecordConstructorArgs):
    """An environment whose ``step`` returns six values (safety-gymnasium), in the manner of Gymnasium.

    Its own ``info["cost"]``, if any, gives way to the cost in the tuple. Make it the innermost wrapper.
    """

    def __init__(self, env: gym.Env) -> None:
        RecordConstructorArgs.__init__(self)
        gym.Wrapper.__init__(self, env)

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Observation, reward, terminated, truncated, and info with the cost.

        Raises:
            ValueError: not six values, or a cost that is no finite number ≥ 0.
        """
        values: tuple[Any, ...] = self.env.step(action)
        if len(values) != 6:
            raise ValueError(
                f"step() of {self.env} returns {len(values)} values, not the six observation, reward, cost, "
                "terminated, truncated, info: use it without CostFromTuple"
            )
        observation, reward, cost, terminated, truncated, info = values
        return observation, reward, terminated, truncated, {**info, "cost": checked_cost(cost, self.env)}

"""Which settings of an agent are worth searching: its class declares them as ``SEARCH``, beside its defaults.

A space is a dict from fields of the agent's ``Config`` to where their values come from. ``SEARCH`` holds the one
for every environment under ``EVERYWHERE`` and, under an environment's id, what differs there.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from rise_envs import STAND_INS

EVERYWHERE = "*"
_DIGITS = 3  # significant ones of a drawn number: no training can tell it from a more exact one


@dataclass(frozen=True)
class Choice:
    """One of these values, each as likely as the others."""

    values: tuple[Any, ...]

    def draw(self, rng: np.random.Generator) -> Any:
        """A value; lists stand for tuples, as in JSON."""
        value = self.values[int(rng.integers(len(self.values)))]
        return list(value) if isinstance(value, tuple) else value


@dataclass(frozen=True)
class LogRange:
    """A positive number between two bounds, whose logarithm is uniform."""

    low: float
    high: float

    def __post_init__(self) -> None:
        if not 0 < self.low < self.high < math.inf:
            raise ValueError(f"a range needs 0 < low < high, got {self.low} and {self.high}")

    def draw(self, rng: np.random.Generator) -> float:
        """A value of three significant digits, within the bounds."""
        value = math.exp(rng.uniform(math.log(self.low), math.log(self.high)))
        return min(max(float(f"{value:.{_DIGITS}g}"), self.low), self.high)


Space = Mapping[str, Choice | LogRange]


def space_of(kind: Any, env_id: str) -> dict[str, Choice | LogRange]:
    """What is searched of an agent class in an environment (in a stand-in: as in what it stands for).

    Raises:
        ValueError: the class declares nothing.
    """
    declared: Mapping[str, Space] = getattr(kind, "SEARCH", {})
    space = {**declared.get(EVERYWHERE, {}), **declared.get(STAND_INS.get(env_id, env_id), {})}
    if not space:
        raise ValueError(f"{kind.name} declares no settings to search: give {kind.__name__} a SEARCH")
    return space


def draw(space: Space, rng: np.random.Generator) -> dict[str, Any]:
    """Random settings, fit for JSON."""
    return {field: domain.draw(rng) for field, domain in space.items()}

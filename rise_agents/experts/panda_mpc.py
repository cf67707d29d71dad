"""Sampling model-predictive expert for the Panda: a cross-entropy search around a plan.

Every step searches the next ten actions, linear between four knots, on the motion model of
:mod:`rise_agents.experts.panda_model`, in which the sphere keeps its velocity. The search starts from the
roll-out that `choose_side` picked, so that both experts pass the sphere on the same side, and draws from one
fixed table of normal numbers: the same observation always gets the same action, in any batch. Where the
straight way is clear there is nothing to search, and the action is the barrier controller's.

Source: Rubinstein & Kroese, "The Cross-Entropy Method", 2004.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from rise_agents.experts.panda_cbf import check_steering, packed
from rise_agents.experts.panda_model import DT, Arm, Scene, advance, look, make_arm
from rise_agents.experts.panda_steering import Steering, choose_side, make_program
from rise_agents.readings import checked_batch
from rise_envs import streams
from rise_envs.settings import check_fields
from rise_envs.task import Task

Array = NDArray[np.float64]

N_STEPS = 10
KNOT_STEPS = (0, 3, 6, 9)
N_KNOTS = len(KNOT_STEPS)
# Actions of the steps as mixtures of the knots, (N_STEPS, N_KNOTS).
_MIX = np.stack([np.interp(np.arange(N_STEPS), KNOT_STEPS, row) for row in np.eye(N_KNOTS)], axis=1)


class Search(NamedTuple):
    """Tunables of the search, a named tuple because numba compiles for it.

    Attributes:
        spread: standard deviation of the first samples (units of action).
        elites: samples that the next mean is taken over.
        clear: clearance that costs nothing (m).
        intrusion: price of a metre of missing clearance, in metres of distance to the goal.
        ending: weight of the distance to the goal at the end.
        loyalty: price of the squared deviation of the knots from the plan (m).
        change: price of the squared change from knot to knot (m).
    """

    spread: float = 0.3
    elites: int = 8
    clear: float = 0.05
    intrusion: float = 10.0
    ending: float = 3.0
    loyalty: float = 0.02
    change: float = 0.02


@dataclass(frozen=True)
class Config:
    """Settings of the plan that the search starts from, and of the search."""

    steering: Steering = Steering()  # noqa: RUF009 - immutable
    search: Search = Search()  # noqa: RUF009 - immutable
    samples: int = 64
    rounds: int = 2

    def __post_init__(self) -> None:
        check_fields(type(self), vars(self))
        check_fields(Search, self.search._asdict())
        check_steering(self.steering)
        if not 0 < self.search.elites <= self.samples or self.rounds < 1:
            raise ValueError(f"panda_mpc.Config needs 0 < elites <= samples and rounds >= 1, got {self!r}")


@njit(cache=True)
def _to_ball(knots: Array) -> None:
    """Shorten knots (N_KNOTS, 3) that are longer than 1, in place."""
    for i in range(N_KNOTS):
        length = np.sqrt(knots[i, 0] ** 2 + knots[i, 1] ** 2 + knots[i, 2] ** 2)
        for r in range(3):
            knots[i, r] /= max(1.0, length)


@njit(cache=True)
def _price(q: Array, velocity: Array, scene: Scene, knots: Array, plan: Array, p: Search, arm: Arm) -> float:
    """Cost (m) of a sequence of knots (N_KNOTS, 3) on the motion model."""
    q, velocity, center, action = q.copy(), velocity.copy(), scene.center.copy(), np.empty(3)
    price = 0.0
    for i in range(N_KNOTS):
        for r in range(3):
            price += p.loyalty * (knots[i, r] - plan[i, r]) ** 2
            price += p.change * (knots[i, r] - knots[max(i - 1, 0), r]) ** 2
    for step in range(N_STEPS + 1):
        look(q, center, arm)
        away = 0.0
        for r in range(3):
            away += (scene.goal[r] - arm.hand[r]) ** 2
        gap = arm.distance.min() - scene.radius
        weight = p.ending if step == N_STEPS else 1.0
        price += weight * max(0.0, np.sqrt(away) - 0.04) / N_STEPS
        price += p.intrusion / N_STEPS * (max(0.0, p.clear - gap) + 5.0 * max(0.0, 0.3 * p.clear - gap))
        if step == N_STEPS:
            break
        for r in range(3):
            action[r] = 0.0
            for i in range(N_KNOTS):
                action[r] += _MIX[step, i] * knots[i, r]
            center[r] += scene.drift[r]
        advance(q, velocity, action, arm)
    return price


@njit(cache=True)
def _refit(tried: Array, prices: Array, elites: int, mean: Array, spread: Array) -> None:
    """Mean and standard deviation (N_KNOTS, 3) of the cheapest samples, in place; uses up ``prices``."""
    square = np.zeros(mean.shape)
    for i in range(N_KNOTS):
        for r in range(3):
            mean[i, r] = 0.0
    for _ in range(elites):
        best = np.argmin(prices)
        prices[best] = np.inf
        for i in range(N_KNOTS):
            for r in range(3):
                mean[i, r] += tried[best, i, r] / elites
                square[i, r] += tried[best, i, r] ** 2 / elites
    for i in range(N_KNOTS):
        for r in range(3):
            spread[i, r] = np.sqrt(max(0.0, square[i, r] - mean[i, r] ** 2))


@njit(cache=True)
def _search(q: Array, velocity: Array, scene: Scene, knots: Array, p: Search, table: Array, arm: Arm) -> None:
    """Improve the knots (N_KNOTS, 3) of a plan by cross-entropy search, in place."""
    samples = table.shape[1]
    plan, spread = knots.copy(), np.full(knots.shape, p.spread)
    tried, prices = np.empty((samples, N_KNOTS, 3)), np.empty(samples)
    for k in range(table.shape[0]):
        for j in range(samples):
            for i in range(N_KNOTS):
                for r in range(3):
                    tried[j, i, r] = knots[i, r] + spread[i, r] * table[k, j, i, r]
            _to_ball(tried[j])
            prices[j] = _price(q, velocity, scene, tried[j], plan, p, arm)
        _refit(tried, prices, p.elites, knots, spread)


@njit(cache=True)
def _act(
    state: Array, goal: Array, reading: Array, t: Steering, p: Search, table: Array, action: Array
) -> None:
    """Write actions (B, 3) for states (B, 13), goals (B, 3) and readings (B, 7)."""
    arm, program, actions = make_arm(), make_program(), np.empty((t.horizon, 3))
    side, knots = np.empty(3), np.empty((N_KNOTS, 3))
    for b in range(len(state)):
        q, velocity = state[b, 6:].copy(), state[b, 3:6].copy()
        scene = Scene(goal[b].copy(), reading[b, :3].copy(), DT * reading[b, 3:6], reading[b, 6])
        clear = choose_side(q, velocity, scene, side, t, arm, program, actions)
        for i in range(N_KNOTS):
            for r in range(3):
                knots[i, r] = actions[KNOT_STEPS[i], r]
        if not clear:
            _to_ball(knots)
            _search(q, velocity, scene, knots, p, table, arm)
        for r in range(3):
            action[b, r] = knots[0, r]


class PandaMPC:
    """The expert: memoryless, reads the observation only.

    Args:
        task: description of the Panda task.
        seed: of the table of normal numbers that the search draws from.
        config: settings.
    """

    def __init__(self, task: Task, seed: int = 0, config: Config = Config()) -> None:
        self.task, self.config = task, config
        shape = (config.rounds, config.samples, N_KNOTS, 3)
        table = streams.normal(streams.key_from_seed(seed), np.arange(np.prod(shape))).reshape(shape)
        table[:, 0] = 0.0  # the mean itself is a sample
        self._table = table

    def predict(
        self,
        observation: Mapping[str, Array],
        state: Any = None,
        episode_start: NDArray[np.bool_] | None = None,
        deterministic: bool = True,
    ) -> tuple[Array, None]:
        """Actions, (3,) or (B, 3), and None: the expert keeps no state."""
        rows, single = checked_batch(self.task, observation)
        own, goal, reading = packed(rows)
        action = np.empty((len(goal), 3))
        _act(own, goal, reading, self.config.steering, self.config.search, self._table, action)
        return (action[0] if single else action), None

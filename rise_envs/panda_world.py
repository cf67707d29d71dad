"""The world of ``RISE-SafePandaKinematic-v0``: its episodes as arrays, for the single and the batched environment.

Both stand on this file, so they cannot differ. Arrays are replaced, never written into. Shapes: B batch.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rise_envs import panda_starts
from rise_envs.panda_clearance import LINKS
from rise_envs.panda_motion import Arms
from rise_envs.panda_starts import Constants

Array = NDArray[np.float64]
Whole = NDArray[np.int64]


@dataclass(frozen=True)
class World:
    """The true state of B episodes.

    Attributes:
        arms: the arms.
        goal: goals (m), (B, 3).
        sphere: readings of the spheres, the velocity that of the coming step, (B, 7).
        key: of the spheres' motion, (B,).
        step: steps taken, (B,).
        clearance: least clearance within the last step, or at the start (m), (B,).
        nearest: the capsule that had it, (B,).
    """

    arms: Arms
    goal: Array
    sphere: Array
    key: Whole
    step: Whole
    clearance: Array
    nearest: Whole


def begin(keys: Whole, constants: Constants) -> World:
    """The starts of the episodes with these keys, (B,): see :func:`rise_envs.panda_starts.begin`."""
    goal, sphere, motion, clearance, nearest = panda_starts.begin(keys, constants)
    step = np.zeros(len(keys), np.int64)
    return World(Arms.at_rest(len(keys)), goal, sphere, motion, step, clearance, nearest)


def advance(world: World, action: Array, constants: Constants) -> World:
    """The world after one control step under ``action`` (B, 3), clipped to [−1, 1]."""
    arms, clearance, nearest = world.arms.step(action, world.sphere)
    sphere = panda_starts.advance(world.sphere, world.goal, world.key, world.step, constants.rules)
    return World(arms, world.goal, sphere, world.key, world.step + 1, clearance, nearest)


def replaced(world: World, rows: Whole, fresh: World) -> World:
    """``world`` with the episodes of ``fresh`` in its ``rows``."""

    def merged(old: Any, new: Any) -> Any:
        if isinstance(old, Arms):
            return Arms(*(merged(getattr(old, f.name), getattr(new, f.name)) for f in fields(Arms)))
        array = old.copy()
        array[rows] = new
        return array

    return World(*(merged(getattr(world, f.name), getattr(fresh, f.name)) for f in fields(World)))


def observe(world: World) -> dict[str, Array]:
    """The true observations (every array is the caller's own)."""
    arms = world.arms
    return {
        "observation": np.concatenate((arms.hand, arms.velocity, arms.q), axis=1),
        "achieved_goal": arms.hand.copy(),
        "desired_goal": world.goal.copy(),
        "obstacle": world.sphere.copy(),
    }


def report(world: World, before: Array, reached: NDArray[np.bool_]) -> dict[str, Any]:
    """The infos of the last step, one array per key (every array is the caller's own).

    Args:
        world: after the step, or at the start.
        before: hand points where the step began, (B, 3).
        reached: whether the goals are reached, (B,).
    """
    hit = world.clearance < 0
    links = np.full(len(hit), None, object)
    if hit.any():
        links[hit] = LINKS[world.nearest[hit]]
    return {
        "cost": hit.astype(np.float64),
        "clearance": world.clearance.copy(),
        "collision_link": links,
        "is_success": reached.copy(),
        "previous_achieved_goal": before.copy(),
    }

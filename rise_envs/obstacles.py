"""Moving balls in two or three dimensions: the obstacles of every RISE environment.

Within one control step a ball moves in a straight line. Between steps its velocity is re-drawn at random
times, and turned where the next step would leave the arena or enter the free ball around the goal. So the
reading (position, velocity, radius) describes the coming step exactly, and no later one.

Shapes: B batch, N obstacles, D dimensions.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rise_envs import streams

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Motion:
    """How the balls move.

    Attributes:
        dt: duration of a control step (s).
        max_speed: speeds are drawn from U[0, max_speed] (m/s), directions uniformly.
        redraw_interval: mean time between two draws of a ball's velocity (s): at every step a coin, so that
            the draws have no memory and nobody can foresee them.
        low: lower corner of the box that the centres stay in (m), length D.
        high: upper corner of that box (m), length D.
        goal_gap: least distance kept between a ball's surface and the goal point (m).
    """

    dt: float
    max_speed: float
    redraw_interval: float
    low: tuple[float, ...]
    high: tuple[float, ...]
    goal_gap: float


def draw_velocity(key: NDArray[np.uint64], counter: NDArray | int, n: int, motion: Motion) -> Array:
    """Velocities (B, N, D), isotropic in direction: draw number ``counter`` (int or (B,)) of keys (B,)."""
    d = len(motion.low)
    index = np.arange(n * (d + 1), dtype=np.uint64).reshape(n, d + 1)
    start = np.reshape(np.asarray(counter, dtype=np.uint64), (-1, 1, 1)) * np.uint64(2 * n * (d + 1))
    direction = streams.normal(np.reshape(key, (-1, 1, 1)), start // np.uint64(2) + index[:, :d])
    speed = motion.max_speed * streams.uniform(np.reshape(key, (-1, 1, 1)), start + 2 * index[:, d:])
    return direction * (speed / np.linalg.norm(direction, axis=-1, keepdims=True))


def redraw(velocity: Array, key: NDArray[np.uint64], step: NDArray | int, motion: Motion) -> Array:
    """Velocities (B, N, D) for the coming step: new where a coin with the stated mean interval says so."""
    n = velocity.shape[1]
    coins = streams.split(key, 1)
    counter = np.reshape(np.asarray(step, dtype=np.uint64), (-1, 1)) * np.uint64(n) + np.arange(
        n, dtype=np.uint64
    )
    due = streams.uniform(np.reshape(coins, (-1, 1)), counter) < motion.dt / motion.redraw_interval
    if not due.any():
        return velocity
    rows = due.any(axis=1)
    fresh = velocity.copy()
    keys, steps = np.broadcast_to(key, len(velocity))[rows], np.broadcast_to(step, len(velocity))[rows]
    fresh[rows] = np.where(due[rows, :, None], draw_velocity(keys, steps, n, motion), velocity[rows])
    return fresh


def keep_inside(position: Array, velocity: Array, radius: Array, goal: Array, motion: Motion) -> Array:
    """Velocities (B, N, D) turned so that the coming step keeps to the arena and off the goal.

    Args:
        position: centres, (B, N, D), inside the box and off the goal.
        velocity: wanted velocities, (B, N, D).
        radius: radii, (B, N).
        goal: goal points, (B, D).
        motion: bounds and gap.

    Returns:
        The velocity, mirrored at the walls of the box and at the ball of radius ``radius + goal_gap`` around
        the goal. A ball that would still break a bound (a corner between both) rests until its next draw.
    """
    low, high = np.asarray(motion.low), np.asarray(motion.high)
    ahead = position + motion.dt * velocity
    velocity = np.where((ahead < low) | (ahead > high), -velocity, velocity)

    gap = (radius + motion.goal_gap)[..., None]
    offset = position - goal[:, None]
    distance = np.linalg.norm(offset, axis=-1, keepdims=True)
    normal = offset / distance
    inward = (velocity * normal).sum(-1, keepdims=True)
    enters = np.linalg.norm(offset + motion.dt * velocity, axis=-1, keepdims=True) < gap
    velocity = np.where(enters & (inward < 0), velocity - 2 * inward * normal, velocity)

    ahead = position + motion.dt * velocity
    outside = ((ahead < low) | (ahead > high)).any(-1, keepdims=True)
    enters = np.linalg.norm(ahead - goal[:, None], axis=-1, keepdims=True) < gap
    return np.where(outside | enters, 0.0, velocity)


def readings(position: Array, velocity: Array, radius: Array) -> Array:
    """The readings c = (position, velocity, radius) of all balls, flattened to (B, N·(2D + 1))."""
    c = np.concatenate((position, velocity, radius[..., None]), axis=-1)
    return c.reshape(len(c), -1)

"""Moving balls in two or three dimensions: the obstacles of every RISE environment.

Within one control step a ball moves in a straight line. Between steps its velocity is re-drawn at random
times, and turned where the next step would leave the arena or enter the free ball around the goal. So the
reading (position, velocity, radius) describes the coming step exactly, and no later one.

The motion is written once, for one ball (or arrays of them) by its coordinates, with
:mod:`rise_envs.arithmetic`; in two dimensions the third coordinate is 0. What follows are its batched forms.

Shapes: B batch, N obstacles, D dimensions.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rise_envs.arithmetic import TWO_PI, Number, sincos, sqrt, uniform, where

Array = NDArray[np.float64]
Vector = tuple[Number, Number, Number]

DRAWS = 4  # counters that a ball uses in one step: coin, speed, and two for the direction


class Rules(NamedTuple):
    """`Motion` as plain numbers in three dimensions."""

    dt: float
    max_speed: float
    chance: float
    low: tuple[float, float, float]
    high: tuple[float, float, float]
    goal_gap: float
    flat: bool


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

    @property
    def rules(self) -> Rules:
        """The same as plain numbers, for what is written by coordinates."""
        low, high = ((*map(float, corner), 0.0)[:3] for corner in (self.low, self.high))
        chance = self.dt / self.redraw_interval
        flat = len(self.low) == 2
        return Rules(self.dt, self.max_speed, chance, low, high, self.goal_gap, flat)  # type: ignore[arg-type]


def drawn_velocity(key: Number, counter: Number, m: Rules) -> Vector:
    """The velocity that a ball draws with the ``DRAWS`` numbers from ``counter`` on, isotropic."""
    speed = m.max_speed * uniform(key, counter + 1)
    sin, cos = sincos(TWO_PI * uniform(key, counter + 2))
    if m.flat:
        return speed * cos, speed * sin, 0.0 * speed
    # On the sphere every coordinate of a uniform direction is uniform (Archimedes).
    z = 2.0 * uniform(key, counter + 3) - 1.0
    across = speed * sqrt(1.0 - z * z)
    return across * cos, across * sin, speed * z


def outside(position: Vector, m: Rules) -> Number:
    """Whether a point lies outside the box."""
    (x, y, z), low, high = position, m.low, m.high
    return (x < low[0]) | (x > high[0]) | (y < low[1]) | (y > high[1]) | (z < low[2]) | (z > high[2])


def kept(position: Vector, velocity: Vector, radius: Number, goal: Vector, m: Rules) -> Vector:
    """The velocity, turned so that the coming step keeps to the box and off the goal: see `keep_inside`."""
    (x, y, z), (u, v, w), dt = position, velocity, m.dt
    ahead_x, ahead_y, ahead_z = x + dt * u, y + dt * v, z + dt * w
    u = where((ahead_x < m.low[0]) | (ahead_x > m.high[0]), -u, u)
    v = where((ahead_y < m.low[1]) | (ahead_y > m.high[1]), -v, v)
    w = where((ahead_z < m.low[2]) | (ahead_z > m.high[2]), -w, w)

    gap = radius + m.goal_gap
    ox, oy, oz = x - goal[0], y - goal[1], z - goal[2]
    px, py, pz = ox + dt * u, oy + dt * v, oz + dt * w
    enters = px * px + py * py + pz * pz < gap * gap
    inward = u * ox + v * oy + w * oz
    bounce = enters & (inward < 0.0)
    twice = (inward + inward) / (ox * ox + oy * oy + oz * oz)
    u = where(bounce, u - twice * ox, u)
    v = where(bounce, v - twice * oy, v)
    w = where(bounce, w - twice * oz, w)

    px, py, pz = ox + dt * u, oy + dt * v, oz + dt * w
    stuck = outside((x + dt * u, y + dt * v, z + dt * w), m) | (px * px + py * py + pz * pz < gap * gap)
    return where(stuck, 0.0, u), where(stuck, 0.0, v), where(stuck, 0.0, w)


def next_velocity(
    position: Vector,
    velocity: Vector,
    radius: Number,
    goal: Vector,
    key: Number,
    counter: Number,
    m: Rules,
) -> Vector:
    """A ball's velocity in the coming step: drawn anew where its coin says so, then turned where it must."""
    u, v, w = velocity
    due = uniform(key, counter) < m.chance
    new_u, new_v, new_w = drawn_velocity(key, counter, m)
    wanted = where(due, new_u, u), where(due, new_v, v), where(due, new_w, w)
    return kept(position, wanted, radius, goal, m)


def _coordinates(vectors: Array) -> Vector:
    """Vectors (..., D) by coordinates, the third 0 in the plane."""
    z = vectors[..., 2] if vectors.shape[-1] == 3 else np.zeros(vectors.shape[:-1])
    return vectors[..., 0], vectors[..., 1], z


def _counters(key: NDArray, step: NDArray | int, n: int) -> tuple[NDArray, NDArray]:
    """Keys (B, 1) and counters (B, N), signed, of the given steps (int or (B,))."""
    first = np.reshape(np.asarray(step, dtype=np.int64), (-1, 1)) * n + np.arange(n)
    return np.reshape(np.asarray(key, dtype=np.uint64), (-1, 1)).view(np.int64), DRAWS * first


def draw_velocity(key: NDArray[np.uint64], step: NDArray | int, n: int, motion: Motion) -> Array:
    """Velocities (B, N, D), isotropic in direction: those of step number ``step`` (int or (B,)) of keys (B,)."""
    drawn = drawn_velocity(*_counters(key, step, n), motion.rules)
    return np.stack(drawn[: len(motion.low)], -1)


def redraw(velocity: Array, key: NDArray[np.uint64], step: NDArray | int, motion: Motion) -> Array:
    """Velocities (B, N, D) for the coming step: new where a coin with the stated mean interval says so."""
    n, rules = velocity.shape[1], motion.rules
    keys, counters = _counters(key, step, n)
    due = uniform(keys, counters) < rules.chance
    if not due.any():
        return velocity
    return np.where(due[..., None], draw_velocity(key, step, n, motion), velocity)


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
    where_to = _coordinates(goal[:, None])
    turned = kept(_coordinates(position), _coordinates(velocity), radius, where_to, motion.rules)
    return np.stack(turned[: len(motion.low)], -1)


def readings(position: Array, velocity: Array, radius: Array) -> Array:
    """The readings c = (position, velocity, radius) of all balls, flattened to (B, N·(2D + 1))."""
    c = np.concatenate((position, velocity, radius[..., None]), axis=-1)
    return c.reshape(len(c), -1)

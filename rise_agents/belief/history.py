"""What is remembered of a sequence of readings: discounted sums of it, and the lines and means that they amount to.

For each of L memories λ the reading of k steps ago has the weight λ^k. From sums over time (weights, ages, positions,
velocities, radii, their squares and products) follow, at any step, the least-squares line through the positions,
mean velocity and radius, and how much the readings scatter about all of these. The sums have a fixed size, however
long the episode: they are what the state of ``predict`` carries.

Nothing here knows how noisy the readings are, nor of which kind the noise is.

Shapes: B rows (each ball of each episode is one), L memories, D dimensions. SI units; positions in a fixed frame.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


class Readings(NamedTuple):
    """One reading of each row: position (B, D), velocity (B, D), radius (B,)."""

    position: Array
    velocity: Array
    radius: Array


class Evidence(NamedTuple):
    """What the memories say of the present step.

    Attributes:
        weight: sum of the weights, (B, L).
        carried: mean position, carried on to now by the mean velocity, (B, L, D).
        fitted: the least-squares line through the positions, now, (B, L, D).
        slope: its slope; the mean velocity while there is one reading, (B, L, D).
        velocity: mean velocity, (B, L, D).
        radius: mean radius, (B, L).
        scatter: deviation of positions about the line, of velocities and of radii about their means, (B, L, 3).
    """

    weight: Array
    carried: Array
    fitted: Array
    slope: Array
    velocity: Array
    radius: Array
    scatter: Array


def width(dim: int) -> int:
    """How many sums a memory keeps."""
    return 5 + 5 * dim


def nothing(rows: int, memories: int, dim: int) -> Array:
    """The sums (B, L, width) before the first reading."""
    return np.zeros((rows, memories, width(dim)))


def remembered(sums: Array, reading: Readings, dt: float, memories: Sequence[float]) -> Array:
    """The sums (B, L, width) with the next reading, ``dt`` (s) after the last one."""
    dim = reading.position.shape[1]
    weight, age, square, position, lagged = _moments(sums, dim)
    p, v, r = reading.position[:, None], reading.velocity[:, None], reading.radius[:, None, None]
    older = np.concatenate(  # all that was read has aged by dt
        (
            weight,
            age + dt * weight,
            square + dt * (2.0 * age + dt * weight),
            position,
            lagged + dt * position,
            sums[..., 3 + 2 * dim :],
        ),
        -1,
    )
    one, zero = np.ones_like(r), np.zeros_like(r)
    new = np.concatenate((one, zero, zero, p, 0.0 * p, p * p, v, v * v, r, r * r), -1)
    return older * np.asarray(memories)[:, None] + new


def evidence(sums: Array, dim: int) -> Evidence:
    """What the sums (B, L, width) say, after at least one reading."""
    weight = sums[..., :1]
    means = sums / weight
    _, age, square, position, lagged = _moments(means, dim)
    rest = means[..., 3 + 2 * dim :]
    position_square, velocity, velocity_square = (rest[..., i * dim : (i + 1) * dim] for i in range(3))
    radius, radius_square = rest[..., 3 * dim], rest[..., 3 * dim + 1]

    ages = np.maximum(square - age * age, 0.0)
    several = ages > 1e-9 * (1.0 + square)  # two readings at least, in a memory that has not faded to one
    slope = (age * position - lagged) / np.where(several, ages, 1.0)
    residual = np.maximum(position_square - position**2 - slope**2 * ages, 0.0)
    slope = np.where(several, slope, velocity)
    scatter = np.stack(
        (
            np.where(several, residual, 0.0).mean(-1),
            np.maximum(velocity_square - velocity**2, 0.0).mean(-1),
            np.maximum(radius_square - radius**2, 0.0),
        ),
        -1,
    )
    carried, fitted = position + velocity * age, position + slope * age
    return Evidence(weight[..., 0], carried, fitted, slope, velocity, radius, np.sqrt(scatter))


def _moments(sums: Array, dim: int) -> tuple[Array, Array, Array, Array, Array]:
    """Weights, ages and their squares (B, L, 1), positions and ages · positions (B, L, D)."""
    lagged = sums[..., 3 + dim : 3 + 2 * dim]
    return sums[..., :1], sums[..., 1:2], sums[..., 2:3], sums[..., 3 : 3 + dim], lagged

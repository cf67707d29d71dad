"""Arcs, signed distances and swept clearances: pure functions, batched over leading dimensions."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def wrap_angle(angle: Array) -> Array:
    """Angles (rad) brought into [−π, π)."""
    return (angle + np.pi) % (2 * np.pi) - np.pi


def unicycle(state: Array, action: Array, duration: Array | float) -> Array:
    """Unicycle states after driving a constant (v, ω) for ``duration`` seconds, exactly.

    The path is an arc of length v·t that turns by ω·t; its chord has length v·t·sin(ωt/2)/(ωt/2) and points
    along θ + ωt/2, which holds for a straight line (ω = 0) too.

    Args:
        state: (x, y, θ) in m and rad, (..., 3).
        action: (v, ω) in m/s and rad/s, (..., 2).
        duration: s, a number or (...).

    Returns:
        States (..., 3), heading in [−π, π).
    """
    half_turn = 0.5 * action[..., 1] * duration
    small = np.abs(half_turn) < 1e-6
    safe = np.where(small, 1.0, half_turn)
    chord = action[..., 0] * duration * np.where(small, 1.0 - half_turn**2 / 6.0, np.sin(safe) / safe)
    course = state[..., 2] + half_turn
    return np.stack(
        (
            state[..., 0] + chord * np.cos(course),
            state[..., 1] + chord * np.sin(course),
            wrap_angle(course + half_turn),
        ),
        axis=-1,
    )


def segment_distance(start: Array, end: Array) -> Array:
    """Least distance between the origin and the segments ``start`` → ``end``, (..., D)."""
    path = end - start
    length2 = (path**2).sum(-1)
    share = np.clip(-(start * path).sum(-1) / np.where(length2 > 0, length2, 1.0), 0.0, 1.0)
    return np.linalg.norm(start + share[..., None] * path, axis=-1)


def swept_clearance(
    state: Array,
    action: Array,
    position: Array,
    velocity: Array,
    radius: Array,
    dt: float,
    robot_radius: float,
) -> Array:
    """Least signed distance between a driving disc and moving discs over one step, not only at its end.

    The time of closest approach is where the parabola through the squared distances at the step's start,
    middle and end is least; the distance there is taken on the exact arc. (The chord's time would not do: the
    arc bulges by 5 mm, which can cost 3 mm of clearance.) The result errs upwards only: for steps of 0.25 m
    and 0.15 rad by less than 0.01 mm where discs nearly touch, and by less than 1 mm where their centres meet
    (tested).

    Args:
        state: (x, y, θ) at the step's start, (B, 3).
        action: (v, ω), (B, 2).
        position: centres of the discs at the step's start, (B, N, 2).
        velocity: their velocities in this step (m/s), (B, N, 2).
        radius: their radii (m), (B, N).
        dt: duration of the step (s).
        robot_radius: m.

    Returns:
        Clearances (B, N) in m; negative where the discs overlap at any time within the step.
    """

    def squared_distance(time: Array) -> Array:
        driven = unicycle(state[:, None], action[:, None], time)[..., :2]
        return ((driven - position - time[..., None] * velocity) ** 2).sum(-1)

    first, middle, last = (squared_distance(np.full((1, 1), t)) for t in (0.0, 0.5 * dt, dt))
    bend = first - 2.0 * middle + last
    vertex = np.where(bend > 0, 0.5 + (first - last) / (4.0 * np.where(bend > 0, bend, 1.0)), 0.0)
    nearest = squared_distance(dt * np.clip(vertex, 0.0, 1.0))
    least = np.minimum(np.minimum(first, middle), np.minimum(last, nearest))
    return np.sqrt(least) - radius - robot_radius

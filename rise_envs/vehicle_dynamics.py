"""The ground vehicle's motion, clearance, reward and fair starts, written once, for one vehicle and one disc.

Every argument is a number, or an array of them that broadcasts: with :mod:`rise_envs.arithmetic` the same lines
run on NumPy and torch arrays (:mod:`rise_envs.vehicle_arrays`) and compiled (:mod:`rise_envs.vehicle_compiled`),
and agree to the last bit.
"""

from __future__ import annotations

import functools
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rise_envs.arithmetic import Number, arc, sincos, sqrt, to_float, uniform, where, wrap_angle
from rise_envs.obstacles import DRAWS, Rules, drawn_velocity, kept, outside

Pose = tuple[Number, Number, Number]  # x, y (m), θ (rad)
Disc = tuple[Number, Number, Number, Number, Number]  # px, py (m), vx, vy (m/s), r (m)
Turn = tuple[Number, Number, Number, Number]  # sin θ, cos θ; how far the arc of a step gets, ahead and aside

Array = NDArray[np.float64]

HALF_PI = 1.5707963267948966
PLACE_DRAWS = 5  # numbers that a start of the vehicle takes
DISC_DRAWS = 3 + DRAWS  # and a start of each disc
MAX_ATTEMPTS = 2_000


class Constants(NamedTuple):
    """The task as plain numbers: see :class:`rise_envs.vehicle_world.Params` for their meaning."""

    dt: float
    v_min: float
    v_max: float
    omega_max: float
    robot_radius: float
    goal_radius: float
    per_goal_radius: float  # 1 / goal_radius
    arena_half: float
    goal_distance: tuple[float, float]
    heading_spread: float
    obstacle_radius: tuple[float, float]
    obstacle_along: tuple[float, float]
    obstacle_offset: float
    start_margin: float
    start_horizon: float
    rules: Rules
    sparse: bool  # the reward


@functools.cache
def packed(c: Constants) -> Array:
    """The constants as one array: unlike a tuple, compiled code takes it as an argument in no time."""
    numbers: list[float] = []
    for value in (*c[:-2], *c.rules, c.sparse):
        numbers += value if isinstance(value, tuple) else [value]
    return np.array(numbers, float)


def unpacked(n: Array) -> Constants:
    """The inverse of `packed`."""
    rules = Rules(n[18], n[19], n[20], (n[21], n[22], n[23]), (n[24], n[25], n[26]), n[27], n[28] > 0.0)
    goal_distance, obstacle_radius, obstacle_along = (n[8], n[9]), (n[11], n[12]), (n[13], n[14])
    return Constants(
        n[0],
        n[1],
        n[2],
        n[3],
        n[4],
        n[5],
        n[6],
        n[7],
        goal_distance,
        n[10],
        obstacle_radius,
        obstacle_along,
        n[15],
        n[16],
        n[17],
        rules,
        n[29] > 0.0,
    )


def clipped(x: Number, low: float, high: float) -> Number:
    """``x``, or the bound that it breaks."""
    x = where(x < low, low, x)
    return where(x > high, high, x)


def turn(theta: Number, omega: Number, dt: float) -> Turn:
    """What drive and clearance share of a step of ``dt`` seconds; −1 ≤ ω · dt ≤ 1."""
    return (*sincos(theta), *arc(omega * dt))


def drive(pose: Pose, v: Number, omega: Number, turn: Turn, dt: float) -> Pose:
    """The unicycle's pose (x, y, θ) after driving a constant (v, ω) for ``dt`` seconds, exactly."""
    (x, y, theta), (sin, cos, ahead, aside) = pose, turn
    way = v * dt
    ahead, aside = way * ahead, way * aside
    return x + (cos * ahead - sin * aside), y + (sin * ahead + cos * aside), wrap_angle(theta + omega * dt)


def _squared_gap(
    v: Number, arc: tuple[Number, Number], x: Number, y: Number, u: Number, w: Number, t: Number
) -> Number:
    """Squared distance of the centres ``t`` seconds on; the disc in the frame that the vehicle starts in."""
    way = v * t
    dx, dy = way * arc[0] - (x + t * u), way * arc[1] - (y + t * w)
    return dx * dx + dy * dy


def swept_clearance(
    pose: Pose, v: Number, omega: Number, turn: Turn, disc: Disc, dt: float, robot_radius: float
) -> Number:
    """Least signed distance (m) to a disc over one step: see :func:`rise_envs.geometry.swept_clearance`."""
    (x, y, _), (sin, cos, ahead, aside), (px, py, u, w, radius) = pose, turn, disc
    half = 0.5 * dt
    dx, dy = px - x, py - y
    dx, dy = cos * dx + sin * dy, cos * dy - sin * dx
    u, w = cos * u + sin * w, cos * w - sin * u
    first = dx * dx + dy * dy
    middle = _squared_gap(v, arc(omega * half), dx, dy, u, w, half)
    last = _squared_gap(v, (ahead, aside), dx, dy, u, w, dt)
    bend = first - 2.0 * middle + last
    vertex = 0.5 + (first - last) / (4.0 * where(bend > 0.0, bend, 1.0))
    vertex = clipped(where(bend > 0.0, vertex, 0.0), 0.0, 1.0)
    when = dt * vertex
    nearest = _squared_gap(v, arc(omega * when), dx, dy, u, w, when)
    least = where(middle < first, middle, first)
    least = where(last < least, last, least)
    least = where(nearest < least, nearest, least)
    return sqrt(least) - radius - robot_radius


def gap(x: Number, y: Number, goal_x: Number, goal_y: Number) -> Number:
    """Distance between two points (m)."""
    dx, dy = goal_x - x, goal_y - y
    return sqrt(dx * dx + dy * dy)


def reward(before: Number, after: Number, reached: Number, c: Constants) -> Number:
    """The reward of a step that begins and ends at these distances from the goal (m)."""
    if c.sparse:
        return to_float(reached) - 1.0
    return (before - after) * c.per_goal_radius + to_float(reached)


def placed(
    key: Number, counter: Number, c: Constants
) -> tuple[Number, Number, Number, Number, Number, Number, Number, Number, Number]:
    """A start of the vehicle: (x, y, θ), goal, the goal's distance and direction, and whether it is valid."""
    half, (near, far) = c.arena_half, c.goal_distance
    x = half * (2.0 * uniform(key, counter) - 1.0)
    y = half * (2.0 * uniform(key, counter + 1) - 1.0)
    course = HALF_PI * (4.0 * uniform(key, counter + 2) - 2.0)
    distance = near + (far - near) * uniform(key, counter + 3)
    theta = wrap_angle(course + c.heading_spread * (2.0 * uniform(key, counter + 4) - 1.0))
    sin, cos = sincos(course)
    goal_x, goal_y = x + distance * cos, y + distance * sin
    valid = (goal_x >= -half) & (goal_x <= half) & (goal_y >= -half) & (goal_y <= half)
    return x, y, theta, goal_x, goal_y, distance, cos, sin, valid


def placed_disc(
    key: Number,
    counter: Number,
    start: tuple[Number, Number],
    goal: tuple[Number, Number],
    way: tuple[Number, Number, Number],
    c: Constants,
) -> tuple[Number, Number, Number, Number, Number, Number]:
    """A disc at the start, (px, py, vx, vy, r), and whether it is a fair one; ``way`` is distance, cos, sin."""
    (x, y), (distance, cos, sin) = start, way
    (close, far), (small, large) = c.obstacle_along, c.obstacle_radius
    along = (close + (far - close) * uniform(key, counter)) * distance
    aside = c.obstacle_offset * (2.0 * uniform(key, counter + 1) - 1.0)
    radius = small + (large - small) * uniform(key, counter + 2)
    dx, dy = along * cos - aside * sin, along * sin + aside * cos
    px, py, there = x + dx, y + dy, (goal[0], goal[1], 0.0)
    u, v, w = drawn_velocity(key, counter + 3, c.rules)
    place = (px, py, 0.0 * px)
    u, v, _ = kept(place, (u, v, w), radius, there, c.rules)

    # Least distance over the disc's path of the first seconds, if the vehicle stays.
    path_x, path_y = c.start_horizon * u, c.start_horizon * v
    length2 = path_x * path_x + path_y * path_y
    share = -(dx * path_x + dy * path_y) / where(length2 > 0.0, length2, 1.0)
    share = clipped(share, 0.0, 1.0)
    nearest = gap(dx + share * path_x, dy + share * path_y, 0.0, 0.0) - radius - c.robot_radius
    valid = (nearest >= c.start_margin) & ~outside(place, c.rules)
    valid = valid & (gap(px, py, goal[0], goal[1]) >= radius + c.rules.goal_gap)
    return px, py, u, v, radius, valid

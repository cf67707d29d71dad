"""Where an episode of the Panda tasks starts and how its sphere moves: pure functions of its key, compiled.

Both Panda environments, Bullet's and the kinematic one, draw their episodes here. So a seed names the same goal,
the same sphere and the same motion of the sphere in both. The arm always starts in the neutral pose, where the
capsules of :mod:`rise_envs.panda_kinematics` say how far the sphere is from it: no engine is asked.

Shapes: B batch, K capsules. SI units, world frame.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rise_envs import panda_kinematics as panda
from rise_envs.arithmetic import split, sqrt, uniform
from rise_envs.compiled import compiled
from rise_envs.obstacles import DRAWS, Rules, drawn_velocity, kept, next_velocity, outside
from rise_envs.panda_scene import START_HAND, Params

Array = NDArray[np.float64]
Whole = NDArray[np.int64]
Point = tuple[float, float, float]

_SPHERES = 16  # places tried for the sphere before the next goal, so that goals spread as drawn
_MOST = 2000  # goals tried before giving up; fair parameters need a handful
_SIZE = 4 + 4 * _SPHERES  # draws for a goal and its spheres
# The capsules underestimate no clearance of the neutral pose by more than 4 mm (tested): with this margin the
# engine's clearance is what was promised, too.
_CAPSULE_ERROR = 0.005  # m


class Constants(NamedTuple):
    """What `begin` needs of the task, as plain numbers: see :class:`rise_envs.panda_scene.Params`."""

    hand: Point
    goal_low: Point
    goal_high: Point
    goal_min_distance: float
    reach: float
    radius: tuple[float, float]
    placed: tuple[float, float]
    max_offset: float
    start_clearance: float
    start_time: float
    rules: Rules


def constants(p: Params) -> Constants:
    """The task as plain numbers."""

    def point(values: tuple[float, ...]) -> Point:
        x, y, z = map(float, values)
        return x, y, z

    return Constants(
        point(START_HAND),
        point(p.goal_low),
        point(p.goal_high),
        float(p.goal_min_distance),
        float(p.reach),
        (float(p.radius[0]), float(p.radius[1])),
        (float(p.placed[0]), float(p.placed[1])),
        float(p.max_offset),
        float(p.start_clearance) + _CAPSULE_ERROR,
        float(p.start_time),
        p.motion.rules,
    )


def _neutral_capsules() -> Array:
    """Start, edge and radius of the capsules in the neutral pose, (K, 7)."""
    rotation, position = panda.neutral_frames()
    turn, frame = rotation[panda.CAPSULE_FRAME], panda.CAPSULE_FRAME
    start = position[frame] + np.einsum("kij,kj->ki", turn, panda.CAPSULE_START)
    edge = np.einsum("kij,kj->ki", turn, panda.CAPSULE_EDGE)
    return np.column_stack((start, edge, panda.CAPSULE_RADIUS))


_CAPSULES = _neutral_capsules()


@compiled
def _nearest(x: float, y: float, z: float, capsules: Array) -> tuple[float, int]:
    """Distance (m) of a point to the nearest capsule, and which one that is."""
    least, nearest = np.inf, -1
    for k in range(len(capsules)):
        ex, ey, ez = capsules[k, 3], capsules[k, 4], capsules[k, 5]
        gx, gy, gz = x - capsules[k, 0], y - capsules[k, 1], z - capsules[k, 2]
        share = (gx * ex + gy * ey + gz * ez) / (ex * ex + ey * ey + ez * ez)
        share = min(1.0, max(0.0, share))
        gx, gy, gz = gx - share * ex, gy - share * ey, gz - share * ez
        distance = np.sqrt(gx * gx + gy * gy + gz * gz) - capsules[k, 6]
        if distance < least:
            least, nearest = distance, k
    return least, nearest


@compiled
def _apart(x: float, y: float, z: float, there: Point) -> float:
    """Distance (m) between two points."""
    dx, dy, dz = x - there[0], y - there[1], z - there[2]
    return sqrt(dx * dx + dy * dy + dz * dz)


@compiled
def _draw_goal(draws: int, first: int, c: Constants) -> tuple[Point, bool]:
    """A goal, and whether the arm reaches it from far enough."""
    low, high = c.goal_low, c.goal_high
    x = low[0] + (high[0] - low[0]) * uniform(draws, first)
    y = low[1] + (high[1] - low[1]) * uniform(draws, first + 1)
    z = low[2] + (high[2] - low[2]) * uniform(draws, first + 2)
    away = _apart(x, y, z, c.hand) >= c.goal_min_distance
    # From the shoulder, with the hand held downwards.
    across, up = sqrt((x + 0.6) * (x + 0.6) + y * y) - 0.088, z - 0.121
    return (x, y, z), away and sqrt(across * across + up * up) <= c.reach


@compiled
def _draw_center(draws: int, first: int, goal: Point, radius: float, c: Constants) -> tuple[Point, bool]:
    """A place for the sphere, and whether it is in the box and off the goal."""
    hand = c.hand
    along = c.placed[0] + (c.placed[1] - c.placed[0]) * uniform(draws, first)
    x = hand[0] + along * (goal[0] - hand[0]) + c.max_offset * (2.0 * uniform(draws, first + 1) - 1.0)
    y = hand[1] + along * (goal[1] - hand[1]) + c.max_offset * (2.0 * uniform(draws, first + 2) - 1.0)
    z = hand[2] + along * (goal[2] - hand[2]) + c.max_offset * (2.0 * uniform(draws, first + 3) - 1.0)
    return (x, y, z), (not outside((x, y, z), c.rules)) and _apart(x, y, z, goal) >= radius + c.rules.goal_gap


@compiled
def _begin(
    keys: Whole, capsules: Array, c: Constants, goal: Array, sphere: Array, motion: Whole, clearance: Array
) -> bool:
    for b in range(len(keys)):
        draws, motion[b] = split(keys[b], 0), split(keys[b], 1)
        u, v, w = drawn_velocity(motion[b], 0, c.rules)
        needed = c.start_clearance + c.start_time * sqrt(u * u + v * v + w * w)
        found = False
        for attempt in range(_MOST):
            first = attempt * _SIZE
            there, fair = _draw_goal(draws, first, c)
            if not fair:
                continue
            radius = c.radius[0] + (c.radius[1] - c.radius[0]) * uniform(draws, first + 3)
            for place in range(_SPHERES):
                center, fair = _draw_center(draws, first + 4 * (place + 1), there, radius, c)
                if not fair:
                    continue
                distance, nearest = _nearest(center[0], center[1], center[2], capsules)
                if distance - radius < needed:
                    continue
                u, v, w = kept(center, (u, v, w), radius, there, c.rules)
                goal[b, 0], goal[b, 1], goal[b, 2] = there
                sphere[b, 0], sphere[b, 1], sphere[b, 2] = center
                sphere[b, 3], sphere[b, 4], sphere[b, 5], sphere[b, 6] = u, v, w, radius
                clearance[b, 0], clearance[b, 1] = distance - radius, nearest
                found = True
                break
            if found:
                break
        if not found:
            return False
    return True


@compiled
def _advance(sphere: Array, goal: Array, key: Whole, step: Whole, rules: Rules, moved: Array) -> None:
    for b in range(len(sphere)):
        u, v, w, radius = sphere[b, 3], sphere[b, 4], sphere[b, 5], sphere[b, 6]
        x, y, z = sphere[b, 0] + rules.dt * u, sphere[b, 1] + rules.dt * v, sphere[b, 2] + rules.dt * w
        there = goal[b, 0], goal[b, 1], goal[b, 2]
        counter = DRAWS * (step[b] + 1)
        u, v, w = next_velocity((x, y, z), (u, v, w), radius, there, key[b], counter, rules)
        moved[b, 0], moved[b, 1], moved[b, 2] = x, y, z
        moved[b, 3], moved[b, 4], moved[b, 5], moved[b, 6] = u, v, w, radius


def begin(keys: Whole, c: Constants) -> tuple[Array, Array, Whole, Array, Whole]:
    """Fair starts, one for each episode key, each a pure function of its key.

    Args:
        keys: of the episodes, (B,) int64.
        c: of `constants`.

    Returns:
        Goals (B, 3), readings of the spheres (B, 7) with the velocity of the coming step, keys of the spheres'
        motion (B,), and the clearance of the capsules (m) with the nearest one, (B,) each.

    Raises:
        ValueError: the parameters leave goal or sphere no room.
    """
    count = len(keys)
    goal, sphere, motion = np.empty((count, 3)), np.empty((count, 7)), np.empty(count, np.int64)
    clearance = np.empty((count, 2))
    if not _begin(keys, _CAPSULES, c, goal, sphere, motion, clearance):
        raise ValueError("no fair start found: these parameters leave goal or sphere no room")
    return goal, sphere, motion, clearance[:, 0].copy(), clearance[:, 1].astype(np.int64)


def advance(sphere: Array, goal: Array, key: Whole, step: Whole, rules: Rules) -> Array:
    """Readings (B, 7) of the spheres after one control step.

    Args:
        sphere: readings, the velocity that of this step, (B, 7).
        goal: what they keep off (m), (B, 3).
        key: of their motion, (B,).
        step: steps taken before this one, (B,).
        rules: of their motion.
    """
    moved = np.empty_like(sphere)
    _advance(sphere, goal, key, step, rules, moved)
    return moved

"""The batched vehicle, compiled: the dynamics of :mod:`rise_envs.vehicle_dynamics` on one CPU core.

Blocks of ``LANES`` vehicles are copied into rows of a scratch array, so that each loop over them becomes vector
instructions, and back. A block that is not full is filled up with copies of its last vehicle. Episodes start in
:mod:`rise_envs.vehicle_starts`.

Shapes: B batch, N discs.
"""

from __future__ import annotations

import itertools

import numpy as np
from numpy.typing import NDArray

from rise_envs import shared
from rise_envs.arithmetic import to_float, where
from rise_envs.compiled import compiled, inlined
from rise_envs.obstacles import DRAWS, next_velocity
from rise_envs.vehicle_dynamics import (
    Constants,
    clipped,
    drive,
    gap,
    packed,
    reward,
    swept_clearance,
    turn,
    unpacked,
)
from rise_envs.vehicle_starts import begin, restart
from rise_envs.vehicle_world import Outcome, World

__all__ = ["advance", "begin", "restart", "step_alone"]

Array = NDArray[np.float64]
Whole = NDArray[np.int64]
Flags = NDArray[np.bool_]

LANES = 32
_LARGE = 4_096  # rows
_PIECE = 128 * LANES  # rows that one thread takes at a time: waking it takes as long as some hundred
_row = np.uintp  # a row's number as the compiler likes it: one that cannot count from the end
_X, _Y, _THETA, _V, _OMEGA, _GX, _GY, _PX, _PY, _VX, _VY, _RADIUS, _LEAST = range(13)
_SIN, _COS, _AHEAD, _ASIDE = range(13, 17)


@compiled
def step_alone(
    now: Array, key: int, time: int, v: float, omega: float, numbers: Array, shown: Array
) -> tuple[float, float, bool]:
    """One step of one vehicle.

    Args:
        now: (x, y, θ, gx, gy) and the reading of each disc, (5 + 5N,); is moved on.
        key: of the discs' motion.
        time: steps taken so far.
        v: linear velocity (m/s).
        omega: angular velocity (rad/s).
        numbers: of `packed`.
        shown: receives (x, y, θ), (x, y), goal, readings after the step, and (x, y) before it, (9 + 5N,).

    Returns:
        The least clearance within the step, the reward, and whether the goal is reached.
    """
    c = unpacked(numbers)
    n_count = (len(now) - 5) // 5
    v, omega = clipped(v, c.v_min, c.v_max), clipped(omega, -c.omega_max, c.omega_max)
    x, y, theta, gx, gy, least = now[0], now[1], now[2], now[3], now[4], np.inf
    shown[5], shown[6] = gx, gy
    way = turn(theta, omega, c.dt)
    for n in range(n_count):
        d = 5 + 5 * n
        px, py, u, w, radius = now[d], now[d + 1], now[d + 2], now[d + 3], now[d + 4]
        near = swept_clearance((x, y, theta), v, omega, way, (px, py, u, w, radius), c.dt, c.robot_radius)
        least = where(near < least, near, least)
        px, py = px + c.dt * u, py + c.dt * w
        counter = DRAWS * ((time + 1) * n_count + n)
        u, w, _ = next_velocity((px, py, 0.0), (u, w, 0.0), radius, (gx, gy, 0.0), key, counter, c.rules)
        now[d], now[d + 1], now[d + 2], now[d + 3] = px, py, u, w
        shown[d + 2], shown[d + 3], shown[d + 4], shown[d + 5], shown[d + 6] = px, py, u, w, radius
    before = gap(x, y, gx, gy)
    shown[-2], shown[-1] = x, y
    x, y, theta = drive((x, y, theta), v, omega, way, c.dt)
    after = gap(x, y, gx, gy)
    reached = after <= c.goal_radius
    now[0], now[1], now[2] = x, y, theta
    shown[0], shown[1], shown[2], shown[3], shown[4] = x, y, theta, x, y
    return least, reward(before, after, reached, c), reached


@inlined
def aligned(rows: int) -> Array:
    """Scratch (rows, LANES) that begins at a line of the cache: no vector of a row lies across two."""
    room = np.empty(rows * LANES + 8)
    first = -(room.ctypes.data // 8) % 8
    return room[first : first + rows * LANES].reshape((rows, LANES))


@inlined
def _pass_discs(
    start: int, count: int, w: Array, disc: Array, key: Whole, time: Whole, obstacle: Array, c: Constants
) -> None:
    """Clearances of a block of vehicles, and their discs moved on: ``count`` rows of the batch from ``start``."""
    n_count, keys, counters = disc.shape[1], np.empty(LANES, np.int64), np.empty(LANES, np.int64)
    for n in range(n_count):
        for m in range(LANES):
            b = _row(start + min(m, count - 1))
            w[_PX, m], w[_PY, m], w[_RADIUS, m] = disc[b, n, 0], disc[b, n, 1], disc[b, n, 4]
            w[_VX, m], w[_VY, m] = disc[b, n, 2], disc[b, n, 3]
            keys[m], counters[m] = key[b], DRAWS * ((time[b] + 1) * n_count + n)
        for m in range(LANES):
            this = (w[_PX, m], w[_PY, m], w[_VX, m], w[_VY, m], w[_RADIUS, m])
            pose = (w[_X, m], w[_Y, m], w[_THETA, m])
            way = (w[_SIN, m], w[_COS, m], w[_AHEAD, m], w[_ASIDE, m])
            near = swept_clearance(pose, w[_V, m], w[_OMEGA, m], way, this, c.dt, c.robot_radius)
            w[_LEAST, m] = where(near < w[_LEAST, m], near, w[_LEAST, m])
        for m in range(LANES):
            u, v = w[_VX, m], w[_VY, m]
            px, py = w[_PX, m] + c.dt * u, w[_PY, m] + c.dt * v
            there, place = (w[_GX, m], w[_GY, m], 0.0), (px, py, 0.0)
            u, v, _ = next_velocity(place, (u, v, 0.0), w[_RADIUS, m], there, keys[m], counters[m], c.rules)
            w[_PX, m], w[_PY, m], w[_VX, m], w[_VY, m] = px, py, u, v
        for m in range(count):
            b = _row(start + m)
            px, py, u, v, radius = w[_PX, m], w[_PY, m], w[_VX, m], w[_VY, m], w[_RADIUS, m]
            disc[b, n, 0], disc[b, n, 1], disc[b, n, 2], disc[b, n, 3] = px, py, u, v
            obstacle[b, n, 0], obstacle[b, n, 1], obstacle[b, n, 2], obstacle[b, n, 3] = px, py, u, v
            obstacle[b, n, 4] = radius


@compiled
def _advance(
    first: int,
    last: int,
    state: Array,
    goal: Array,
    disc: Array,
    key: Whole,
    time: Whole,
    action: Array,
    numbers: Array,
    limit: int,
    on_collision: bool,
    seen: Array,
    achieved: Array,
    shown_goal: Array,
    obstacle: Array,
    previous: Array,
    clearance: Array,
    cost: Array,
    rewards: Array,
    reached: Flags,
    terminated: Flags,
    truncated: Flags,
) -> None:
    """Rows ``first`` to ``last`` of `advance`; from ``seen`` on the parts of the outcome."""
    c, w = unpacked(numbers), aligned(17)
    for start in range(first, last, LANES):
        count = min(LANES, last - start)
        for m in range(LANES):
            b = _row(start + min(m, count - 1))
            w[_X, m], w[_Y, m], w[_THETA, m] = state[b, 0], state[b, 1], state[b, 2]
            w[_GX, m], w[_GY, m], w[_LEAST, m] = goal[b, 0], goal[b, 1], np.inf
            w[_V, m], w[_OMEGA, m] = action[b, 0], action[b, 1]
        for m in range(LANES):
            w[_V, m] = clipped(w[_V, m], c.v_min, c.v_max)
            w[_OMEGA, m] = clipped(w[_OMEGA, m], -c.omega_max, c.omega_max)
            sin, cos, ahead, aside = turn(w[_THETA, m], w[_OMEGA, m], c.dt)
            w[_SIN, m], w[_COS, m], w[_AHEAD, m], w[_ASIDE, m] = sin, cos, ahead, aside
        _pass_discs(start, count, w, disc, key, time, obstacle, c)
        for m in range(count):
            b = _row(start + m)
            previous[b, 0], previous[b, 1] = w[_X, m], w[_Y, m]
        for m in range(LANES):
            x, y, theta, gx, gy = w[_X, m], w[_Y, m], w[_THETA, m], w[_GX, m], w[_GY, m]
            before = gap(x, y, gx, gy)
            way = (w[_SIN, m], w[_COS, m], w[_AHEAD, m], w[_ASIDE, m])
            x, y, theta = drive((x, y, theta), w[_V, m], w[_OMEGA, m], way, c.dt)
            after = gap(x, y, gx, gy)
            arrived = after <= c.goal_radius
            w[_X, m], w[_Y, m], w[_THETA, m] = x, y, theta
            w[_V, m], w[_OMEGA, m] = reward(before, after, arrived, c), to_float(arrived)
        for m in range(count):
            b = _row(start + m)
            x, y, theta, least, arrived = w[_X, m], w[_Y, m], w[_THETA, m], w[_LEAST, m], w[_OMEGA, m] > 0.0
            state[b, 0], state[b, 1], state[b, 2] = x, y, theta
            seen[b, 0], seen[b, 1], seen[b, 2] = x, y, theta
            achieved[b, 0], achieved[b, 1] = x, y
            shown_goal[b, 0], shown_goal[b, 1] = w[_GX, m], w[_GY, m]
            clearance[b], cost[b], rewards[b] = least, to_float(least < 0.0), w[_V, m]
            reached[b], terminated[b] = arrived, arrived or (on_collision and least < 0.0)
            time[b] += 1
            truncated[b] = time[b] >= limit


def _outcome(b_count: int, n_count: int) -> Outcome:
    """An outcome to be filled in.

    Of many large pieces of memory the system takes some back after every step, which costs as much as the step
    itself: those of a large batch are parts of one.
    """
    widths, flags = (3, 2, 2, 5 * n_count, 2), np.empty((3, b_count), np.bool_)
    if b_count < _LARGE:
        tables = [np.empty((b_count, width)) for width in widths]
        return Outcome(*tables, *(np.empty(b_count) for _ in range(3)), *flags)
    floats = np.empty((sum(widths) + 3) * b_count)
    *ends, _ = (b_count * total for total in itertools.accumulate((*widths, 1, 1, 1)))
    parts = np.split(floats, ends)
    return Outcome(*(part.reshape(b_count, -1) for part in parts[:5]), *parts[5:], *flags)


def advance(
    world: World, action: Array, c: Constants, limit: int, on_collision: bool, threads: int = 1
) -> Outcome:
    """One step of B vehicles.

    Args:
        world: is moved on, in place.
        action: (v, ω), (B, 2).
        c: the task.
        limit: steps after which an episode is truncated.
        on_collision: whether an overlap terminates the episode.
        threads: that share the rows.
    """
    shown = _outcome(*world.disc.shape[:2])
    arguments = (
        *(world.state, world.goal, world.disc, world.key, world.step, action, packed(c), limit, on_collision),
        *(*shown[:3], shown.obstacle.reshape(world.disc.shape), *shown[4:]),
    )
    shared.run(lambda first, last: _advance(first, last, *arguments), len(action), threads, _PIECE)
    return shown

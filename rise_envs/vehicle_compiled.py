"""The batched vehicle, compiled: the dynamics of :mod:`rise_envs.vehicle_dynamics` on one CPU core.

Blocks of ``LANES`` vehicles are copied into rows of a scratch array, so that each loop over them becomes vector
instructions, and back. A block that is not full is filled up with copies of its last vehicle.

Shapes: B batch, N discs.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rise_envs.arithmetic import split, to_float, where
from rise_envs.compiled import compiled
from rise_envs.obstacles import DRAWS, next_velocity
from rise_envs.vehicle_dynamics import (
    DISC_DRAWS,
    MAX_ATTEMPTS,
    PLACE_DRAWS,
    Constants,
    clipped,
    drive,
    gap,
    placed,
    placed_disc,
    reward,
    swept_clearance,
)

Array = NDArray[np.float64]
Whole = NDArray[np.int64]

LANES = 16
_X, _Y, _THETA, _V, _OMEGA, _GX, _GY, _PX, _PY, _VX, _VY, _RADIUS, _LEAST = range(13)


@compiled
def step(
    state: Array, goal: Array, disc: Array, key: Whole, time: Whole, action: Array, c: Constants
) -> tuple[Array, Array, Array, Array, NDArray[np.bool_]]:
    """One step of B vehicles.

    Args:
        state: (x, y, θ), (B, 3).
        goal: (B, 2).
        disc: (px, py, vx, vy, r), (B, N, 5).
        key: of the discs' motion, (B,).
        time: steps taken so far, (B,).
        action: (v, ω), (B, 2).
        c: the task.

    Returns:
        The states and discs after the step, the least clearance within it (B,), the reward (B,), and whether
        the goal is reached (B,).
    """
    b_count, n_count = disc.shape[0], disc.shape[1]
    new_state, new_disc = np.empty_like(state), np.empty_like(disc)
    clearance, rewards, reached = np.empty(b_count), np.empty(b_count), np.empty(b_count, np.bool_)
    w, keys, counters = np.empty((13, LANES)), np.empty(LANES, np.int64), np.empty(LANES, np.int64)
    for first in range(0, b_count, LANES):
        count = min(LANES, b_count - first)
        for m in range(LANES):
            b = first + min(m, count - 1)
            w[_X, m], w[_Y, m], w[_THETA, m] = state[b, 0], state[b, 1], state[b, 2]
            w[_GX, m], w[_GY, m] = goal[b, 0], goal[b, 1]
            w[_V, m], w[_OMEGA, m], w[_LEAST, m], keys[m] = action[b, 0], action[b, 1], np.inf, key[b]
        for m in range(LANES):
            w[_V, m] = clipped(w[_V, m], c.v_min, c.v_max)
            w[_OMEGA, m] = clipped(w[_OMEGA, m], -c.omega_max, c.omega_max)
        for n in range(n_count):
            for m in range(LANES):
                b = first + min(m, count - 1)
                w[_PX, m], w[_PY, m], w[_RADIUS, m] = disc[b, n, 0], disc[b, n, 1], disc[b, n, 4]
                w[_VX, m], w[_VY, m] = disc[b, n, 2], disc[b, n, 3]
                counters[m] = DRAWS * ((time[b] + 1) * n_count + n)
            for m in range(LANES):
                this = (w[_PX, m], w[_PY, m], w[_VX, m], w[_VY, m], w[_RADIUS, m])
                pose = (w[_X, m], w[_Y, m], w[_THETA, m])
                near = swept_clearance(pose, w[_V, m], w[_OMEGA, m], this, c.dt, c.robot_radius)
                w[_LEAST, m] = where(near < w[_LEAST, m], near, w[_LEAST, m])
            for m in range(LANES):
                u, v = w[_VX, m], w[_VY, m]
                px, py = w[_PX, m] + c.dt * u, w[_PY, m] + c.dt * v
                goal_there, place = (w[_GX, m], w[_GY, m], 0.0), (px, py, 0.0)
                u, v, _ = next_velocity(
                    place, (u, v, 0.0), w[_RADIUS, m], goal_there, keys[m], counters[m], c.rules
                )
                w[_PX, m], w[_PY, m], w[_VX, m], w[_VY, m] = px, py, u, v
            for m in range(count):
                b = first + m
                new_disc[b, n, 0], new_disc[b, n, 1], new_disc[b, n, 4] = w[_PX, m], w[_PY, m], w[_RADIUS, m]
                new_disc[b, n, 2], new_disc[b, n, 3] = w[_VX, m], w[_VY, m]
        for m in range(LANES):
            x, y, theta, gx, gy = w[_X, m], w[_Y, m], w[_THETA, m], w[_GX, m], w[_GY, m]
            before = gap(x, y, gx, gy)
            x, y, theta = drive((x, y, theta), w[_V, m], w[_OMEGA, m], c.dt)
            after = gap(x, y, gx, gy)
            there = after <= c.goal_radius
            w[_X, m], w[_Y, m], w[_THETA, m] = x, y, theta
            w[_V, m], w[_OMEGA, m] = reward(before, after, there, c), to_float(there)
        for m in range(count):
            b = first + m
            new_state[b, 0], new_state[b, 1], new_state[b, 2] = w[_X, m], w[_Y, m], w[_THETA, m]
            clearance[b], rewards[b], reached[b] = w[_LEAST, m], w[_V, m], w[_OMEGA, m] > 0.0
    return new_state, new_disc, clearance, rewards, reached


@compiled
def begin(keys: Whole, n_count: int, c: Constants) -> tuple[Array, Array, Array, Whole, bool]:
    """Fair starts, one for each episode key (B,): states, goals, discs, keys of motion, and whether all are fair."""
    b_count = len(keys)
    state, goal, disc = np.empty((b_count, 3)), np.empty((b_count, 2)), np.empty((b_count, n_count, 5))
    size = PLACE_DRAWS + DISC_DRAWS * n_count
    motion_keys = np.empty(b_count, np.int64)
    for b in range(b_count):
        draws, motion_keys[b] = split(keys[b], 0), split(keys[b], 1)
        for attempt in range(MAX_ATTEMPTS):
            x, y, theta, gx, gy, distance, cos, sin, valid = placed(draws, attempt * size, c)
            for n in range(n_count):
                if not valid:
                    break
                counter = attempt * size + PLACE_DRAWS + DISC_DRAWS * n
                px, py, u, v, r, valid = placed_disc(draws, counter, (x, y), (gx, gy), (distance, cos, sin), c)
                disc[b, n, 0], disc[b, n, 1], disc[b, n, 2], disc[b, n, 3], disc[b, n, 4] = px, py, u, v, r
            if valid:
                break
        else:
            return state, goal, disc, motion_keys, False
        state[b, 0], state[b, 1], state[b, 2], goal[b, 0], goal[b, 1] = x, y, theta, gx, gy
    return state, goal, disc, motion_keys, True

"""The batched vehicle on the arrays of any library: the same dynamics, on any device of torch.

Shapes: B batch, N discs. The functions are those of :mod:`rise_envs.vehicle_compiled`, bit for bit.
"""

from __future__ import annotations

from typing import Any

from array_api_compat import array_namespace

from rise_envs.arithmetic import split
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

Array = Any


def step(
    state: Array, goal: Array, disc: Array, key: Array, time: Array, action: Array, c: Constants
) -> tuple[Array, Array, Array, Array, Array]:
    """One step of B vehicles: see :func:`rise_envs.vehicle_compiled.step`."""
    xp = array_namespace(state)
    pose = x, y, theta = state[:, 0], state[:, 1], state[:, 2]
    goal_x, goal_y = goal[:, 0], goal[:, 1]
    v = clipped(action[:, 0], c.v_min, c.v_max)
    omega = clipped(action[:, 1], -c.omega_max, c.omega_max)

    clearance, discs, n_count = None, [], disc.shape[1]
    for n in range(n_count):
        px, py, u, w, radius = (disc[:, n, i] for i in range(5))
        near = swept_clearance(pose, v, omega, (px, py, u, w, radius), c.dt, c.robot_radius)
        clearance = near if clearance is None else xp.where(near < clearance, near, clearance)
        px, py, flat = px + c.dt * u, py + c.dt * w, 0.0 * px
        there, counter = (goal_x, goal_y, 0.0), DRAWS * ((time + 1) * n_count + n)
        u, w, _ = next_velocity((px, py, flat), (u, w, flat), radius, there, key, counter, c.rules)
        discs.append(xp.stack((px, py, u, w, radius), axis=-1))

    before = gap(x, y, goal_x, goal_y)
    pose = x, y, theta = drive(pose, v, omega, c.dt)
    after = gap(x, y, goal_x, goal_y)
    reached = after <= c.goal_radius
    rewards = reward(before, after, reached, c)
    return xp.stack(pose, axis=-1), xp.stack(discs, axis=1), clearance, rewards, reached


def _propose(draws: Array, attempt: int, n_count: int, c: Constants) -> tuple[Array, Array, Array, Array]:
    """One candidate start per key: states, goals, discs, and which candidates are valid."""
    xp, first = array_namespace(draws), attempt * (PLACE_DRAWS + DISC_DRAWS * n_count)
    x, y, theta, goal_x, goal_y, distance, cos, sin, valid = placed(draws, first, c)
    discs = []
    for n in range(n_count):
        counter = first + PLACE_DRAWS + DISC_DRAWS * n
        *disc, fair = placed_disc(draws, counter, (x, y), (goal_x, goal_y), (distance, cos, sin), c)
        discs.append(xp.stack(disc, axis=-1))
        valid = valid & fair
    return (
        xp.stack((x, y, theta), axis=-1),
        xp.stack((goal_x, goal_y), axis=-1),
        xp.stack(discs, axis=1),
        valid,
    )


def begin(keys: Array, n_count: int, c: Constants) -> tuple[Array, Array, Array, Array, bool]:
    """Fair starts, one for each episode key (B,): see :func:`rise_envs.vehicle_compiled.begin`."""
    draws = split(keys, 0)
    state, goal, disc, valid = _propose(draws, 0, n_count, c)
    for attempt in range(1, MAX_ATTEMPTS):
        if valid.all():
            break
        missing = ~valid
        state[missing], goal[missing], disc[missing], valid[missing] = _propose(
            draws[missing], attempt, n_count, c
        )
    return state, goal, disc, split(keys, 1), bool(valid.all())

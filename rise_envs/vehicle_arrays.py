"""The batched vehicle on the arrays of any library: the same dynamics, on any device of torch.

Shapes: B batch, N discs. The functions are those of :mod:`rise_envs.vehicle_compiled`, bit for bit.
"""

from __future__ import annotations

from typing import Any

from array_api_compat import array_namespace

from rise_envs.arithmetic import mix, split, to_float
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
    turn,
)
from rise_envs.vehicle_world import Outcome, World, check_fair, copied

Array = Any


def advance(
    world: World, action: Array, c: Constants, limit: int, on_collision: bool, threads: int = 1
) -> Outcome:
    """One step of B vehicles: see :func:`rise_envs.vehicle_compiled.advance`."""
    state, goal, disc = world.state, world.goal, world.disc
    xp = array_namespace(state)
    x, y, theta = state[:, 0], state[:, 1], state[:, 2]
    pose, goal_x, goal_y = (x, y, theta), goal[:, 0], goal[:, 1]
    v = clipped(action[:, 0], c.v_min, c.v_max)
    omega = clipped(action[:, 1], -c.omega_max, c.omega_max)
    way = turn(theta, omega, c.dt)

    clearance: Array = None
    discs, n_count = [], disc.shape[1]
    for n in range(n_count):
        px, py, u, w, radius = (disc[:, n, i] for i in range(5))
        near = swept_clearance(pose, v, omega, way, (px, py, u, w, radius), c.dt, c.robot_radius)
        clearance = near if clearance is None else xp.where(near < clearance, near, clearance)
        px, py, flat = px + c.dt * u, py + c.dt * w, 0.0 * px
        there, counter = (goal_x, goal_y, 0.0), DRAWS * ((world.step + 1) * n_count + n)
        u, w, _ = next_velocity((px, py, flat), (u, w, flat), radius, there, world.key, counter, c.rules)
        discs.append(xp.stack((px, py, u, w, radius), axis=-1))

    before = gap(x, y, goal_x, goal_y)
    x, y, theta = drive(pose, v, omega, way, c.dt)
    after = gap(x, y, goal_x, goal_y)
    reached, hit = after <= c.goal_radius, clearance < 0.0
    world.state, world.disc = xp.stack((x, y, theta), axis=-1), xp.stack(discs, axis=1)
    world.step = world.step + 1
    return Outcome(
        state=copied(world.state),
        achieved=copied(world.state[:, :2]),
        goal=copied(goal),
        obstacle=copied(world.disc).reshape(len(state), -1),
        previous=copied(state[:, :2]),
        clearance=clearance,
        cost=to_float(hit),
        reward=reward(before, after, reached, c),
        reached=reached,
        terminated=reached | hit if on_collision else copied(reached),
        truncated=world.step >= limit,
    )


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


def begin(
    base: Array, number: Array, n_count: int, c: Constants
) -> tuple[Array, Array, Array, Array, Array, bool]:
    """Fair starts of episodes: see :func:`rise_envs.vehicle_compiled.begin`."""
    keys = mix(base, number)
    draws = split(keys, 0)
    state, goal, disc, valid = _propose(draws, 0, n_count, c)
    for attempt in range(1, MAX_ATTEMPTS):
        if valid.all():
            break
        missing = ~valid
        state[missing], goal[missing], disc[missing], valid[missing] = _propose(
            draws[missing], attempt, n_count, c
        )
    x, y, discs = state[:, 0, None], state[:, 1, None], (disc[..., i] for i in (0, 1, 4))
    px, py, radius = discs
    clearance = array_namespace(state).min(gap(x, y, px, py) - radius - c.robot_radius, axis=-1)
    return state, goal, disc, split(keys, 1), clearance, bool(valid.all())


def restart(
    world: World, shown: Outcome, rows: Array, base: Array, number: Array, c: Constants, threads: int = 1
) -> None:
    """Start episodes in some rows, in place: see :func:`rise_envs.vehicle_compiled.restart`."""
    state, goal, disc, key, clearance, fair = begin(base, number, world.disc.shape[1], c)
    check_fair(fair, world.disc.shape[1], c)
    world.state[rows], world.goal[rows], world.disc[rows], world.key[rows] = state, goal, disc, key
    world.step[rows] = 0
    shown.state[rows], shown.goal[rows], shown.obstacle[rows] = state, goal, disc.reshape(len(rows), -1)
    shown.achieved[rows] = shown.previous[rows] = state[:, :2]
    shown.clearance[rows], shown.cost[rows], shown.reward[rows] = clearance, to_float(clearance < 0.0), 0.0
    shown.reached[rows] = shown.terminated[rows] = shown.truncated[rows] = False  # no start is at its goal

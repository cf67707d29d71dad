"""Where the vehicles' episodes start, compiled: fair starts, alone and into a batch that is under way.

Shapes: B batch, N discs, K rows of the batch.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rise_envs import shared
from rise_envs.arithmetic import mix, split, to_float, where
from rise_envs.compiled import compiled, inlined
from rise_envs.vehicle_dynamics import (
    DISC_DRAWS,
    MAX_ATTEMPTS,
    PLACE_DRAWS,
    Constants,
    gap,
    packed,
    placed,
    placed_disc,
    unpacked,
)
from rise_envs.vehicle_world import Outcome, World, check_fair

Array = NDArray[np.float64]
Whole = NDArray[np.int64]
Flags = NDArray[np.bool_]

_PIECE = 256  # rows that one thread takes at a time


@inlined
def _begin(
    base: int, number: int, disc: Array, c: Constants
) -> tuple[float, float, float, float, float, int, float]:
    """A fair start: (x, y, θ), goal, key of the discs' motion and clearance; ``disc`` (N, 5) receives the discs.

    The clearance is −∞ where none was found.
    """
    n_count, key = len(disc), mix(base, number)
    draws, size = split(key, 0), PLACE_DRAWS + DISC_DRAWS * n_count
    x, y, theta, gx, gy, least = 0.0, 0.0, 0.0, 0.0, 0.0, -np.inf
    for attempt in range(MAX_ATTEMPTS):
        x, y, theta, gx, gy, distance, cos, sin, valid = placed(draws, attempt * size, c)
        least = np.inf
        for n in range(n_count):
            if not valid:
                break
            counter = attempt * size + PLACE_DRAWS + DISC_DRAWS * n
            px, py, u, v, r, valid = placed_disc(draws, counter, (x, y), (gx, gy), (distance, cos, sin), c)
            disc[n, 0], disc[n, 1], disc[n, 2], disc[n, 3], disc[n, 4] = px, py, u, v, r
            near = gap(x, y, px, py) - r - c.robot_radius
            least = where(near < least, near, least)
        if valid:
            break
        least = -np.inf
    return x, y, theta, gx, gy, split(key, 1), least


@compiled
def begin(
    base: Whole, number: Whole, n_count: int, c: Constants
) -> tuple[Array, Array, Array, Whole, Array, bool]:
    """Fair starts of the episodes with the given numbers of streams with the given bases, (B,) each.

    Returns:
        States, goals, discs, keys of the discs' motion, clearances (B,), and whether all are fair.
    """
    b_count = len(base)
    state, goal, disc = np.empty((b_count, 3)), np.empty((b_count, 2)), np.empty((b_count, n_count, 5))
    motion, clearance = np.empty(b_count, np.int64), np.empty(b_count)
    for b in range(b_count):
        x, y, theta, gx, gy, motion[b], clearance[b] = _begin(base[b], number[b], disc[b], c)
        state[b, 0], state[b, 1], state[b, 2], goal[b, 0], goal[b, 1] = x, y, theta, gx, gy
        if clearance[b] == -np.inf:
            return state, goal, disc, motion, clearance, False
    return state, goal, disc, motion, clearance, True


@compiled
def _restart(
    first: int,
    last: int,
    rows: Whole,
    base: Whole,
    number: Whole,
    numbers: Array,
    state: Array,
    goal: Array,
    disc: Array,
    key: Whole,
    time: Whole,
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
) -> bool:
    """Numbers ``first`` to ``last`` of `restart`; from ``seen`` on the parts of the outcome.

    Returns:
        Whether all starts are fair.
    """
    c = unpacked(numbers)
    for i in range(first, last):
        b = rows[i]
        x, y, theta, gx, gy, key[b], least = _begin(base[i], number[i], disc[b], c)
        if least == -np.inf:
            return False
        state[b, 0], state[b, 1], state[b, 2], goal[b, 0], goal[b, 1], time[b] = x, y, theta, gx, gy, 0
        seen[b, 0], seen[b, 1], seen[b, 2], shown_goal[b, 0], shown_goal[b, 1] = x, y, theta, gx, gy
        achieved[b, 0], achieved[b, 1], previous[b, 0], previous[b, 1] = x, y, x, y
        obstacle[b] = disc[b]
        clearance[b], cost[b], rewards[b] = least, to_float(least < 0.0), 0.0
        reached[b] = terminated[b] = truncated[b] = False  # no start is at its goal
    return True


def restart(
    world: World, shown: Outcome, rows: Whole, base: Whole, number: Whole, c: Constants, threads: int = 1
) -> None:
    """Start episodes in some rows, in place: of the world, and of what is shown.

    Args:
        world: B episodes.
        shown: what a step, or nothing, left in the other rows.
        rows: which, (K,).
        base: of the streams that they come from, (K,).
        number: of the episodes, (K,).
        c: the task.
        threads: that share the rows.

    Raises:
        ValueError: the parameters leave no room for a fair start.
    """
    arguments = (
        *(rows, base, number, packed(c), world.state, world.goal, world.disc, world.key, world.step),
        *(*shown[:3], shown.obstacle.reshape(world.disc.shape), *shown[4:]),
    )
    fair = shared.run(lambda first, last: _restart(first, last, *arguments), len(rows), threads, _PIECE)
    check_fair(all(fair), world.disc.shape[1], c)

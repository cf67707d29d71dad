"""The motors of many Panda arms in one substep, in the lanes of :mod:`rise_envs.panda_lanes`.

Their impulses solve a boxed linear complementarity problem, in Bullet by 50 Gauss-Seidel sweeps, to and fro through
the motors in the order that its sorting leaves them. For the nearly parallel joints 0 and 2 the sweeps do not
converge. Here the coupled pairs (0, 2) and (1, 3) are solved together, and stopped short where Bullet's sweeps
would be.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from rise_envs.panda_bounds import HELD, LACK, N_SCRATCH, TABLE, hold, press
from rise_envs.panda_bounds import OTHER as _OTHER
from rise_envs.panda_bounds import PUSH as _PUSH
from rise_envs.panda_lanes import LANES, ONE, REAL, ZERO, Lanes, N, fixed, lane

DT = 0.002  # s, a substep
_SWEEPS = 5
_DT, _GAIN = REAL(DT), REAL(0.1 / DT)
_IMPULSE = np.array([87.0, 87.0, 87.0, 87.0, 12.0, 120.0, 120.0])  # N m, panda-gym's torque limits
_LIMIT = (DT * _IMPULSE).astype(REAL)

# Rows of the scratch `s`: the motors' impulses come first; for the others see :mod:`rise_envs.panda_bounds`.
_ANCHOR = 2 * N + 2
# Rows of the gains: 1 / inverse[j, j], then for each pair 1 / determinant and what is left of a gap at the end.
_DET, _LEFT = N, N + 2
N_GAINS = N + 4


@njit(inline="always")
def _write_pair(i: int, j: int, pair: int, inverse: Lanes, gains: Lanes) -> None:
    for m in range(LANES):
        a, c, d = inverse[i, i, m], inverse[i, j, m], inverse[j, j, m]
        rho = c * c / (a * d)
        rho2 = rho * rho
        rho8 = rho2 * rho2 * rho2 * rho2
        gains[_DET + pair, m] = ONE / (a * d - c * c)
        gains[_LEFT + pair, m] = rho8 * rho8 * rho8


@lane
def write_gains(inverse: Lanes, gains: Lanes) -> None:
    """What `motors` needs of the ``inverse`` (7, 7, L) of the mass matrix, (N_GAINS, L)."""
    inverse, gains = fixed(inverse, (N, N, LANES)), fixed(gains, (N_GAINS, LANES))
    for i in range(N):
        for m in range(LANES):
            gains[i, m] = ONE / inverse[i, i, m]
    _write_pair(1, 3, 0, inverse, gains)
    _write_pair(0, 2, 1, inverse, gains)


@njit(inline="always")
def _spread(j: int, row: int, inverse: Lanes, s: Lanes) -> None:
    """Let the push of motor ``j`` in the given row act on all joints."""
    for m in range(LANES):
        push = s[row, m]
        for i in range(N):
            s[LACK + i, m] -= inverse[j, i, m] * push


@njit(inline="always")
def _pull(j: int, inverse: Lanes, gains: Lanes, s: Lanes) -> None:
    """Let motor ``j`` alone make up for what it lacks."""
    limit = _LIMIT[j]
    for m in range(LANES):
        before = s[j, m]
        after = min(limit, max(-limit, before + s[LACK + j, m] * gains[j, m]))
        s[j, m], s[_PUSH, m] = after, after - before
    _spread(j, _PUSH, inverse, s)


@njit(inline="always")
def _pull_pair(i: int, j: int, pair: int, first: bool, inverse: Lanes, gains: Lanes, s: Lanes) -> None:
    """Let two coupled motors make up for what they lack, as far as Bullet's sweeps would.

    Alone, the sweeps set them right in turn, 51 times. After the first turn of motor ``j``, kept in the row
    ``_ANCHOR + pair``, its distance from the solution shrinks by ρ in each of the 24 that follow.
    """
    limit_i, limit_j = _LIMIT[i], _LIMIT[j]
    for m in range(LANES):
        a, c, d = inverse[i, i, m], inverse[i, j, m], inverse[j, j, m]
        per_a, per_d = gains[i, m], gains[j, m]
        x, y = s[i, m], s[j, m]
        need_i, need_j = s[LACK + i, m] + a * x + c * y, s[LACK + j, m] + c * x + d * y
        start = min(limit_i, max(-limit_i, need_i * per_a))
        start = min(limit_j, max(-limit_j, (need_j - c * start) * per_d))
        start = start if first else s[_ANCHOR + pair, m]
        s[_ANCHOR + pair, m] = start
        free_j = (a * need_j - c * need_i) * gains[_DET + pair, m]
        free_i = (need_i - c * free_j) * per_a
        held_i = min(limit_i, max(-limit_i, free_i))
        slow = free_j + gains[_LEFT + pair, m] * (start - free_j)
        after_j = slow if held_i == free_i else (need_j - c * held_i) * per_d
        after_j = min(limit_j, max(-limit_j, after_j))
        after_i = min(limit_i, max(-limit_i, (need_i - c * after_j) * per_a))
        s[_PUSH, m], s[j, m] = after_j - y, after_j
        s[_OTHER, m], s[i, m] = after_i - x, after_i
    _spread(j, _PUSH, inverse, s)
    _spread(i, _OTHER, inverse, s)


@lane
def motors(inverse: Lanes, gains: Lanes, low: bool, narrow: bool, bounds: Lanes, s: Lanes) -> None:
    """The motors, and what stops the arm, in one substep.

    Args:
        inverse: of the mass matrix, (7, 7, L).
        gains: of `write_gains`, (N_GAINS, L).
        low: whether an arm is near the table.
        narrow: whether an arm is near a joint limit.
        bounds: scratch of :mod:`rise_envs.panda_bounds`, (N_BOUNDS, L).
        s: holds what the joint velocities lack, and receives what they lack still, (N_SCRATCH, L).
    """
    inverse, gains = fixed(inverse, (N, N, LANES)), fixed(gains, (N_GAINS, LANES))
    s = fixed(s, (N_SCRATCH, LANES))
    for m in range(LANES):
        for i in range(N):
            s[i, m], s[HELD + i, m] = ZERO, ZERO
        for r in range(3):
            s[TABLE + r, m] = ZERO
    for sweep in range(_SWEEPS):
        for j in range(6, 3, -1):
            _pull(j, inverse, gains, s)
        _pull_pair(1, 3, 0, sweep == 0, inverse, gains, s)
        _pull_pair(0, 2, 1, sweep == 0, inverse, gains, s)
        if narrow:
            hold(inverse, gains, bounds, s)
        if low:
            press(bounds, s)


@lane
def write_lack(aim: Lanes, q: Lanes, free: Lanes, speed: Lanes, s: Lanes) -> None:
    """What the joint velocities lack before the motors act; ``speed`` receives what the motors pull to."""
    aim, q, free = fixed(aim, (N, LANES)), fixed(q, (N, LANES)), fixed(free, (N, LANES))
    speed, s = fixed(speed, (N, LANES)), fixed(s, (N_SCRATCH, LANES))
    for i in range(N):
        for m in range(LANES):
            wanted = _GAIN * (aim[i, m] - q[i, m])
            s[LACK + i, m] = wanted - speed[i, m] - _DT * free[i, m]
            speed[i, m] = wanted


@lane
def go(s: Lanes, speed: Lanes, q: Lanes, change: Lanes) -> None:
    """End a substep: what was wanted less what it still lacks is the speed, and the joints turn."""
    s, speed = fixed(s, (N_SCRATCH, LANES)), fixed(speed, (N, LANES))
    q, change = fixed(q, (N, LANES)), fixed(change, (N, LANES))
    for i in range(N):
        for m in range(LANES):
            speed[i, m] -= s[LACK + i, m]
            q[i, m] += _DT * speed[i, m]
            change[i, m] += _DT * speed[i, m]

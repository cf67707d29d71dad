"""What stops many Panda arms, in the lanes of :mod:`rise_envs.panda_lanes`: the table, and the limits of the joints.

In Bullet both are rows of the problem that the motors' impulses solve (:mod:`rise_envs.panda_motors`). The finger tips
stand on the table as on a spring and a damper, with friction in a cone; only they do. A joint at its limit is held by
whatever impulse it takes. Where nothing is near, all impulses here are exactly zero.
"""

from __future__ import annotations

import numpy as np

from rise_envs import panda_kinematics as panda
from rise_envs.panda_lanes import LANES, ONE, REAL, ZERO, Lanes, N, fixed, lane

_DT = 0.002  # s, a substep
_STIFFNESS, _DAMPING = 2 * 30_000.0, 2 * 1_000.0  # N/m and N s/m, of the URDF's two fingers
_FRICTION = REAL(0.5)
_SOFT = REAL(1.0 / (_DT * (_DAMPING + _DT * _STIFFNESS)))  # m/s that the table gives way per N s
_PUSH_OUT = REAL(_STIFFNESS / (_DAMPING + _DT * _STIFFNESS))  # m/s per m of depth
_PER_DT = REAL(1.0 / _DT)
# The lowest point of the fingers below the hand point, fitted to the engine's contacts to 0.7 mm: along the hand's
# axis, and across it where the hand is tilted (m).
_TIP, _EDGE = REAL(0.0082), REAL(0.0073)
_HALF = REAL(np.sqrt(0.5))
_LOW, _HIGH = panda.JOINT_LOW.astype(REAL), panda.JOINT_HIGH.astype(REAL)
_TINY = REAL(1e-12)
_CLOSE = REAL(0.03)  # m; nobody nears the table by more until the next look
_NARROW = REAL(0.1)  # rad; no joint turns by more until then

# Rows of `b`, which the sweeps only read. Of the directions x, y, z: the hand point's Jacobian (21), what an impulse
# does to the joint velocities (21), 1 / what it does to its own direction, the velocity that the motors want; then the
# height of the finger tips, and the velocity that the table asks for; of the joints, what their velocities lack at the
# limits.
_JACOBIAN, _SPREAD, _GAIN, _WANTED, _HEIGHT, _ASKED, _LOWEST, _HIGHEST = 0, 21, 42, 45, 48, 49, 50, 57
N_BOUNDS = 64
# Rows of the motors' scratch `s`, which they write: what the joint velocities lack, pushes, and impulses so far.
LACK, PUSH, OTHER = N, 2 * N, 2 * N + 1
TABLE, HELD = 2 * N + 4, 2 * N + 7
N_SCRATCH = 3 * N + 7


@lane
def near_table(axes: Lanes, hand: Lanes, b: Lanes) -> bool:
    """Whether any hand is near the table; heights of the finger tips go into ``b`` (N_BOUNDS, L)."""
    axes, hand, b = fixed(axes, (N + 1, 3, 3, LANES)), fixed(hand, (3, LANES)), fixed(b, (N_BOUNDS, LANES))
    lowest = _CLOSE
    for m in range(LANES):
        across = _HALF * abs(axes[N, 2, 0, m] - axes[N, 2, 1, m])
        b[_HEIGHT, m] = hand[2, m] + _TIP * axes[N, 2, 2, m] - _EDGE * across
        lowest = min(lowest, b[_HEIGHT, m])
    return bool(lowest < _CLOSE)


@lane
def near_limits(q: Lanes) -> bool:
    """Whether any joint angle of ``q`` (7, L) is near a limit."""
    q = fixed(q, (N, LANES))
    least = _NARROW
    for i in range(N):
        low, high = _LOW[i], _HIGH[i]
        for m in range(LANES):
            least = min(least, min(q[i, m] - low, high - q[i, m]))
    return bool(least < _NARROW)


@lane
def write_effects(inverse: Lanes, jacobian: Lanes, b: Lanes) -> None:
    """What impulses at the hand point do, from the ``inverse`` of the mass matrix and the ``jacobian``."""
    inverse, jacobian = fixed(inverse, (N, N, LANES)), fixed(jacobian, (6, N, LANES))
    b = fixed(b, (N_BOUNDS, LANES))
    for r in range(3):
        soft = _SOFT if r == 2 else ZERO
        for m in range(LANES):
            for i in range(N):
                b[_JACOBIAN + N * r + i, m] = jacobian[r, i, m]
        for m in range(LANES):
            for i in range(N):
                total = inverse[i, 0, m] * b[_JACOBIAN + N * r, m]
                for j in range(1, N):
                    total += inverse[i, j, m] * b[_JACOBIAN + N * r + j, m]
                b[_SPREAD + N * r + i, m] = total
        for m in range(LANES):
            total = soft
            for i in range(N):
                total += b[_SPREAD + N * r + i, m] * b[_JACOBIAN + N * r + i, m]
            b[_GAIN + r, m] = ONE / total


@lane
def meet_table(wanted: Lanes, b: Lanes) -> None:
    """Begin a substep at the table; ``wanted`` (7, L) are the joint velocities that the motors pull to."""
    wanted, b = fixed(wanted, (N, LANES)), fixed(b, (N_BOUNDS, LANES))
    for r in range(3):
        for m in range(LANES):
            total = b[_JACOBIAN + N * r, m] * wanted[0, m]
            for i in range(1, N):
                total += b[_JACOBIAN + N * r + i, m] * wanted[i, m]
            b[_WANTED + r, m] = total
    for m in range(LANES):
        height = b[_HEIGHT, m]
        b[_ASKED, m] = -height * (_PER_DT if height > ZERO else _PUSH_OUT)


@lane
def meet_limits(q: Lanes, wanted: Lanes, b: Lanes) -> None:
    """Begin a substep at the joint limits; ``wanted`` (7, L) are the velocities that the motors pull to."""
    q, wanted, b = fixed(q, (N, LANES)), fixed(wanted, (N, LANES)), fixed(b, (N_BOUNDS, LANES))
    for i in range(N):
        low, high = _LOW[i], _HIGH[i]
        for m in range(LANES):
            b[_LOWEST + i, m] = wanted[i, m] - (low - q[i, m]) * _PER_DT
            b[_HIGHEST + i, m] = wanted[i, m] - (high - q[i, m]) * _PER_DT


@lane
def press(b: Lanes, s: Lanes) -> None:
    """Let the table push: one sweep over its normal and its friction."""
    b, s = fixed(b, (N_BOUNDS, LANES)), fixed(s, (N_SCRATCH, LANES))
    for m in range(LANES):
        speed = b[_WANTED + 2, m]
        for i in range(N):
            speed -= b[_JACOBIAN + 2 * N + i, m] * s[LACK + i, m]
        before = s[TABLE + 2, m]
        after = max(ZERO, before + (b[_ASKED, m] - speed - _SOFT * before) * b[_GAIN + 2, m])
        s[TABLE + 2, m], s[PUSH, m] = after, after - before
    for m in range(LANES):
        push = s[PUSH, m]
        for i in range(N):
            s[LACK + i, m] -= b[_SPREAD + 2 * N + i, m] * push
    for m in range(LANES):
        speed_x, speed_y = b[_WANTED, m], b[_WANTED + 1, m]
        for i in range(N):
            speed_x -= b[_JACOBIAN + i, m] * s[LACK + i, m]
            speed_y -= b[_JACOBIAN + N + i, m] * s[LACK + i, m]
        x, y = s[TABLE, m] - speed_x * b[_GAIN, m], s[TABLE + 1, m] - speed_y * b[_GAIN + 1, m]
        share = min(ONE, _FRICTION * s[TABLE + 2, m] / np.sqrt(x * x + y * y + _TINY))
        s[PUSH, m], s[OTHER, m] = share * x - s[TABLE, m], share * y - s[TABLE + 1, m]
        s[TABLE, m], s[TABLE + 1, m] = share * x, share * y
    for m in range(LANES):
        push, other = s[PUSH, m], s[OTHER, m]
        for i in range(N):
            s[LACK + i, m] -= b[_SPREAD + i, m] * push + b[_SPREAD + N + i, m] * other


@lane
def hold(inverse: Lanes, gains: Lanes, b: Lanes, s: Lanes) -> None:
    """Let the joint limits push: one sweep. Row j of ``gains`` is 1 / inverse[j, j]."""
    inverse, gains = fixed(inverse, (N, N, LANES)), fixed(gains, (N, LANES))
    b, s = fixed(b, (N_BOUNDS, LANES)), fixed(s, (N_SCRATCH, LANES))
    for j in range(N):
        for m in range(LANES):
            before, gain = s[HELD + j, m], gains[j, m]
            down = min(ZERO, before + (s[LACK + j, m] - b[_HIGHEST + j, m]) * gain)
            up = max(ZERO, before + (s[LACK + j, m] - b[_LOWEST + j, m]) * gain)
            s[PUSH, m] = down + up - before
            s[HELD + j, m] = down + up
        for m in range(LANES):
            push = s[PUSH, m]
            for i in range(N):
                s[LACK + i, m] -= inverse[j, i, m] * push


@lane
def sink(speed: Lanes, b: Lanes) -> None:
    """End a substep: the finger tips move on with the joint velocities ``speed`` (7, L)."""
    speed, b = fixed(speed, (N, LANES)), fixed(b, (N_BOUNDS, LANES))
    time = REAL(_DT)
    for m in range(LANES):
        total = ZERO
        for i in range(N):
            total += b[_JACOBIAN + 2 * N + i, m] * speed[i, m]
        b[_HEIGHT, m] += time * total

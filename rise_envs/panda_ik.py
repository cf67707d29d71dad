"""Bullet's inverse kinematics of many Panda arms at once, in the lanes of :mod:`rise_envs.panda_lanes`.

From the present joint angles, 20 steps dq = Jᵀ(JJᵀ + λI)⁻¹e with λ = ½ lead towards the target hand position and
the hand-down orientation. They do not converge, and the simulation relies on it. With a Jacobian that is held, the
error after a step is e − Jdq = λ(JJᵀ + λI)⁻¹e: the solution of the step, scaled. So only a few Jacobians are
computed, and the steps between cost one solve each.
"""

from __future__ import annotations

import numpy as np

from rise_envs.panda_lanes import (
    LANES,
    ONE,
    REAL,
    ZERO,
    Lanes,
    N,
    factor,
    fixed,
    lane,
    solve,
    turn,
    write_frames,
    write_gram,
    write_hand,
    write_jacobian,
)

_STEPS = (2, 4, 6, 8)  # with each Jacobian
_DAMPING = REAL(0.5)
_NEAR2 = REAL(1e-4**2)  # m²: within 0.1 mm of the target the inverse kinematics stops
_TURN = REAL(0.9)  # rad: no joint turns farther with one Jacobian
# Axes of frame 7 when the hand points down and its fingers open along y.
_HALF = np.sqrt(0.5)
_DOWN = np.array([[_HALF, -_HALF, 0.0], [-_HALF, -_HALF, 0.0], [0.0, 0.0, -1.0]], REAL)
# Angle / sine as a series in the squared sine.
_ARC = np.array([1 / 6, 3 / 40, 15 / 336, 105 / 3456, 945 / 42240], REAL)
_MIDDLE = REAL(0.5)


@lane
def write_error(axes: Lanes, hand: Lanes, target: Lanes, error: Lanes) -> None:
    """Position error (m) and rotation vector (rad) from the hand to its target, (6, L)."""
    axes, error = fixed(axes, (N + 1, 3, 3, LANES)), fixed(error, (6, LANES))
    hand, target = fixed(hand, (3, LANES)), fixed(target, (3, LANES))
    for m in range(LANES):
        x, y, z = ZERO, ZERO, ZERO
        for c in range(3):
            a, b, d = axes[N, 0, c, m], axes[N, 1, c, m], axes[N, 2, c, m]
            x += b * _DOWN[2, c] - d * _DOWN[1, c]
            y += d * _DOWN[0, c] - a * _DOWN[2, c]
            z += a * _DOWN[1, c] - b * _DOWN[0, c]
        x, y, z = _MIDDLE * x, _MIDDLE * y, _MIDDLE * z
        s = x * x + y * y + z * z
        k = ONE + s * (_ARC[0] + s * (_ARC[1] + s * (_ARC[2] + s * (_ARC[3] + s * _ARC[4]))))
        error[3, m], error[4, m], error[5, m] = k * x, k * y, k * z
        for r in range(3):
            error[r, m] = target[r, m] - hand[r, m]


@lane
def _iterate(count: int, gram: Lanes, error: Lanes, total: Lanes) -> None:
    """Sum of the solutions of ``count`` steps with the factored ``gram``; ``error`` is what they leave, (6, L)."""
    gram, error, total = fixed(gram, (6, 6, LANES)), fixed(error, (6, LANES)), fixed(total, (6, LANES))
    for i in range(6):
        for m in range(LANES):
            total[i, m] = ZERO
    solution = fixed(np.empty((6, LANES), REAL), (6, LANES))
    for _ in range(count):
        for i in range(6):
            for m in range(LANES):
                solution[i, m] = error[i, m]
        solve(gram, solution)
        for m in range(LANES):
            gap = error[0, m] * error[0, m] + error[1, m] * error[1, m] + error[2, m] * error[2, m]
            goes = gap > _NEAR2
            for i in range(6):
                total[i, m] += solution[i, m] if goes else ZERO
                error[i, m] = _DAMPING * solution[i, m] if goes else error[i, m]


@lane
def _write_change(jacobian: Lanes, total: Lanes, change: Lanes) -> None:
    """Joint steps Jᵀ·total (7, L), shortened if a joint would turn too far."""
    jacobian, total = fixed(jacobian, (6, N, LANES)), fixed(total, (6, LANES))
    change = fixed(change, (N, LANES))
    for m in range(LANES):
        most = _TURN
        for k in range(N):
            step = jacobian[0, k, m] * total[0, m]
            for i in range(1, 6):
                step += jacobian[i, k, m] * total[i, m]
            change[k, m] = step
            most = max(most, abs(step))
        shorter = _TURN / most
        for k in range(N):
            change[k, m] *= shorter


@lane
def aim(
    cos: Lanes,
    sin: Lanes,
    target: Lanes,
    axes: Lanes,
    origin: Lanes,
    hand: Lanes,
    jacobian: Lanes,
    gram: Lanes,
    error: Lanes,
    total: Lanes,
    change: Lanes,
    angle: Lanes,
) -> None:
    """Let ``angle`` (7, L) turn to what Bullet computes for the hand's ``target`` (3, L).

    Args:
        cos: of ``angle``, (7, L); goes with it.
        sin: likewise.
        target: of the hand point (m), (3, L).
        axes: scratch of `write_frames`.
        origin: likewise.
        hand: scratch, (3, L).
        jacobian: scratch, (6, 7, L).
        gram: scratch, (6, 6, L).
        error: scratch, (6, L).
        total: scratch, (6, L).
        change: scratch, (7, L).
        angle: joint angles (rad), (7, L).
    """
    for count in _STEPS:
        write_frames(cos, sin, axes, origin)
        write_hand(axes, origin, hand)
        write_jacobian(axes, origin, hand, jacobian)
        write_error(axes, hand, target, error)
        write_gram(jacobian, _DAMPING, gram)
        factor(gram)
        _iterate(count, gram, error, total)
        _write_change(jacobian, total, change)
        for i in range(N):
            for m in range(LANES):
                angle[i, m] += change[i, m]
        turn(cos, sin, change)

"""The motion of panda-gym's arm without the physics engine: many arms at once, compiled with numba.

One control step is what Bullet does in ``RISE-SafePanda-v0``, written out:

1. *Inverse kinematics.* From the present joint angles, 20 steps dq = Jᵀ(JJᵀ + ½I)⁻¹e towards the target hand
   position (reported position + displacement, not below the table) and the hand-down orientation. They do not
   converge, and the simulation relies on it.
2. *Motors.* In each of 20 substeps of 2 ms the motors pull the joint velocities to 0.1·(q_target − q)/2 ms with
   limited torque, against gravity, Coriolis forces and Bullet's damping of bodies. The impulses solve a boxed
   linear complementarity problem, in Bullet by 50 Gauss-Seidel sweeps, to and fro through the motors in the order
   that its sorting leaves them. For the nearly parallel joints 0 and 2 the sweeps do not converge either. Here
   the coupled pairs (0, 2) and (1, 3) are solved together, and stopped short where Bullet's sweeps would be.

Left out are the table (an arm that pushes on it stops in Bullet), joint limits and the fingers' own motion. The
mass matrix is renewed every fourth substep. Away from the table the hand is within 2 mm of Bullet's after 40
steps, on average. (All 50 sweeps and a mass matrix in every substep: 0.02 mm, at a tenth of the speed.)

Shapes: B arms. L = ``LANES`` arms are stepped together, one per vector lane; inside, arrays have them last. SI
units, world frame; base, joints and frames as in :mod:`rise_envs.panda_kinematics`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from rise_envs.panda_kinematics import BASE, NEUTRAL, hand_position
from rise_envs.panda_lanes import (
    LANES,
    N,
    fixed,
    invert,
    solve,
    turn,
    write_bodies,
    write_dynamics,
    write_frames,
    write_gram,
    write_hand,
    write_jacobian,
)

Array = NDArray[np.float64]

STEP = 0.05  # m of displacement per unit of action
SUBSTEPS = 20
DT = 0.002
_RENEW = 4  # substeps between two mass matrices
_IK_STEPS = 20
_IK_DAMPING = 0.5
_IK_NEAR = 1e-4  # m: the inverse kinematics stops there
_IK_TURN = np.pi / 6  # no joint turns farther in one of its steps
_GAIN = 0.1
_SWEEPS = 5
_IMPULSE = DT * np.array([87.0, 87.0, 87.0, 87.0, 12.0, 120.0, 120.0])  # N m s, panda-gym's torque limits
# Axes of frame 7 when the hand points down and its fingers open along y.
_HALF = np.sqrt(0.5)
_DOWN = np.array([[_HALF, -_HALF, 0.0], [-_HALF, -_HALF, 0.0], [0.0, 0.0, -1.0]])


class Block(NamedTuple):
    """Arrays of one block of L arms."""

    q: Array  # joint angles (rad), (7, L)
    speed: Array  # joint velocities (rad/s), (7, L)
    hand: Array  # hand point (m), (3, L)
    target: Array  # of the hand point (m), (3, L)
    aim: Array  # joint angles that the motors pull to (rad), (7, L)
    cos: Array  # of the joint angles, (7, L)
    sin: Array  # (7, L)
    change: Array  # of the joint angles since cosines and sines were written (rad), (7, L)
    axes: Array  # of the frames, (8, 3, 3, L)
    origin: Array  # of the frames (m), (8, 3, L)
    jacobian: Array  # (6, 7, L)
    gram: Array  # (6, 6, L)
    error: Array  # (6, L)
    inverse: Array  # of the mass matrix, (7, 7, L)
    spatial: Array  # (12, L)
    body: Array  # (7, 15, L)
    twist: Array  # (7, 6, L)
    torque: Array  # what holds the arm against gravity and its own motion, negative (N m), (7, L)
    free: Array  # joint accelerations without motors (rad/s²), (7, L)
    motors: Array  # scratch of `_motors`, (18, L)


@njit(cache=True)
def _make_block() -> Block:
    axes, origin = np.zeros((N + 1, 3, 3, LANES)), np.zeros((N + 1, 3, LANES))
    for r in range(3):
        for m in range(LANES):
            origin[0, r, m] = BASE[r]
            axes[0, r, r, m] = 1.0
    return Block(
        np.zeros((N, LANES)),
        np.zeros((N, LANES)),
        np.zeros((3, LANES)),
        np.zeros((3, LANES)),
        np.zeros((N, LANES)),
        np.zeros((N, LANES)),
        np.zeros((N, LANES)),
        np.zeros((N, LANES)),
        axes,
        origin,
        np.zeros((6, N, LANES)),
        np.zeros((6, 6, LANES)),
        np.zeros((6, LANES)),
        np.zeros((N, N, LANES)),
        np.zeros((12, LANES)),
        np.zeros((N, 15, LANES)),
        np.zeros((N, 6, LANES)),
        np.zeros((N, LANES)),
        np.zeros((N, LANES)),
        np.zeros((2 * N + 4, LANES)),
    )


@njit(cache=True, fastmath=True)
def _write_error(axes: Array, hand: Array, target: Array, error: Array) -> None:
    """Position error (m) and rotation vector (rad) from the hand to its target, (6, L)."""
    lanes = hand.shape[-1]
    axes, error = fixed(axes, (N + 1, 3, 3, LANES)), fixed(error, (6, LANES))
    hand, target = fixed(hand, (3, LANES)), fixed(target, (3, LANES))
    for m in range(lanes):
        x, y, z = 0.0, 0.0, 0.0
        for c in range(3):
            a, b, d = axes[N, 0, c, m], axes[N, 1, c, m], axes[N, 2, c, m]
            x += 0.5 * (b * _DOWN[2, c] - d * _DOWN[1, c])
            y += 0.5 * (d * _DOWN[0, c] - a * _DOWN[2, c])
            z += 0.5 * (a * _DOWN[1, c] - b * _DOWN[0, c])
        s = x * x + y * y + z * z  # squared sine of the angle; next, angle / sine as a series
        k = 1.0 + s * (1 / 6 + s * (3 / 40 + s * (15 / 336 + s * (105 / 3456 + s * 945 / 42240))))
        error[3, m], error[4, m], error[5, m] = k * x, k * y, k * z
        for r in range(3):
            error[r, m] = target[r, m] - hand[r, m]


@njit(cache=True, fastmath=True)
def _write_change(jacobian: Array, error: Array, active: Array, change: Array) -> None:
    """Joint steps Jᵀ·error (7, L), shortened to what Bullet allows, and zero where ``active`` (L,) is."""
    lanes = active.shape[-1]
    jacobian, error = fixed(jacobian, (6, N, LANES)), fixed(error, (6, LANES))
    active, change = fixed(active, (LANES,)), fixed(change, (N, LANES))
    for k in range(N):
        for m in range(lanes):
            total = jacobian[0, k, m] * error[0, m]
            for i in range(1, 6):
                total += jacobian[i, k, m] * error[i, m]
            change[k, m] = total
    for m in range(lanes):
        most = _IK_TURN
        for k in range(N):
            most = max(most, abs(change[k, m]))
        shorter = active[m] * _IK_TURN / most
        for k in range(N):
            change[k, m] *= shorter


@njit(cache=True, fastmath=True)
def _aim(w: Block) -> None:
    """Bullet's joint angles ``aim`` for the hand's targets; leaves frames, cosines and sines there."""
    active = np.empty(LANES)
    w.aim[:] = w.q
    for _ in range(_IK_STEPS):
        write_frames(w.cos, w.sin, w.axes, w.origin)
        write_hand(w.axes, w.origin, w.hand)
        write_jacobian(w.axes, w.origin, w.hand, w.jacobian)
        _write_error(w.axes, w.hand, w.target, w.error)
        for m in range(LANES):
            gap = w.error[0, m] ** 2 + w.error[1, m] ** 2 + w.error[2, m] ** 2
            active[m] = 1.0 if gap > _IK_NEAR**2 else 0.0
        write_gram(w.jacobian, _IK_DAMPING, w.gram)
        solve(w.gram, w.error)
        _write_change(w.jacobian, w.error, active, w.change)
        w.aim[:] += w.change
        turn(w.cos, w.sin, w.change)


@njit(cache=True, fastmath=True)
def _renew(w: Block) -> None:
    """Inverse mass matrix and free accelerations at the present angles and speeds."""
    turn(w.cos, w.sin, w.change)
    w.change[:] = 0.0
    write_frames(w.cos, w.sin, w.axes, w.origin)
    write_bodies(w.axes, w.origin, w.speed, w.spatial, w.body, w.twist)
    write_dynamics(w.twist, w.body, w.spatial, w.inverse, w.torque)
    invert(w.inverse, w.free)
    _write_product(w.inverse, w.torque, w.free)


@njit(cache=True, fastmath=True)
def _write_product(matrix: Array, x: Array, y: Array) -> None:
    """Products ``y`` = matrix · x, (7, L)."""
    lanes = x.shape[-1]
    matrix, x, y = fixed(matrix, (N, N, LANES)), fixed(x, (N, LANES)), fixed(y, (N, LANES))
    for i in range(N):
        for m in range(lanes):
            total = 0.0
            for j in range(N):
                total += matrix[i, j, m] * x[j, m]
            y[i, m] = total


# Rows of the motors' scratch: impulses, then what the joint velocities lack, then four more.
_LACK, _PUSH, _OTHER, _ANCHOR = N, 2 * N, 2 * N + 1, 2 * N + 2


@njit(cache=True, fastmath=True)
def _spread(j: int, row: int, inverse: Array, s: Array) -> None:
    """Let the push of motor ``j`` in the given row act on all joints."""
    lanes = s.shape[-1]
    inverse, s = fixed(inverse, (N, N, LANES)), fixed(s, (2 * N + 4, LANES))
    for m in range(lanes):
        push = s[row, m]
        for i in range(N):
            s[_LACK + i, m] -= inverse[j, i, m] * push


@njit(cache=True, fastmath=True)
def _pull(j: int, inverse: Array, s: Array) -> None:
    """Let motor ``j`` alone make up for what it lacks."""
    lanes = s.shape[-1]
    inverse, s = fixed(inverse, (N, N, LANES)), fixed(s, (2 * N + 4, LANES))
    limit = _IMPULSE[j]
    for m in range(lanes):
        before = s[j, m]
        after = min(limit, max(-limit, before + s[_LACK + j, m] / inverse[j, j, m]))
        s[j, m], s[_PUSH, m] = after, after - before
    _spread(j, _PUSH, inverse, s)


@njit(inline="always")
def _pull_pair(i: int, j: int, anchor: int, first: bool, inverse: Array, s: Array, lanes: int) -> None:
    """Let two coupled motors make up for what they lack, as far as Bullet's sweeps would.

    Alone, the sweeps set them right in turn, 51 times. After the first turn of motor ``j``, kept in the row
    ``anchor``, its distance from the solution shrinks by ρ in each of the 24 that follow.
    """
    limit_i, limit_j = _IMPULSE[i], _IMPULSE[j]
    for m in range(lanes):
        a, c, d = inverse[i, i, m], inverse[i, j, m], inverse[j, j, m]
        x, y = s[i, m], s[j, m]
        need_i, need_j = s[_LACK + i, m] + a * x + c * y, s[_LACK + j, m] + c * x + d * y
        start = min(limit_i, max(-limit_i, need_i / a))
        start = min(limit_j, max(-limit_j, (need_j - c * start) / d))
        start = start if first else s[anchor, m]
        s[anchor, m] = start
        rho = c * c / (a * d)
        rho2 = rho * rho
        rho8 = rho2 * rho2 * rho2 * rho2
        free_j = (a * need_j - c * need_i) / (a * d - c * c)
        free_i = (need_i - c * free_j) / a
        held_i = min(limit_i, max(-limit_i, free_i))
        slow = free_j + rho8 * rho8 * rho8 * (start - free_j)
        after_j = slow if held_i == free_i else (need_j - c * held_i) / d
        after_j = min(limit_j, max(-limit_j, after_j))
        after_i = min(limit_i, max(-limit_i, (need_i - c * after_j) / a))
        s[_PUSH, m], s[j, m] = after_j - y, after_j
        s[_OTHER, m], s[i, m] = after_i - x, after_i
    _spread(j, _PUSH, inverse, s)
    _spread(i, _OTHER, inverse, s)


@njit(cache=True, fastmath=True)
def _motors(inverse: Array, s: Array) -> None:
    """The motors in one substep: ``s`` holds what the joint velocities lack, and receives what they lack still."""
    lanes = s.shape[-1]
    inverse, s = fixed(inverse, (N, N, LANES)), fixed(s, (2 * N + 4, LANES))
    for i in range(N):
        for m in range(lanes):
            s[i, m] = 0.0
    for sweep in range(_SWEEPS):
        for j in range(6, 3, -1):
            _pull(j, inverse, s)
        _pull_pair(1, 3, _ANCHOR, sweep == 0, inverse, s, lanes)
        _pull_pair(0, 2, _ANCHOR + 1, sweep == 0, inverse, s, lanes)


@njit(cache=True, fastmath=True)
def _write_lack(w: Block) -> None:
    """What the joint velocities lack before the motors act; ``speed`` receives what the motors pull to."""
    for i in range(N):
        for m in range(LANES):
            wanted = _GAIN / DT * (w.aim[i, m] - w.q[i, m])
            w.motors[_LACK + i, m] = wanted - w.speed[i, m] - DT * w.free[i, m]
            w.speed[i, m] = wanted


@njit(cache=True, fastmath=True)
def _move(w: Block) -> None:
    """One control step of a block: angles and speeds go on, ``hand`` is what Bullet reports after it."""
    for i in range(N):
        for m in range(LANES):
            w.cos[i, m], w.sin[i, m] = np.cos(w.q[i, m]), np.sin(w.q[i, m])
    cos, sin = w.cos.copy(), w.sin.copy()
    _aim(w)
    w.cos[:], w.sin[:], w.change[:] = cos, sin, 0.0
    for substep in range(SUBSTEPS):
        if substep % _RENEW == 0:
            _renew(w)
        _write_lack(w)
        _motors(w.inverse, w.motors)
        if substep == SUBSTEPS - 1:  # the engine reports the hand where its last substep began
            turn(w.cos, w.sin, w.change)
            write_frames(w.cos, w.sin, w.axes, w.origin)
            write_hand(w.axes, w.origin, w.hand)
        for i in range(N):
            for m in range(LANES):
                w.speed[i, m] -= w.motors[_LACK + i, m]
                w.q[i, m] += DT * w.speed[i, m]
                w.change[i, m] += DT * w.speed[i, m]


@njit(cache=True, fastmath=True)
def _step(q: Array, speed: Array, hand: Array, velocity: Array, action: Array) -> None:
    w = _make_block()
    count = len(q)
    for first in range(0, count, LANES):
        for m in range(LANES):
            b = min(first + m, count - 1)  # the last block is filled up with copies of the last arm
            for i in range(N):
                w.q[i, m], w.speed[i, m] = q[b, i], speed[b, i]
            for r in range(3):
                w.target[r, m] = hand[b, r] + STEP * min(1.0, max(-1.0, action[b, r]))
            w.target[2, m] = max(0.0, w.target[2, m])
        _move(w)
        write_jacobian(w.axes, w.origin, w.hand, w.jacobian)
        for m in range(min(LANES, count - first)):
            for i in range(N):
                q[first + m, i], speed[first + m, i] = w.q[i, m], w.speed[i, m]
            for r in range(3):
                hand[first + m, r], velocity[first + m, r] = w.hand[r, m], 0.0
                for i in range(N):
                    velocity[first + m, r] += w.jacobian[r, i, m] * w.speed[i, m]


@dataclass
class Arms:
    """B arms in motion. The arrays are written into by `step`.

    Attributes:
        q: joint angles (rad), (B, 7).
        speed: joint velocities (rad/s), (B, 7).
        hand: hand points as the engine reports them (m), (B, 3).
        velocity: velocities of the hand points, likewise (m/s), (B, 3).
    """

    q: Array
    speed: Array
    hand: Array
    velocity: Array

    @classmethod
    def at_rest(cls, count: int) -> Arms:
        """``count`` arms at rest in panda-gym's neutral pose."""
        q = np.tile(NEUTRAL, (count, 1))
        return cls(q, np.zeros((count, N)), hand_position(q), np.zeros((count, 3)))

    def step(self, action: Array) -> None:
        """One control step under ``action`` (B, 3), clipped to [−1, 1]."""
        _step(self.q, self.speed, self.hand, self.velocity, np.asarray(action, dtype=np.float64))

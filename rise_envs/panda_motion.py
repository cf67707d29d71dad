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

from rise_envs.panda_dynamics import write_bodies, write_dynamics
from rise_envs.panda_ik import aim
from rise_envs.panda_kinematics import BASE, NEUTRAL, hand_position
from rise_envs.panda_lanes import (
    LANES,
    ONE,
    REAL,
    Lanes,
    N,
    fixed,
    invert,
    turn,
    write_frames,
    write_hand,
    write_jacobian,
    write_turns,
)
from rise_envs.panda_motors import DT, LACK, N_GAINS, N_SCRATCH, motors, write_gains

Array = NDArray[np.float64]

STEP = 0.05  # m of displacement per unit of action
SUBSTEPS = 20
_RENEW = 4  # substeps between two mass matrices
_DT, _GAIN = REAL(DT), REAL(0.1 / DT)


class Block(NamedTuple):
    """Arrays of one block of L arms."""

    q: Lanes  # joint angles (rad), (7, L)
    speed: Lanes  # joint velocities (rad/s), (7, L)
    hand: Lanes  # hand point (m), (3, L)
    target: Lanes  # of the hand point (m), (3, L)
    aim: Lanes  # joint angles that the motors pull to (rad), (7, L)
    cos: Lanes  # of the joint angles, (7, L)
    sin: Lanes  # (7, L)
    change: Lanes  # of the joint angles since cosines and sines were written (rad), (7, L)
    axes: Lanes  # of the frames, (8, 3, 3, L)
    origin: Lanes  # of the frames (m), (8, 3, L)
    jacobian: Lanes  # (6, 7, L)
    gram: Lanes  # (6, 6, L)
    error: Lanes  # (6, L)
    total: Lanes  # (6, L)
    inverse: Lanes  # of the mass matrix, (7, 7, L)
    gains: Lanes  # of the motors, (N_GAINS, L)
    spatial: Lanes  # (12, L)
    body: Lanes  # (7, 15, L)
    twist: Lanes  # (7, 6, L)
    torque: Lanes  # what holds the arm against gravity and its own motion, negative (N m), (7, L)
    free: Lanes  # joint accelerations without motors (rad/s²), (7, L)
    motors: Lanes  # scratch of `motors`, (N_SCRATCH, L)


@njit(cache=True)
def _make_block() -> Block:
    axes, origin = np.zeros((N + 1, 3, 3, LANES), REAL), np.zeros((N + 1, 3, LANES), REAL)
    for r in range(3):
        for m in range(LANES):
            origin[0, r, m] = BASE[r]
            axes[0, r, r, m] = ONE
    return Block(
        np.zeros((N, LANES), REAL),
        np.zeros((N, LANES), REAL),
        np.zeros((3, LANES), REAL),
        np.zeros((3, LANES), REAL),
        np.zeros((N, LANES), REAL),
        np.zeros((N, LANES), REAL),
        np.zeros((N, LANES), REAL),
        np.zeros((N, LANES), REAL),
        axes,
        origin,
        np.zeros((6, N, LANES), REAL),
        np.zeros((6, 6, LANES), REAL),
        np.zeros((6, LANES), REAL),
        np.zeros((6, LANES), REAL),
        np.zeros((N, N, LANES), REAL),
        np.zeros((N_GAINS, LANES), REAL),
        np.zeros((12, LANES), REAL),
        np.zeros((N, 15, LANES), REAL),
        np.zeros((N, 6, LANES), REAL),
        np.zeros((N, LANES), REAL),
        np.zeros((N, LANES), REAL),
        np.zeros((N_SCRATCH, LANES), REAL),
    )


@njit(cache=True, fastmath=True)
def _aim(w: Block) -> None:
    """Bullet's joint angles ``aim`` for the hand's targets; leaves frames, cosines and sines there."""
    w.aim[:] = w.q
    aim(
        w.cos,
        w.sin,
        w.target,
        w.axes,
        w.origin,
        w.hand,
        w.jacobian,
        w.gram,
        w.error,
        w.total,
        w.change,
        w.aim,
    )


@njit(cache=True, fastmath=True)
def _renew(w: Block) -> None:
    """Inverse mass matrix and free accelerations at the present angles and speeds."""
    turn(w.cos, w.sin, w.change)
    w.change[:] = REAL(0)
    write_frames(w.cos, w.sin, w.axes, w.origin)
    write_bodies(w.axes, w.origin, w.speed, w.spatial, w.body, w.twist)
    write_dynamics(w.twist, w.body, w.spatial, w.inverse, w.torque)
    invert(w.inverse, w.free)
    write_gains(w.inverse, w.gains)
    _write_product(w.inverse, w.torque, w.free)


@njit(cache=True, fastmath=True)
def _write_product(matrix: Lanes, x: Lanes, y: Lanes) -> None:
    """Products ``y`` = matrix · x, (7, L)."""
    matrix, x, y = fixed(matrix, (N, N, LANES)), fixed(x, (N, LANES)), fixed(y, (N, LANES))
    for i in range(N):
        for m in range(LANES):
            total = matrix[i, 0, m] * x[0, m]
            for j in range(1, N):
                total += matrix[i, j, m] * x[j, m]
            y[i, m] = total


@njit(cache=True, fastmath=True)
def _write_lack(w: Block) -> None:
    """What the joint velocities lack before the motors act; ``speed`` receives what the motors pull to."""
    for i in range(N):
        for m in range(LANES):
            wanted = _GAIN * (w.aim[i, m] - w.q[i, m])
            w.motors[LACK + i, m] = wanted - w.speed[i, m] - _DT * w.free[i, m]
            w.speed[i, m] = wanted


@njit(cache=True, fastmath=True)
def _move(w: Block) -> None:
    """One control step of a block: angles and speeds go on, ``hand`` is what Bullet reports after it."""
    write_turns(w.q, w.cos, w.sin, w.change)
    cos, sin = w.cos.copy(), w.sin.copy()
    _aim(w)
    w.cos[:], w.sin[:], w.change[:] = cos, sin, REAL(0)
    for substep in range(SUBSTEPS):
        if substep % _RENEW == 0:
            _renew(w)
        _write_lack(w)
        motors(w.inverse, w.gains, w.motors)
        if substep == SUBSTEPS - 1:  # the engine reports the hand where its last substep began
            turn(w.cos, w.sin, w.change)
            write_frames(w.cos, w.sin, w.axes, w.origin)
            write_hand(w.axes, w.origin, w.hand)
        for i in range(N):
            for m in range(LANES):
                w.speed[i, m] -= w.motors[LACK + i, m]
                w.q[i, m] += _DT * w.speed[i, m]
                w.change[i, m] += _DT * w.speed[i, m]


@njit(cache=True)
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
            w.target[2, m] = max(REAL(0), w.target[2, m])
        _move(w)
        write_jacobian(w.axes, w.origin, w.hand, w.jacobian)
        for m in range(min(LANES, count - first)):
            for i in range(N):
                q[first + m, i], speed[first + m, i] = w.q[i, m], w.speed[i, m]
            for r in range(3):
                total = 0.0
                for i in range(N):
                    total += w.jacobian[r, i, m] * w.speed[i, m]
                hand[first + m, r], velocity[first + m, r] = w.hand[r, m], total


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

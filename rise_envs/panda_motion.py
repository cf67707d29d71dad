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
from numpy.typing import NDArray

from rise_envs.panda_bounds import (
    N_BOUNDS,
    meet_limits,
    meet_table,
    near_limits,
    near_table,
    sink,
    write_effects,
)
from rise_envs.panda_clearance import look
from rise_envs.panda_dynamics import write_bodies, write_dynamics
from rise_envs.panda_ik import aim
from rise_envs.panda_kinematics import BASE, NEUTRAL
from rise_envs.panda_lanes import (
    LANES,
    ONE,
    REAL,
    ZERO,
    Lanes,
    N,
    compiled,
    fixed,
    invert,
    turn,
    write_frames,
    write_hand,
    write_jacobian,
    write_turns,
)
from rise_envs.panda_motors import DT, LACK, N_GAINS, N_SCRATCH, motors, write_gains
from rise_envs.panda_scene import START_HAND

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
    bounds: Lanes  # scratch of `rise_envs.panda_bounds`, (N_BOUNDS, L)
    motors: Lanes  # scratch of `motors`, (N_SCRATCH, L)
    sphere: Lanes  # centre (m) and velocity (m/s) of the sphere where the step begins, (6, L)
    center: Lanes  # of the sphere now (m), (3, L)
    least: Lanes  # distance of the arm's surface from that centre within the step (m), (L,)
    nearest: Lanes  # the capsule that has it, (L,)


@compiled
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
        np.zeros((N_BOUNDS, LANES), REAL),
        np.zeros((N_SCRATCH, LANES), REAL),
        np.zeros((6, LANES), REAL),
        np.zeros((3, LANES), REAL),
        np.zeros(LANES, REAL),
        np.zeros(LANES, REAL),
    )


@compiled
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


@compiled
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


@compiled
def _write_product(matrix: Lanes, x: Lanes, y: Lanes) -> None:
    """Products ``y`` = matrix · x, (7, L)."""
    matrix, x, y = fixed(matrix, (N, N, LANES)), fixed(x, (N, LANES)), fixed(y, (N, LANES))
    for i in range(N):
        for m in range(LANES):
            total = matrix[i, 0, m] * x[0, m]
            for j in range(1, N):
                total += matrix[i, j, m] * x[j, m]
            y[i, m] = total


@compiled
def _write_lack(w: Block) -> None:
    """What the joint velocities lack before the motors act; ``speed`` receives what the motors pull to."""
    for i in range(N):
        for m in range(LANES):
            wanted = _GAIN * (w.aim[i, m] - w.q[i, m])
            w.motors[LACK + i, m] = wanted - w.speed[i, m] - _DT * w.free[i, m]
            w.speed[i, m] = wanted


@compiled
def _look(w: Block, substep: int) -> None:
    """Compare the arms, whose frames are those at the beginning of ``substep``, with their spheres."""
    time = _DT * REAL(substep)
    for r in range(3):
        for m in range(LANES):
            w.center[r, m] = w.sphere[r, m] + time * w.sphere[3 + r, m]
    look(w.axes, w.origin, w.center, w.least, w.nearest)


@compiled
def _move(w: Block) -> None:
    """One control step of a block: angles and speeds go on, ``hand`` is what Bullet reports after it."""
    write_turns(w.q, w.cos, w.sin, w.change)
    cos, sin = w.cos.copy(), w.sin.copy()
    _aim(w)
    w.cos[:], w.sin[:], w.change[:] = cos, sin, REAL(0)
    low = narrow = False
    for substep in range(SUBSTEPS):
        if substep % _RENEW == 0:
            _renew(w)
            _look(w, substep)
            write_hand(w.axes, w.origin, w.hand)
            write_jacobian(w.axes, w.origin, w.hand, w.jacobian)
            low, narrow = near_table(w.axes, w.hand, w.bounds), near_limits(w.q)
            if low:
                write_effects(w.inverse, w.jacobian, w.bounds)
        _write_lack(w)
        if low:
            meet_table(w.speed, w.bounds)
        if narrow:
            meet_limits(w.q, w.speed, w.bounds)
        motors(w.inverse, w.gains, low, narrow, w.bounds, w.motors)
        if substep == SUBSTEPS - 1:  # the engine reports the hand where its last substep began
            turn(w.cos, w.sin, w.change)
            write_frames(w.cos, w.sin, w.axes, w.origin)
            write_hand(w.axes, w.origin, w.hand)
            write_jacobian(w.axes, w.origin, w.hand, w.jacobian)
        for i in range(N):
            for m in range(LANES):
                w.speed[i, m] -= w.motors[LACK + i, m]
                w.q[i, m] += _DT * w.speed[i, m]
                change = _DT * w.speed[i, m]
                w.change[i, m] = change if substep == SUBSTEPS - 1 else w.change[i, m] + change
        if low:
            sink(w.speed, w.bounds)
    turn(w.cos, w.sin, w.change)
    write_frames(w.cos, w.sin, w.axes, w.origin)
    _look(w, SUBSTEPS)


@compiled
def _step(
    q: Array,
    speed: Array,
    hand: Array,
    action: Array,
    sphere: Array,
    new_q: Array,
    new_speed: Array,
    new_hand: Array,
    velocity: Array,
    clearance: Array,
    nearest: NDArray[np.int64],
) -> None:
    w = _make_block()
    count = len(q)
    for first in range(0, count, LANES):
        for m in range(LANES):
            b = min(first + m, count - 1)  # the last block is filled up with copies of the last arm
            for i in range(N):
                w.q[i, m], w.speed[i, m] = q[b, i], speed[b, i]
            for r in range(3):
                w.target[r, m] = hand[b, r] + STEP * min(1.0, max(-1.0, action[b, r]))
            w.target[2, m] = max(ZERO, w.target[2, m])
            for r in range(6):
                w.sphere[r, m] = sphere[b, r]
            w.least[m] = np.inf
        _move(w)
        for m in range(min(LANES, count - first)):
            b = first + m
            for i in range(N):
                new_q[b, i], new_speed[b, i] = w.q[i, m], w.speed[i, m]
            for r in range(3):
                total = ZERO
                for i in range(N):
                    total += w.jacobian[r, i, m] * w.speed[i, m]
                new_hand[b, r], velocity[b, r] = w.hand[r, m], total
            clearance[b] = w.least[m] - sphere[b, 6]
            nearest[b] = int(w.nearest[m])


@dataclass(frozen=True)
class Arms:
    """B arms in motion.

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
        zeros = np.zeros((count, N))
        return cls(np.tile(NEUTRAL, (count, 1)), zeros, np.tile(START_HAND, (count, 1)), zeros[:, :3].copy())

    def step(self, action: Array, sphere: Array) -> tuple[Arms, Array, NDArray[np.int64]]:
        """One control step.

        Args:
            action: (B, 3), clipped to [−1, 1].
            sphere: a moving sphere for each arm: centre (m), velocity (m/s), radius (m), (B, 7).

        Returns:
            The arms after the step, their least clearances within it (m), (B,), and the capsules that have them,
            (B,), whose links are in :data:`rise_envs.panda_clearance.LINKS`.
        """
        count = len(self.q)
        after = Arms(np.empty((count, N)), np.empty((count, N)), np.empty((count, 3)), np.empty((count, 3)))
        clearance, nearest = np.empty(count), np.empty(count, np.int64)
        _step(
            self.q,
            self.speed,
            self.hand,
            action,
            sphere,
            after.q,
            after.speed,
            after.hand,
            after.velocity,
            clearance,
            nearest,
        )
        return after, clearance, nearest

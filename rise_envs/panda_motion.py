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

3. *Bounds.* The finger tips stand on the table, and joints stop at their limits (:mod:`rise_envs.panda_bounds`).
4. *Clearance.* The arm is compared with its sphere every fourth substep, both ends of the step included
   (:mod:`rise_envs.panda_clearance`).

Left out are contacts of other links with the table and the fingers' own motion. The mass matrix is renewed every
fourth substep. Under random actions away from the table the hand is within 3 mm of Bullet's over 50 steps, on
average. (All 50 sweeps and a mass matrix in every substep: 0.02 mm, at a tenth of the speed.)

Shapes: B arms. L = ``LANES`` arms are stepped together, one per vector lane; inside, arrays have them last. SI
units, world frame; base, joints and frames as in :mod:`rise_envs.panda_kinematics`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from rise_envs.panda_block import Block, block
from rise_envs.panda_bounds import (
    meet_limits,
    meet_table,
    near_limits,
    near_table,
    sink,
    write_effects,
)
from rise_envs.panda_clearance import look, write_center
from rise_envs.panda_dynamics import write_bodies, write_dynamics, write_product
from rise_envs.panda_ik import aim
from rise_envs.panda_kinematics import NEUTRAL
from rise_envs.panda_lanes import (
    LANES,
    ZERO,
    N,
    clear,
    copy,
    entrance,
    invert,
    turn,
    write_frames,
    write_hand,
    write_jacobian,
    write_turns,
)
from rise_envs.panda_motors import DT, go, motors, write_gains, write_lack
from rise_envs.panda_scene import START_HAND

Array = NDArray[np.float64]

STEP = 0.05  # m of displacement per unit of action
SUBSTEPS = 20
_RENEW = 4  # substeps between two mass matrices


# What follows puts the pieces together. It is written into `_step`, the only function of all that numba sees whole.


@njit(inline="always")
def _aim(w: Block) -> None:
    """Cosines and sines, and Bullet's joint angles ``aim`` for the hand's targets."""
    write_turns(w.q, w.cos, w.sin, w.change)
    copy(w.q, w.aim)
    copy(w.cos, w.aim_cos)
    copy(w.sin, w.aim_sin)
    aim(
        w.aim_cos,
        w.aim_sin,
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
    clear(w.change)


@njit(inline="always")
def _turn(w: Block) -> None:
    """Frames at the present angles."""
    turn(w.cos, w.sin, w.change)
    clear(w.change)
    write_frames(w.cos, w.sin, w.axes, w.origin)


@njit(inline="always")
def _renew(w: Block) -> None:
    """Inverse mass matrix and free accelerations at the present angles and speeds."""
    write_bodies(w.axes, w.origin, w.speed, w.spatial, w.body, w.twist)
    write_dynamics(w.twist, w.body, w.spatial, w.inverse, w.torque)
    invert(w.inverse, w.free)
    write_gains(w.inverse, w.gains)
    write_product(w.inverse, w.torque, w.free)


@njit(inline="always")
def _look(w: Block, substep: int) -> None:
    """Compare the arms, whose frames are those at the beginning of ``substep``, with their spheres."""
    write_center(w.sphere, DT * substep, w.center)
    look(w.axes, w.origin, w.center, w.least, w.nearest)


@njit(inline="always")
def _move(w: Block) -> None:
    """One control step of a block: angles and speeds go on, ``hand`` is what Bullet reports after it."""
    _aim(w)
    low = narrow = False
    for substep in range(SUBSTEPS):
        # The engine reports the hand where its last substep began.
        if substep % _RENEW == 0 or substep == SUBSTEPS - 1:
            _turn(w)
            write_hand(w.axes, w.origin, w.hand)
            write_jacobian(w.axes, w.origin, w.hand, w.jacobian)
        if substep % _RENEW == 0:
            _look(w, substep)
            _renew(w)
            low, narrow = near_table(w.axes, w.hand, w.bounds), near_limits(w.q)
            if low:
                write_effects(w.inverse, w.jacobian, w.bounds)
        write_lack(w.aim, w.q, w.free, w.speed, w.motors)
        if low:
            meet_table(w.speed, w.bounds)
        if narrow:
            meet_limits(w.q, w.speed, w.bounds)
        motors(w.inverse, w.gains, low, narrow, w.bounds, w.motors)
        go(w.motors, w.speed, w.q, w.change)
        if low:
            sink(w.speed, w.bounds)
    _turn(w)
    _look(w, SUBSTEPS)


@entrance
def _step(
    w: Block,
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
            w.least[m] = 1e9  # finite: fastmath knows no infinity
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
            block(),
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

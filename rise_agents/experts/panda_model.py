"""The Panda as its experts imagine it: kinematics at one pose, and how the arm moves in one step.

The motion is a linear model of the hand, with the joints following by damped least squares. It is crude (some
millimetres a step), but a step costs a microsecond, and the experts look again after every one.

SI units. Actions are displacements of the hand in units of ``STEP``. Compiled with numba, for one arm.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from rise_envs import panda_kinematics as panda
from rise_envs.panda_task import FOLLOW, KEEP, STEP

Array = NDArray[np.float64]

DT = 0.04  # s
# The hand's next velocity, fitted as its displacement (`FOLLOW`, `KEEP`) was:
# velocity·DT = _KICK·command + _CARRY·velocity·DT.
_KICK = np.array([[0.35, 0.0, 0.08], [0.0, 0.64, 0.0], [-0.09, 0.0, 0.56]])
_CARRY = np.array([[-0.02, 0.0, 0.02], [0.0, -0.31, 0.0], [0.10, 0.0, 0.02]])
_TWIST_GAIN = 0.5  # share of the hand's tilt that one step takes back
_DAMPING = 0.002  # of the joints' least squares (m² and rad²)


class Arm(NamedTuple):
    """Everything about one pose of the arm: arrays that `look` writes into. K capsules."""

    rotation: Array  # axes of the frames as columns, (9, 3, 3)
    position: Array  # their origins (m), (9, 3)
    hand: Array  # hand point (m), (3,)
    jacobian: Array  # of the hand, (6, 7)
    work: Array  # (6, 6)
    mapping: Array  # damped inverse of the Jacobian, (7, 6)
    distance: Array  # of the capsules to the sphere's centre (m), (K,)
    share: Array  # where on their axes the nearest points are, from 0 to 1, (K,)


class Scene(NamedTuple):
    """What is around the arm in one step."""

    goal: Array  # (m), (3,)
    center: Array  # of the sphere (m), (3,)
    drift: Array  # its displacement in one step (m), (3,)
    radius: float  # (m)


@njit(cache=True)
def make_arm() -> Arm:
    """Arrays for one arm, yet to be written."""
    return Arm(
        np.empty((panda.N_FRAMES, 3, 3)),
        np.empty((panda.N_FRAMES, 3)),
        np.empty(3),
        np.empty((6, panda.N_JOINTS)),
        np.empty((6, 6)),
        np.empty((panda.N_JOINTS, 6)),
        np.empty(panda.N_CAPSULES),
        np.empty(panda.N_CAPSULES),
    )


@njit(cache=True)
def look(q: Array, center: Array, arm: Arm) -> None:
    """Write the kinematics at ``q`` (7,) and the distances to ``center`` (3,) into ``arm``."""
    panda.write_frames(q, arm.rotation, arm.position)
    panda.write_hand(arm.rotation, arm.position, arm.hand)
    panda.write_jacobian(arm.rotation, arm.position, arm.hand, arm.jacobian)
    panda.write_damped_map(arm.jacobian, _DAMPING, arm.work, arm.mapping)
    panda.write_distances(arm.rotation, arm.position, center, arm.distance, arm.share)


@njit(cache=True)
def advance(q: Array, velocity: Array, action: Array, arm: Arm) -> None:
    """One step of the motion model, in place: joint angles (7,) and velocity (3,) after ``action`` (3,).

    ``arm`` must hold the kinematics at ``q``.
    """
    down = -arm.hand[2] / STEP  # the simulator clips the target at the table
    u0, u1, u2 = action[0], action[1], max(action[2], down)
    v0, v1, v2 = velocity[0], velocity[1], velocity[2]
    twist = np.empty(6)
    for r in range(3):
        twist[r] = STEP * (FOLLOW[r, 0] * u0 + FOLLOW[r, 1] * u1 + FOLLOW[r, 2] * u2)
        twist[r] += DT * (KEEP[r, 0] * v0 + KEEP[r, 1] * v1 + KEEP[r, 2] * v2)
        velocity[r] = STEP / DT * (_KICK[r, 0] * u0 + _KICK[r, 1] * u1 + _KICK[r, 2] * u2)
        velocity[r] += _CARRY[r, 0] * v0 + _CARRY[r, 1] * v1 + _CARRY[r, 2] * v2
    # The hand's tilt: half the sum of the cross products of its axes with the wanted ones, x, −y and −z.
    hand = arm.rotation[panda.HAND]
    twist[3] = 0.5 * _TWIST_GAIN * (hand[2, 1] - hand[1, 2])
    twist[4] = 0.5 * _TWIST_GAIN * (hand[2, 0] + hand[0, 2])
    twist[5] = -0.5 * _TWIST_GAIN * (hand[1, 0] + hand[0, 1])
    for i in range(panda.N_JOINTS):
        for k in range(6):
            q[i] += arm.mapping[i, k] * twist[k]


@njit(cache=True)
def write_gradient(k: int, center: Array, arm: Arm, normal: Array, gradient: Array) -> None:
    """How the distance of capsule ``k`` to ``center`` changes as the hand moves, in place.

    Args:
        k: capsule.
        center: of the sphere (m), (3,).
        arm: kinematics that `look` wrote for that centre.
        normal: receives the unit vector from the sphere to the capsule, (3,).
        gradient: receives d(distance)/d(displacement of the hand, its orientation held), (3,).
    """
    frame, length = panda.CAPSULE_FRAME[k], arm.distance[k] + panda.CAPSULE_RADIUS[k] + 1e-9
    for r in range(3):  # first the nearest point of the capsule's axis
        normal[r] = arm.position[frame, r]
        for c in range(3):
            local = panda.CAPSULE_START[k, c] + arm.share[k] * panda.CAPSULE_EDGE[k, c]
            normal[r] += arm.rotation[frame, r, c] * local
        gradient[r] = 0.0
    x, y, z = normal[0], normal[1], normal[2]
    for r in range(3):
        normal[r] = (normal[r] - center[r]) / length
    for i in range(min(frame, panda.N_JOINTS)):
        dx, dy, dz = x - arm.position[i + 1, 0], y - arm.position[i + 1, 1], z - arm.position[i + 1, 2]
        ax, ay, az = arm.rotation[i + 1, 0, 2], arm.rotation[i + 1, 1, 2], arm.rotation[i + 1, 2, 2]
        along = normal[0] * (ay * dz - az * dy) + normal[1] * (az * dx - ax * dz)
        along += normal[2] * (ax * dy - ay * dx)
        for r in range(3):
            gradient[r] += along * arm.mapping[i, r]

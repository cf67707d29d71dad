"""The arrays that one block of L arms needs for a control step: see :mod:`rise_envs.panda_motion`."""

from __future__ import annotations

import threading
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from rise_envs.panda_bounds import N_BOUNDS, N_SCRATCH
from rise_envs.panda_kinematics import BASE
from rise_envs.panda_lanes import LANES, REAL, Lanes, N
from rise_envs.panda_motors import N_GAINS


class Block(NamedTuple):
    """Arrays of one block of L arms."""

    q: Lanes  # joint angles (rad), (7, L)
    speed: Lanes  # joint velocities (rad/s), (7, L)
    cos: Lanes  # of the joint angles, (7, L)
    sin: Lanes  # (7, L)
    change: Lanes  # of the joint angles since cosines and sines were written (rad), (7, L)
    aim: Lanes  # joint angles that the motors pull to (rad), (7, L)
    aim_cos: Lanes  # of them, (7, L)
    aim_sin: Lanes  # (7, L)
    torque: Lanes  # what holds the arm against gravity and its own motion, negative (N m), (7, L)
    free: Lanes  # joint accelerations without motors (rad/s²), (7, L)
    hand: Lanes  # hand point (m), (3, L)
    target: Lanes  # of the hand point (m), (3, L)
    center: Lanes  # of the sphere now (m), (3, L)
    sphere: Lanes  # its centre (m) and velocity (m/s) where the step begins, (6, L)
    error: Lanes  # (6, L)
    total: Lanes  # (6, L)
    least: Lanes  # distance of the arm's surface from the sphere's centre within the step (m), (L,)
    nearest: Lanes  # the capsule that has it, (L,)
    axes: Lanes  # of the frames, (8, 3, 3, L)
    origin: Lanes  # of the frames (m), (8, 3, L)
    jacobian: Lanes  # (6, 7, L)
    gram: Lanes  # (6, 6, L)
    inverse: Lanes  # of the mass matrix, (7, 7, L)
    spatial: Lanes  # (12, L)
    body: Lanes  # (7, 15, L)
    twist: Lanes  # (7, 6, L)
    gains: Lanes  # of the motors, (N_GAINS, L)
    bounds: Lanes  # of the table and the joint limits, (N_BOUNDS, L)
    motors: Lanes  # impulses and what the joint velocities lack, (N_SCRATCH, L)


_SHAPES: list[tuple[int, ...]] = [
    *[(N,)] * 10,
    *[(3,)] * 3,
    *[(6,)] * 3,
    *[()] * 2,
    (N + 1, 3, 3),
    (N + 1, 3),
    (6, N),
    (6, 6),
    (N, N),
    (12,),
    (N, 15),
    (N, 6),
    (N_GAINS,),
    (N_BOUNDS,),
    (N_SCRATCH,),
]
_LINE = 16  # numbers in a cache line
_own = threading.local()


def block() -> Block:
    """The block of this thread: scratch, of which only the base frame keeps its value from one step to the next."""
    if not hasattr(_own, "block"):
        rows = np.cumsum([0, *(int(np.prod(shape)) for shape in _SHAPES)])
        # Vectors that lie across two cache lines cost a sixth of the speed.
        space = np.zeros(rows[-1] * LANES + _LINE, REAL)
        space = space[-(space.ctypes.data // space.itemsize) % _LINE :][: rows[-1] * LANES].reshape(-1, LANES)
        parts = [space[i:j] for i, j in pairwise(rows)]
        made = Block(*(part.reshape(*shape, LANES) for part, shape in zip(parts, _SHAPES, strict=True)))
        made.axes[0] = np.eye(3)[..., None]
        made.origin[0] = BASE[:, None]
        _own.block = made
    return _own.block

"""Kinematics of the Franka Panda in ``RISE-SafePanda-v0``, compiled with numba: frames, Jacobians, capsules.

The arm is that of panda-gym: pybullet's ``franka_panda/panda.urdf`` with its base at ``BASE``, seven joints
and a closed gripper. There are nine frames: 0 the base, 1 to 7 after each joint, 8 the hand. The *hand point*
(the end effector that the environment reports) is fixed to frame 8. Twenty capsules stand for the collision
shapes. They were fitted once to the engine's closest-point distances of 3 to 20 cm, with errors to the unsafe
side counting four times: over poses and points of the workspace they err by 2 mm root mean square.

Shapes: B batch, K capsules. SI units, world frame. Functions marked *in place* write into arrays that the
caller owns, so that searches over thousands of poses allocate nothing.

numba's cache watches each compiled function's own file only: after an edit here, delete the ``__pycache__``
folder of ``rise_agents.experts``, which compiled these functions into theirs. (The batched arms of
:mod:`rise_envs.panda_lanes` watch this file.)
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

Array = NDArray[np.float64]

N_JOINTS = 7
N_FRAMES = 9
HAND = 8  # frame of hand, fingers and hand point
BASE = np.array([-0.6, 0.0, 0.0])
NEUTRAL = np.array([0.0, 0.41, 0.0, -1.85, 0.0, 2.26, 0.79])  # panda-gym's start pose (rad)
JOINT_LOW = np.array([-2.9671, -1.8326, -2.9671, -3.1416, -2.9671, -0.0873, -2.9671])
JOINT_HIGH = np.array([2.9671, 1.8326, 2.9671, 0.0, 2.9671, 3.8223, 2.9671])

# Joint i turns about the z axis of frame i + 1, which sits at ORIGIN[i] in frame i, turned about x by
# TWIST[i] quarter turns.
ORIGIN = np.array(
    [
        [0.0, 0.0, 0.333],
        [0.0, 0.0, 0.0],
        [0.0, -0.316, 0.0],
        [0.0825, 0.0, 0.0],
        [-0.0825, 0.384, 0.0],
        [0.0, 0.0, 0.0],
        [0.088, 0.0, 0.0],
    ]
)
TWIST = np.array([0.0, -1.0, 1.0, 1.0, -1.0, 1.0, 1.0])
_FLANGE = 0.107  # frame 7 to frame 8 along z; frame 8 is turned by −45° about z
_HALF = np.sqrt(0.5)
_HAND_POINT = 0.105  # along z of frame 8

# Frame, one end, other end (in that frame), radius.
_CAPSULE_TABLE = np.array(
    [
        [0, -0.0538, 0.0000, 0.0402, -0.0418, 0.0000, -0.0055, 0.1046],
        [0, 0.0000, 0.0001, 0.1093, 0.0118, -0.0001, -0.0129, 0.0623],
        [1, 0.0001, -0.0175, 0.0017, -0.0001, -0.0008, -0.1453, 0.0573],
        [1, 0.0001, -0.0759, 0.0001, 0.0002, 0.0005, -0.1848, 0.0560],
        [2, 0.0000, 0.0014, 0.0169, 0.0000, -0.1472, 0.0004, 0.0572],
        [2, 0.0000, 0.0000, 0.0758, -0.0002, -0.1850, -0.0002, 0.0561],
        [3, 0.0103, 0.0034, -0.0613, 0.0833, 0.0101, -0.0038, 0.0602],
        [3, 0.0820, 0.0579, 0.0001, 0.0000, -0.0007, -0.1059, 0.0571],
        [4, -0.0724, 0.0631, 0.0041, -0.0004, 0.0052, 0.0072, 0.0609],
        [4, -0.0833, 0.1071, -0.0001, -0.0001, 0.0000, 0.0581, 0.0570],
        [5, -0.0003, 0.0804, 0.0009, 0.0000, 0.0389, -0.1743, 0.0544],
        [5, -0.0014, 0.0286, -0.0023, 0.0018, 0.0224, -0.2151, 0.0526],
        [5, 0.0003, 0.0283, -0.1008, -0.0003, -0.0008, -0.2464, 0.0565],
        [6, 0.0857, -0.0422, 0.0009, 0.0821, 0.0398, -0.0001, 0.0481],
        [6, 0.0036, 0.0007, 0.0062, 0.0461, 0.0189, 0.0015, 0.0547],
        [7, -0.0003, 0.0010, 0.0623, 0.0001, 0.0002, 0.0819, 0.0467],
        [7, 0.0025, -0.0063, 0.0599, 0.0408, 0.0407, 0.0895, 0.0390],
        [8, 0.0004, 0.0743, 0.0146, -0.0029, -0.0755, 0.0034, 0.0296],
        [8, 0.0001, 0.0844, 0.0489, 0.0000, -0.0835, 0.0489, 0.0232],
        [8, 0.0001, -0.0099, 0.0977, 0.0000, 0.0096, 0.0977, 0.0158],
    ]
)
CAPSULE_FRAME = _CAPSULE_TABLE[:, 0].astype(np.int64)  # (K,)
CAPSULE_START = np.ascontiguousarray(_CAPSULE_TABLE[:, 1:4])  # in the frame (m), (K, 3)
CAPSULE_EDGE = np.ascontiguousarray(_CAPSULE_TABLE[:, 4:7]) - CAPSULE_START  # from there to the other end
_INVERSE_SQUARE = 1.0 / (CAPSULE_EDGE**2).sum(1)
CAPSULE_RADIUS = np.ascontiguousarray(_CAPSULE_TABLE[:, 7])
N_CAPSULES = len(CAPSULE_FRAME)


@njit(cache=True)
def write_frames(q: Array, rotation: Array, position: Array) -> None:
    """Frames of the arm at joint angles ``q`` (7,), in place.

    Args:
        q: joint angles (rad), (7,).
        rotation: receives the axes of the frames as columns, (9, 3, 3).
        position: receives their origins, (9, 3).
    """
    for r in range(3):
        position[0, r] = BASE[r]
        for c in range(3):
            rotation[0, r, c] = 1.0 if r == c else 0.0
    for i in range(N_JOINTS):
        cos, sin, twist = np.cos(q[i]), np.sin(q[i]), TWIST[i]
        for r in range(3):
            x, y, z = rotation[i, r, 0], rotation[i, r, 1], rotation[i, r, 2]
            position[i + 1, r] = position[i, r] + x * ORIGIN[i, 0] + y * ORIGIN[i, 1] + z * ORIGIN[i, 2]
            # A quarter turn about x only swaps the other two axes.
            if twist != 0.0:
                y, z = twist * z, -twist * y
            rotation[i + 1, r, 0] = x * cos + y * sin
            rotation[i + 1, r, 1] = y * cos - x * sin
            rotation[i + 1, r, 2] = z
    for r in range(3):
        x, y, z = rotation[7, r, 0], rotation[7, r, 1], rotation[7, r, 2]
        position[HAND, r] = position[7, r] + _FLANGE * z
        rotation[HAND, r, 0] = _HALF * (x - y)
        rotation[HAND, r, 1] = _HALF * (x + y)
        rotation[HAND, r, 2] = z


def neutral_frames() -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Rotations (F, 3, 3) and origins (F, 3) of all frames in the neutral pose."""
    rotation, position = np.empty((N_FRAMES, 3, 3)), np.empty((N_FRAMES, 3))
    write = getattr(
        write_frames, "py_func", write_frames
    )  # once, when modules are imported: not worth compiling
    write(NEUTRAL, rotation, position)
    return rotation, position


@njit(cache=True)
def write_hand(rotation: Array, position: Array, hand: Array) -> None:
    """The hand point of an arm with the given frames, in place: ``hand`` (3,)."""
    for r in range(3):
        hand[r] = position[HAND, r] + _HAND_POINT * rotation[HAND, r, 2]


@njit(cache=True)
def write_jacobian(rotation: Array, position: Array, point: Array, jacobian: Array) -> None:
    """Geometric Jacobian of a point on the hand, in place.

    Args:
        rotation: (9, 3, 3) of `write_frames`.
        position: (9, 3) of `write_frames`.
        point: the point (m), (3,).
        jacobian: receives d(point, turn of the hand)/dq, (6, 7). The first three rows and the first k columns
            are also the Jacobian of a point on frame k, whose later columns are zero.
    """
    for i in range(N_JOINTS):
        ax, ay, az = rotation[i + 1, 0, 2], rotation[i + 1, 1, 2], rotation[i + 1, 2, 2]
        dx = point[0] - position[i + 1, 0]
        dy = point[1] - position[i + 1, 1]
        dz = point[2] - position[i + 1, 2]
        jacobian[0, i] = ay * dz - az * dy
        jacobian[1, i] = az * dx - ax * dz
        jacobian[2, i] = ax * dy - ay * dx
        jacobian[3, i], jacobian[4, i], jacobian[5, i] = ax, ay, az


@njit(cache=True)
def write_damped_map(jacobian: Array, damping: float, work: Array, mapping: Array) -> None:
    """The damped inverse Jᵀ(JJᵀ + damping·I)⁻¹ of a Jacobian J, in place.

    Args:
        jacobian: J, (6, 7).
        damping: > 0 (m² and rad²).
        work: scratch, (6, 6).
        mapping: receives the inverse, (7, 6).
    """
    for i in range(6):  # Cholesky factor of JJᵀ + damping·I into the lower triangle of work
        for j in range(i + 1):
            total = damping if i == j else 0.0
            for k in range(N_JOINTS):
                total += jacobian[i, k] * jacobian[j, k]
            for k in range(j):
                total -= work[i, k] * work[j, k]
            work[i, j] = np.sqrt(total) if i == j else total / work[j, j]
    for row in range(N_JOINTS):
        for i in range(6):
            total = jacobian[i, row]
            for k in range(i):
                total -= work[i, k] * mapping[row, k]
            mapping[row, i] = total / work[i, i]
        for i in range(5, -1, -1):
            total = mapping[row, i]
            for k in range(i + 1, 6):
                total -= work[k, i] * mapping[row, k]
            mapping[row, i] = total / work[i, i]


@njit(cache=True)
def write_distances(rotation: Array, position: Array, center: Array, distance: Array, share: Array) -> None:
    """Signed distance of a point to every capsule, in place.

    Args:
        rotation: (9, 3, 3) of `write_frames`.
        position: (9, 3) of `write_frames`.
        center: the point (m), (3,); a sphere's radius is for the caller to subtract.
        distance: receives the distances to the capsules' surfaces (m), (K,).
        share: receives where on the capsules' axes the nearest points are, from 0 to 1, (K,).
    """
    frame, x, y, z = -1, 0.0, 0.0, 0.0
    for k in range(N_CAPSULES):
        if CAPSULE_FRAME[k] != frame:  # the capsules are sorted: turn the point into each frame once
            frame = CAPSULE_FRAME[k]
            dx, dy = center[0] - position[frame, 0], center[1] - position[frame, 1]
            dz = center[2] - position[frame, 2]
            x = rotation[frame, 0, 0] * dx + rotation[frame, 1, 0] * dy + rotation[frame, 2, 0] * dz
            y = rotation[frame, 0, 1] * dx + rotation[frame, 1, 1] * dy + rotation[frame, 2, 1] * dz
            z = rotation[frame, 0, 2] * dx + rotation[frame, 1, 2] * dy + rotation[frame, 2, 2] * dz
        gx, gy, gz = x - CAPSULE_START[k, 0], y - CAPSULE_START[k, 1], z - CAPSULE_START[k, 2]
        ex, ey, ez = CAPSULE_EDGE[k, 0], CAPSULE_EDGE[k, 1], CAPSULE_EDGE[k, 2]
        t = min(1.0, max(0.0, (ex * gx + ey * gy + ez * gz) * _INVERSE_SQUARE[k]))
        gx, gy, gz = gx - t * ex, gy - t * ey, gz - t * ez
        distance[k] = np.sqrt(gx * gx + gy * gy + gz * gz) - CAPSULE_RADIUS[k]
        share[k] = t


@njit(cache=True)
def _hands(q: Array, hands: Array) -> None:
    rotation, position = np.empty((N_FRAMES, 3, 3)), np.empty((N_FRAMES, 3))
    for b in range(len(q)):
        write_frames(q[b], rotation, position)
        write_hand(rotation, position, hands[b])


@njit(cache=True)
def _clearances(q: Array, center: Array, radius: Array, least: Array, capsule: NDArray[np.int64]) -> None:
    rotation, position = np.empty((N_FRAMES, 3, 3)), np.empty((N_FRAMES, 3))
    distance, share = np.empty(N_CAPSULES), np.empty(N_CAPSULES)
    for b in range(len(q)):
        write_frames(q[b], rotation, position)
        write_distances(rotation, position, center[b], distance, share)
        capsule[b] = np.argmin(distance)
        least[b] = distance[capsule[b]] - radius[b]


def _packed(array: Array) -> Array:
    return np.ascontiguousarray(array, dtype=np.float64)


def hand_position(q: Array) -> Array:
    """Hand points (m), (B, 3), at joint angles ``q`` (B, 7)."""
    hands = np.empty((len(q), 3))
    _hands(_packed(q), hands)
    return hands


def clearance(q: Array, center: Array, radius: Array) -> tuple[Array, NDArray[np.int64]]:
    """Clearance of whole arms to one sphere each.

    Args:
        q: joint angles (rad), (B, 7).
        center: centres of the spheres (m), (B, 3).
        radius: their radii (m), (B,).

    Returns:
        Signed distance (m) between capsules and sphere, negative in collision, (B,), and the nearest
        capsule, (B,).
    """
    least, capsule = np.empty(len(q)), np.empty(len(q), np.int64)
    _clearances(_packed(q), _packed(center), _packed(radius), least, capsule)
    return least, capsule


def capsules(q: Array) -> tuple[Array, Array]:
    """The capsules of arms.

    Args:
        q: joint angles (rad), (B, 7).

    Returns:
        Both ends of their axes (m), (B, K, 2, 3), and their radii (m), (K,).
    """
    local = np.stack((CAPSULE_START, CAPSULE_START + CAPSULE_EDGE), 1)
    ends = np.empty((len(q), N_CAPSULES, 2, 3))
    rotation, position = np.empty((N_FRAMES, 3, 3)), np.empty((N_FRAMES, 3))
    for b, angles in enumerate(_packed(q)):
        write_frames(angles, rotation, position)
        turned = np.einsum("krc,kec->ker", rotation[CAPSULE_FRAME], local)
        ends[b] = turned + position[CAPSULE_FRAME][:, None]
    return ends, CAPSULE_RADIUS.copy()

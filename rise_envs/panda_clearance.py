"""Clearance of many Panda arms from one sphere each, in the lanes of :mod:`rise_envs.panda_lanes`.

The capsules are those of :mod:`rise_envs.panda_kinematics`. A clearance comes with the number of the capsule that has
it; the fingers, which share a capsule, are told apart by the half of it that is nearest.
"""

from __future__ import annotations

import numpy as np

from rise_envs import panda_kinematics as panda
from rise_envs.panda_lanes import LANES, ONE, REAL, ZERO, Lanes, N, fixed, lane

_K = panda.N_CAPSULES


def _in_frame_7() -> tuple[np.ndarray, np.ndarray]:
    """Starts and edges of the capsules, those of frame 8 as seen from frame 7: the lanes have no frame 8."""
    rotation, position = panda.neutral_frames()
    turn = rotation[N].T @ rotation[panda.HAND]
    shift = rotation[N].T @ (position[panda.HAND] - position[N])
    hand = (panda.CAPSULE_FRAME == panda.HAND)[:, None]
    start = np.where(hand, panda.CAPSULE_START @ turn.T + shift, panda.CAPSULE_START)
    return start, np.where(hand, panda.CAPSULE_EDGE @ turn.T, panda.CAPSULE_EDGE)


_START, _EDGE = (part.astype(REAL) for part in _in_frame_7())
_INVERSE_SQUARE = (1.0 / (panda.CAPSULE_EDGE**2).sum(1)).astype(REAL)
_RADIUS = panda.CAPSULE_RADIUS.astype(REAL)
# The capsules are sorted by frame: those of frame f are numbers _FIRST[f] to _FIRST[f + 1].
_FIRST = np.searchsorted(np.minimum(panda.CAPSULE_FRAME, N), np.arange(N + 2))
_HALF = REAL(0.5)

_HAND_NAMES = ("panda_hand", "panda_hand", "panda_rightfinger", "panda_leftfinger")
LINKS = np.array([*(f"panda_link{f}" for f in panda.CAPSULE_FRAME[: _K - 3]), *_HAND_NAMES], object)
"""Names of the links that the capsules stand for, as the engine calls them, (K + 1,)."""


@lane
def look(axes: Lanes, origin: Lanes, center: Lanes, least: Lanes, nearest: Lanes) -> None:
    """Let ``least`` and ``nearest`` (L,) be those of the arms in this moment, where they come nearer than before.

    Args:
        axes: of the frames, (8, 3, 3, L).
        origin: of the frames (m), (8, 3, L).
        center: of the spheres (m), (3, L).
        least: least distance of the sphere's centre from the arm's surface so far (m), (L,).
        nearest: the capsule that has it, as a float, (L,).
    """
    axes, origin = fixed(axes, (N + 1, 3, 3, LANES)), fixed(origin, (N + 1, 3, LANES))
    center, least, nearest = fixed(center, (3, LANES)), fixed(least, (LANES,)), fixed(nearest, (LANES,))
    point = np.empty((3, LANES), REAL)
    for f in range(N + 1):
        for m in range(LANES):
            dx, dy, dz = (
                center[0, m] - origin[f, 0, m],
                center[1, m] - origin[f, 1, m],
                center[2, m] - origin[f, 2, m],
            )
            for c in range(3):
                point[c, m] = axes[f, 0, c, m] * dx + axes[f, 1, c, m] * dy + axes[f, 2, c, m] * dz
        for k in range(_FIRST[f], _FIRST[f + 1]):
            sx, sy, sz, radius = _START[k, 0], _START[k, 1], _START[k, 2], _RADIUS[k]
            ex, ey, ez, scale = _EDGE[k, 0], _EDGE[k, 1], _EDGE[k, 2], _INVERSE_SQUARE[k]
            number, other = REAL(k), REAL(k + 1 if k == _K - 1 else k)
            for m in range(LANES):
                gx, gy, gz = point[0, m] - sx, point[1, m] - sy, point[2, m] - sz
                t = min(ONE, max(ZERO, (ex * gx + ey * gy + ez * gz) * scale))
                gx, gy, gz = gx - t * ex, gy - t * ey, gz - t * ez
                distance = np.sqrt(gx * gx + gy * gy + gz * gz) - radius
                name = other if t > _HALF else number
                nearest[m] = name if distance < least[m] else nearest[m]
                least[m] = min(distance, least[m])


@lane
def write_center(sphere: Lanes, time: float, center: Lanes) -> None:
    """Where the spheres (6, L) are ``time`` seconds after the beginning of the step, (3, L)."""
    sphere, center = fixed(sphere, (6, LANES)), fixed(center, (3, LANES))
    for r in range(3):
        for m in range(LANES):
            center[r, m] = sphere[r, m] + REAL(time) * sphere[3 + r, m]

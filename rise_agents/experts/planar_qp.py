"""Small quadratic programs in two variables, solved exactly and in batches.

    minimise |u − target|²   subject to   normals · u ≥ offsets,   low ≤ u ≤ high

In the plane the optimum is the target itself, its projection on one constraint line, or the corner of two of
them. With M constraints these are 1 + K + K(K − 1)/2 points, K = M + 4: few enough to try them all, for
every row of a batch at once and with nothing iterative that could fail.

Where the constraints contradict each other, :func:`nearest_point` keeps the box and takes the point whose
worst violation is least (and, among those, the one nearest to the target).

Shapes: B batch, M constraints, K lines, P candidate points.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_TOLERANCE = 1e-9  # of a constraint, in units of u times the scale of the problem
_HALVINGS = 32  # of the interval that holds the least violation


def nearest_point(
    target: Array, normals: Array, offsets: Array, low: Array, high: Array
) -> tuple[Array, NDArray[np.bool_]]:
    """The feasible point nearest to the target, or the least violating one.

    Args:
        target: (B, 2).
        normals: (B, M, 2), none of them zero.
        offsets: (B, M).
        low: lower bounds of u, (2,).
        high: upper bounds of u, (2,).

    Returns:
        Points (B, 2), always inside the box, and whether all constraints hold there, (B,). Every row is
        solved on its own: it does not depend on the rest of the batch.
    """
    point = np.clip(target, low, high)
    feasible: NDArray[np.bool_] = np.all(_slack(point[:, None], normals, offsets) >= 0, axis=(1, 2))
    # Most rows end here: projecting on the box is exact as long as it breaks no constraint.
    rows = np.flatnonzero(~feasible)
    if rows.size:
        point[rows], feasible[rows] = _best_candidate(target[rows], normals[rows], offsets[rows], low, high)
    rows = rows[~feasible[rows]]
    if rows.size:
        relaxed = offsets[rows] - _least_violation(normals[rows], offsets[rows], low, high)[:, None]
        found, good = _best_candidate(target[rows], normals[rows], relaxed, low, high)
        point[rows] = np.where(good[:, None], found, point[rows])
    return np.clip(point, low, high), feasible


def _slack(points: Array, normals: Array, offsets: Array) -> Array:
    """How far inside each constraint the points (B, P, 2) are: (B, P, M)."""
    # Written out rather than as a matrix product, whose last bit may change with the size of the batch.
    a, u = normals[:, None], points[:, :, None]
    return a[..., 0] * u[..., 0] + a[..., 1] * u[..., 1] - offsets[:, None]


def _best_candidate(
    target: Array, normals: Array, offsets: Array, low: Array, high: Array
) -> tuple[Array, NDArray[np.bool_]]:
    """The nearest feasible point (B, 2) among all candidates, and whether there is one, (B,)."""
    length = np.sqrt(normals[..., 0] ** 2 + normals[..., 1] ** 2)
    box = np.array([[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0], [0.0, -1.0]])
    edges = np.concatenate((low, -high))
    batch = len(target)
    lines = np.concatenate((normals / length[..., None], np.broadcast_to(box, (batch, 4, 2))), 1)  # (B, K, 2)
    levels = np.concatenate((offsets / length, np.broadcast_to(edges, (batch, 4))), 1)  # (B, K)

    onto = target[:, None] - _slack(target[:, None], lines, levels)[:, 0, :, None] * lines
    points = np.concatenate((target[:, None], onto, _corners(lines, levels)), 1)  # (B, P, 2)
    tolerance = _TOLERANCE * (1.0 + np.abs(levels))[:, None]
    holds: NDArray[np.bool_] = np.all(_slack(points, lines, levels) >= -tolerance, axis=-1)
    distance = np.where(holds, ((points - target[:, None]) ** 2).sum(-1), np.inf)
    best = distance.argmin(1)
    row = np.arange(batch)
    return points[row, best], holds[row, best]


def _corners(lines: Array, levels: Array) -> Array:
    """Where each pair of the K lines meets, (B, K(K − 1)/2, 2); the origin's far side for parallel ones."""
    i, j = np.triu_indices(lines.shape[1], 1)
    a, b, p, q = lines[:, i], lines[:, j], levels[:, i], levels[:, j]
    det = a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
    det = np.where(np.abs(det) < 1e-12, 1e-12, det)  # parallel lines meet far outside the box
    return np.stack((p * b[..., 1] - q * a[..., 1], q * a[..., 0] - p * b[..., 0]), -1) / det[..., None]


def _least_violation(normals: Array, offsets: Array, low: Array, high: Array) -> Array:
    """The least s ≥ 0, (B,), for which ``normals · u ≥ offsets − s`` has a point in the box (bisection)."""
    middle = np.broadcast_to((low + high) / 2, (len(normals), 2))
    below = np.zeros(len(normals))
    above = np.maximum(-_slack(middle[:, None], normals, offsets).min((1, 2)), 0.0)
    for _ in range(_HALVINGS):
        half = (below + above) / 2
        _, feasible = _best_candidate(middle, normals, offsets - half[:, None], low, high)
        below, above = np.where(feasible, below, half), np.where(feasible, half, above)
    return above

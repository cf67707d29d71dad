"""A small quadratic program in three variables, with soft rows inside a box, compiled with numba."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

Array = NDArray[np.float64]


@njit(cache=True)
def clip_root(base: Array, row: Array, bound: float, price: float) -> float:
    """The least λ in [0, price] with row · clip(base + λ·row, −1, 1) ≥ bound, or ``price`` if there is none.

    The left side grows piecewise linearly with λ: Newton steps from segment to segment, from the left.
    """
    at = 0.0
    for _ in range(8):
        value, slope, ahead = -bound, 0.0, np.inf
        for j in range(3):
            u = base[j] + at * row[j]
            value += row[j] * min(1.0, max(-1.0, u))
            if row[j] == 0.0:
                continue
            direction = 1.0 if row[j] > 0.0 else -1.0
            start, end = (-direction - base[j]) / row[j], (direction - base[j]) / row[j]
            if at < start:
                ahead = min(ahead, start)
            elif at < end:
                slope += row[j] * row[j]
                ahead = min(ahead, end)
        if value >= 0.0:
            return at
        step = -value / slope if slope > 0.0 else np.inf
        if at + step <= ahead:
            return min(at + step, price)
        if ahead >= price:
            return price
        at = ahead
    return price


@njit(cache=True)
def solve_qp(wanted: Array, rows: Array, bound: Array, price: Array, n: int, action: Array) -> float:
    """Minimise ½‖u − wanted‖² + Σᵢ priceᵢ·max(0, boundᵢ − rowᵢ·u) over the box u ∈ [−1, 1]³, in place.

    Coordinate ascent on the dual (Hildreth, 1957), whose inner minimum over the box is a clip, so each
    coordinate step is exact. Where the rows contradict each other or the box, the multipliers run into their
    prices: the result is then the action of least priced violation, never a failure.

    Args:
        wanted: (3,).
        rows: (≥ n, 3), of unit length.
        bound: (≥ n,).
        price: (≥ n,), > 0.
        n: number of rows.
        action: receives the minimiser u, (3,).

    Returns:
        The largest violation of a row by ``action``.
    """
    free = wanted.copy()
    multiplier = np.zeros(n)
    for _ in range(100):
        change = 0.0
        for i in range(n):
            before = multiplier[i]
            for j in range(3):
                free[j] -= before * rows[i, j]
            multiplier[i] = clip_root(free, rows[i], bound[i], price[i])
            for j in range(3):
                free[j] += multiplier[i] * rows[i, j]
            change = max(change, abs(multiplier[i] - before))
        if change < 1e-7:
            break
    for j in range(3):
        action[j] = min(1.0, max(-1.0, free[j]))
    worst = 0.0
    for i in range(n):
        worst = max(
            worst, bound[i] - rows[i, 0] * action[0] - rows[i, 1] * action[1] - rows[i, 2] * action[2]
        )
    return worst

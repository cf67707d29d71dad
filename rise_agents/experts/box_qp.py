"""A small quadratic program: soft rows, three variables inside a box. Compiled with numba."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

Array = NDArray[np.float64]

_ROUNDS = 60
_SMALL = 1e-10  # a step that gains less ends the search


@njit(cache=True)
def _cost(u: Array, wanted: Array, rows: Array, bound: Array, n: int, price: float) -> float:
    """½‖u − wanted‖² + ½·price·Σᵢ max(0, boundᵢ − rowᵢ·u)²."""
    total = 0.0
    for j in range(3):
        total += 0.5 * (u[j] - wanted[j]) ** 2
    for i in range(n):
        short = bound[i] - rows[i, 0] * u[0] - rows[i, 1] * u[1] - rows[i, 2] * u[2]
        total += 0.5 * price * max(0.0, short) ** 2
    return total


@njit(cache=True)
def _derivatives(
    u: Array, wanted: Array, rows: Array, bound: Array, n: int, price: float, slope: Array, curve: Array
) -> None:
    """Gradient (3,) and Hessian (3, 3) of the cost at ``u``, in place."""
    for j in range(3):
        slope[j] = u[j] - wanted[j]
        for k in range(3):
            curve[j, k] = 1.0 if j == k else 0.0
    for i in range(n):
        short = bound[i] - rows[i, 0] * u[0] - rows[i, 1] * u[1] - rows[i, 2] * u[2]
        if short > 0.0:
            for j in range(3):
                slope[j] -= price * short * rows[i, j]
                for k in range(3):
                    curve[j, k] += price * rows[i, j] * rows[i, k]


@njit(cache=True)
def _hold(j: int, slope: Array, curve: Array) -> None:
    """Take component ``j`` out of Newton's equations."""
    slope[j] = 0.0
    for k in range(3):
        curve[j, k] = curve[k, j] = 0.0
    curve[j, j] = 1.0


@njit(cache=True)
def _solve(curve: Array, slope: Array, step: Array) -> None:
    """Solve curve · step = −slope for a positive definite ``curve`` (3, 3), in place."""
    a, b, c = curve[0, 0], curve[0, 1], curve[0, 2]
    d, e = curve[1, 1] - b * b / a, curve[1, 2] - b * c / a
    f = curve[2, 2] - c * c / a - e * e / d
    y = -slope[1] + slope[0] * b / a
    step[2] = (-slope[2] + slope[0] * c / a - y * e / d) / f
    step[1] = (y - e * step[2]) / d
    step[0] = (-slope[0] - b * step[1] - c * step[2]) / a


@njit(cache=True)
def _newton_step(u: Array, slope: Array, curve: Array, step: Array) -> None:
    """Newton's step (3,) inside the box, in place; uses up ``slope`` and ``curve``."""
    for j in range(3):
        if (u[j] <= -1.0 and slope[j] > 0.0) or (u[j] >= 1.0 and slope[j] < 0.0):
            _hold(j, slope, curve)
    for _ in range(3):  # a component on a bound may still be drawn out of the box by the others
        _solve(curve, slope, step)
        inside = True
        for j in range(3):
            if (u[j] <= -1.0 and step[j] < 0.0) or (u[j] >= 1.0 and step[j] > 0.0):
                _hold(j, slope, curve)
                step[j] = 0.0
                inside = False
        if inside:
            break


@njit(cache=True)
def _longest(u: Array, step: Array) -> float:
    """The largest share of ``step``, at most 1, that stays in the box."""
    share = 1.0
    for j in range(3):
        room = (1.0 - u[j]) if step[j] > 0.0 else (1.0 + u[j])
        if abs(step[j]) * share > room:
            share = room / abs(step[j])
    return share


@njit(cache=True)
def solve_qp(wanted: Array, rows: Array, bound: Array, n: int, price: float, action: Array) -> float:
    """Minimise ½‖u − wanted‖² + ½·price·Σᵢ max(0, boundᵢ − rowᵢ·u)² over the box u ∈ [−1, 1]³, in place.

    Newton's steps from one set of binding rows and bounds to the next, halved until they gain; exact after a
    handful. With a high price this is the quadratic program with hard rows to within 1/price where those can be
    met. Where they contradict each other or the box, it is the action of least squared violation: there is no
    case without an answer.

    Args:
        wanted: (3,).
        rows: (≥ n, 3), of unit length.
        bound: (≥ n,).
        n: number of rows.
        price: of squared violation, > 0.
        action: receives the minimiser u, (3,).

    Returns:
        The largest violation of a row by ``action``; at most 0 if all are met.
    """
    slope, step, trial, curve = np.empty(3), np.empty(3), np.empty(3), np.empty((3, 3))
    for j in range(3):
        action[j] = min(1.0, max(-1.0, wanted[j]))
    cost = _cost(action, wanted, rows, bound, n, price)
    for _ in range(_ROUNDS):
        _derivatives(action, wanted, rows, bound, n, price, slope, curve)
        _newton_step(action, slope, curve, step)
        share, gain = _longest(action, step), 0.0
        while gain <= 0.0 and share > 1e-9:
            for j in range(3):
                trial[j] = action[j] + share * step[j]
                if abs(trial[j]) > 1.0 - 1e-12:  # rounding must not leave it just short of the bound
                    trial[j] = 1.0 if trial[j] > 0.0 else -1.0
            gain = cost - _cost(trial, wanted, rows, bound, n, price)
            share *= 0.5
        if gain <= _SMALL:
            break
        cost -= gain
        for j in range(3):
            action[j] = trial[j]
    worst = -np.inf
    for i in range(n):
        worst = max(
            worst, bound[i] - rows[i, 0] * action[0] - rows[i, 1] * action[1] - rows[i, 2] * action[2]
        )
    return worst

"""Rates of episodes and how sure we are of them: pure functions of rows (see :mod:`benchmarks.results`)."""

from __future__ import annotations

from statistics import NormalDist

import numpy as np
import pyarrow as pa
from numpy.typing import ArrayLike, NDArray


def _column(rows: pa.Table, name: str) -> NDArray[np.bool_]:
    if rows.num_rows == 0:
        raise ValueError("a rate needs at least one episode, got no rows")
    return rows[name].to_numpy()


def safety_rate(rows: pa.Table) -> float:
    """Share of episodes in which no step had a collision (the paper's Safety Rate), in [0, 1].

    Raises:
        ValueError: no rows.
    """
    return float(_column(rows, "safe").mean())


def reach_rate(rows: pa.Table) -> float:
    """Share of episodes that reached the goal and never collided (the paper's Reach Rate), in [0, 1].

    It can exceed neither the Safety Rate nor the arrival rate.

    Raises:
        ValueError: no rows.
    """
    return float((_column(rows, "arrived") & _column(rows, "safe")).mean())


def arrival_rate(rows: pa.Table) -> float:
    """Share of episodes that reached the goal, collisions ignored, in [0, 1].

    Raises:
        ValueError: no rows.
    """
    return float(_column(rows, "arrived").mean())


def wilson(successes: ArrayLike, trials: ArrayLike, confidence: float = 0.95) -> tuple[NDArray, NDArray]:
    """Wilson score interval of a proportion (Wilson, JASA 1927), which also holds near 0 and 1.

    Episodes count as independent. Those of several training seeds share a policy, so that a pooled interval
    speaks of these trained policies, not of training anew.

    Args:
        successes: counts, any shape that broadcasts against ``trials``.
        trials: counts, at least 1.
        confidence: probability to cover the true proportion, in (0, 1).

    Returns:
        Lower and upper ends, in [0, 1], of the broadcast shape; exactly 0 or 1 where no or every trial
        succeeded.

    Raises:
        ValueError: no trials, successes outside [0, trials], or confidence outside (0, 1).
    """
    k, n = np.broadcast_arrays(np.asarray(successes, float), np.asarray(trials, float))
    if not 0 < confidence < 1:
        raise ValueError(f"confidence must lie in (0, 1), got {confidence}")
    if not (np.all(n >= 1) and np.all((k >= 0) & (k <= n))):
        raise ValueError(f"need trials >= 1 and 0 <= successes <= trials, got {k} of {n}")
    z = NormalDist().inv_cdf(0.5 + confidence / 2)
    p = k / n
    centre = (p + z**2 / (2 * n)) / (1 + z**2 / n)
    half = z / (1 + z**2 / n) * np.sqrt(p * (1 - p) / n + z**2 / (4 * n**2))
    # Rounding must not push the ends past 0 and 1, where the formula is exact on paper.
    return np.where(k == 0, 0.0, centre - half), np.where(k == n, 1.0, centre + half)

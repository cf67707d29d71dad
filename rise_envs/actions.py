"""One check for actions, before anything moves."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray


def finite_action(action: Any, shape: tuple[int, ...], name: str = "action") -> NDArray[np.float64]:
    """``action`` (or what else has this ``name``) as float64.

    Raises:
        ValueError: wrong shape, not of real numbers (a bool is none), or not finite.
    """
    try:
        array = np.asarray(action)
    except ValueError:  # rows of different lengths
        array = np.asarray(None)
    if array.dtype.kind not in "fiu":
        raise ValueError(f"{name} must be numeric with shape {shape}, got {action!r}")
    if array.shape != shape:
        raise ValueError(f"{name} must have shape {shape}, got shape {array.shape}")
    if not np.isfinite(array).all():
        where = np.argwhere(~np.isfinite(array))[0].tolist()
        raise ValueError(f"{name} must be finite, got {array[tuple(where)]} at index {where}")
    return np.ascontiguousarray(array, dtype=np.float64)


def finite_numbers(action: Any, shape: tuple[int]) -> list[float]:
    """The numbers of a single action; raises ``ValueError`` as `finite_action` does, and takes less time."""
    if type(action) is np.ndarray and action.shape == shape and action.dtype.kind == "f":
        numbers = action.tolist()
        if all(map(math.isfinite, numbers)):
            return numbers
    return finite_action(action, shape).tolist()

"""One check for actions, before anything moves."""

from __future__ import annotations

from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray


def finite_action(action: Any, shape: tuple[int, ...]) -> NDArray[np.float64]:
    """``action`` as float64.

    Raises:
        ValueError: wrong shape, not numeric, or not finite.
    """
    try:
        array = np.asarray(action)
    except ValueError:  # rows of different lengths
        array = np.asarray(None)
    if array.dtype.kind not in "fiub":
        raise ValueError(f"action must be numeric with shape {shape}, got {action!r}")
    if array.shape != shape:
        raise ValueError(f"action must have shape {shape}, got shape {array.shape}")
    if not np.isfinite(array).all():
        where = np.argwhere(~np.isfinite(array))[0].tolist()
        raise ValueError(f"action must be finite, got {array[tuple(where)]} at index {where}")
    return np.ascontiguousarray(array, dtype=np.float64)


def checked_action(action: Any, space: spaces.Box) -> NDArray[np.float64]:
    """``action`` as float64, clipped to the bounds of ``space``.

    Raises:
        ValueError: wrong shape, not numeric, or not finite. The environment's state is untouched.
    """
    return np.clip(finite_action(action, space.shape), space.low, space.high)

"""One check for actions, before anything moves."""

from __future__ import annotations

from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray


def checked_action(action: Any, space: spaces.Box) -> NDArray[np.float64]:
    """``action`` as float64, clipped to the bounds of ``space``.

    Raises:
        ValueError: wrong shape, not numeric, or not finite. The environment's state is untouched.
    """
    try:
        array = np.asarray(action)
    except ValueError:  # rows of different lengths
        array = np.asarray(None)
    if array.dtype.kind not in "fiub":
        raise ValueError(f"action must be numeric with shape {space.shape}, got {action!r}")
    if array.shape != space.shape:
        raise ValueError(f"action must have shape {space.shape}, got shape {array.shape}")
    if not np.isfinite(array).all():
        where = np.argwhere(~np.isfinite(array))[0].tolist()
        raise ValueError(f"action must be finite, got {array[tuple(where)]} at index {where}")
    return np.clip(array.astype(np.float64), space.low, space.high)

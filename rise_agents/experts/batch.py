"""Single observations and batches of them, told apart in one place."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def as_batch(observation: Mapping[str, Array]) -> tuple[dict[str, Array], bool]:
    """The observation with a batch axis in front, and whether it came as a single one.

    An observation is a batch if its ``desired_goal`` has two dimensions.
    """
    single = np.ndim(observation["desired_goal"]) == 1
    rows = {name: np.asarray(value, dtype=np.float64) for name, value in observation.items()}
    return ({name: value[None] for name, value in rows.items()} if single else rows), single

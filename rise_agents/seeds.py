"""Which integer seeds belong to training, validation and test: ranges that cannot overlap."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

SPLITS = {"train": 0, "validation": 1 << 30, "test": 2 << 30}
PER_RUN = 1_000_000  # episodes that one run seed may use
RUNS = 1_000  # run seeds


def episode_seeds(split: str, run_seed: int, start: int, count: int) -> NDArray[np.int64]:
    """Seeds of ``count`` episodes from number ``start`` on, of one run seed and split.

    Raises:
        ValueError: an unknown split, or numbers outside the range that belongs to it.
    """
    if split not in SPLITS:
        raise ValueError(f"split must be one of {sorted(SPLITS)}, got {split!r}")
    if not 0 <= run_seed < RUNS:
        raise ValueError(f"seed must be in [0, {RUNS}), got {run_seed}")
    if start < 0 or count < 0 or start + count > PER_RUN:
        raise ValueError(f"a run has {PER_RUN:,} episodes, asked for {start:,} to {start + count:,}")
    return SPLITS[split] + run_seed * PER_RUN + start + np.arange(count, dtype=np.int64)

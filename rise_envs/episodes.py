"""Which episode comes next, in a single environment or in each of many that run side by side."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from rise_envs import streams

Array = Any  # of NumPy or torch
Seeds = int | Sequence[int | None] | None


class EpisodeStreams:
    """The stream of episodes of each of B sub-environments: two whole numbers, no generator.

    Args:
        count: how many: B.
        own: makes arrays of whatever library out of NumPy's.
    """

    def __init__(self, count: int, own: Callable[[Any], Array] = np.asarray) -> None:
        self._count, self._own = count, own
        self._base: Array = None  # of `streams.seed_bases`
        self._number = own(np.zeros(count, np.int64))  # of the next episode

    def seed(self, seed: Seeds, mask: NDArray[np.bool_] | None = None, rng: Any = None) -> None:
        """Begin streams anew where the mask (default: all) and a seed say so.

        Args:
            seed: one whole number, from which sub-environments count on as Gymnasium's do, or one (or None) each.
            mask: (B,).
            rng: names the streams of those who were never seeded; None: the operating system does.

        Raises:
            ValueError: seeds that are not B, or no whole numbers ≥ 0. Nothing has changed then.
        """
        own, count = self._own, self._count
        seeds = each_seed(seed, count)
        named = np.full(count, True) if isinstance(seeds, range) else np.array([s is not None for s in seeds])
        rows = np.flatnonzero(named if mask is None else named & mask)
        bases = streams.seed_bases(seeds if len(rows) == count else [seeds[i] for i in rows.tolist()])
        if self._base is None:
            rng = rng or np.random.default_rng()
            self._base = own(streams.seed_bases(rng.integers(2**63, size=count).tolist()))
        if len(rows):
            self._base[own(rows)], self._number[own(rows)] = own(bases), 0

    def next(self, rows: Array) -> tuple[Array, Array]:
        """Base and number, as `streams.episode_keys` takes them, of the next episodes of ``rows`` (indices)."""
        base, number = self._base[rows], self._number[rows]
        self._number[rows] = number + 1
        return base, number


def check_reset(seed: Any, options: Any) -> int | None:
    """The seed of a single environment's reset as a plain int, or None, before anything has changed.

    Raises:
        ValueError: a seed that is negative or no whole number, or options that are no dict.
    """
    check_options(options)
    return None if seed is None else streams.checked_seed(seed)


def check_options(options: Any) -> None:
    """Raise ``ValueError`` unless options of a reset are a dict, or None."""
    if options is not None and not isinstance(options, dict):
        raise ValueError(f"options must be a dict or None, got {options!r}")


def each_seed(seed: Seeds, count: int) -> Sequence[Any]:
    """A seed, or None, for each sub-environment; raises ``ValueError`` unless it is one, or ``count`` of them."""
    if isinstance(seed, int | np.integer) and not isinstance(seed, bool):
        first = streams.checked_seed(seed)
        return range(first, first + count)
    if (
        isinstance(seed, str | bytes)
        or not isinstance(seed, Sequence | np.ndarray | None)
        or getattr(seed, "ndim", 1) != 1
    ):
        raise ValueError(f"a seed must be a whole number, or one for each sub-environment, got {seed!r}")
    seeds = [None] * count if seed is None else seed
    if len(seeds) != count:
        raise ValueError(f"expected {count} seeds, got {len(seeds)}")
    return seeds


def space_of_many(space: spaces.Space, count: int) -> Any:
    """Gymnasium's ``batch_space`` of a Box or a Dict of Boxes, the bounds of one row standing for those of all.

    For a hundred thousand vehicles the bounds would take as much memory as all the rest.
    """
    many = batch_space(space, count)
    for box in many.values() if isinstance(many, spaces.Dict) else (many,):
        for name in ("low", "high", "bounded_below", "bounded_above"):
            bounds = getattr(box, name)
            setattr(box, name, np.broadcast_to(bounds[:1].copy(), bounds.shape))
    return many


def reset_mask(options: dict[str, Any] | None, count: int, first: bool) -> NDArray[np.bool_]:
    """Which sub-environments a reset starts: ``options["reset_mask"]``, (B,), of NumPy or torch; default all.

    Args:
        options: of ``reset``.
        count: how many: B.
        first: whether nothing was started yet.

    Raises:
        ValueError: no mask of booleans of length B with at least one True.
        gymnasium.error.ResetNeeded: a mask in the first reset, which must start all.
    """
    check_options(options)
    given = (options or {}).get("reset_mask", np.ones(count, bool))
    try:
        mask = np.asarray(given.cpu() if hasattr(given, "cpu") else given)
    except ValueError:  # rows of different lengths
        mask = np.asarray(None)
    if mask.shape != (count,) or mask.dtype != bool or not mask.any():
        raise ValueError(
            f"options['reset_mask'] must be ({count},) bool with at least one True, got {given!r}"
        )
    if first and not mask.all():
        raise gym.error.ResetNeeded("the first reset() must start every sub-environment")
    return mask


def check_running(ended: Array) -> None:
    """Raise ``gymnasium.error.ResetNeeded`` if a sub-environment has ended: (B,) bool, of NumPy or torch."""
    if bool(ended.any()):
        which = [i for i, over in enumerate(ended.tolist()) if over]
        raise gym.error.ResetNeeded(
            f"sub-environments {which} have ended: reset them with "
            "options={'reset_mask': mask} before the next step"
        )

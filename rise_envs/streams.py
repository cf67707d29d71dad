"""Counter-based random numbers: any draw of any episode, in any order, in any batch.

An episode owns one 64-bit *key*. Draw number ``counter`` of that episode is a pure function of
``(key, counter)``: the SplitMix64 generator (Steele, Lea & Flood, "Fast splittable pseudorandom number
generators", OOPSLA 2014) evaluated at position ``counter`` of the sequence that starts at ``key``. Nothing is
stored and nothing is consumed, so results depend neither on how episodes are batched nor on how many worker
processes share them, and a whole batch is drawn with a handful of array operations.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

_GOLDEN = np.uint64(0x9E3779B97F4A7C15)
_MIX1 = np.uint64(0xBF58476D1CE4E5B9)
_MIX2 = np.uint64(0x94D049BB133111EB)
_S30, _S27, _S31, _S11 = (np.uint64(s) for s in (30, 27, 31, 11))
_TO_UNIT = np.float64(2.0**-53)


def bits(key: ArrayLike, counter: ArrayLike) -> NDArray[np.uint64]:
    """64 random bits for each pair of ``key`` and ``counter`` (broadcast against each other)."""
    # At least one dimension: NumPy warns of the (intended) wrap-around of scalars, not of arrays.
    key = np.atleast_1d(np.asarray(key, dtype=np.uint64))
    x = key + (np.atleast_1d(np.asarray(counter, dtype=np.uint64)) + np.uint64(1)) * _GOLDEN
    x = (x ^ (x >> _S30)) * _MIX1
    x = (x ^ (x >> _S27)) * _MIX2
    return x ^ (x >> _S31)


def split(key: ArrayLike, tag: int) -> NDArray[np.uint64]:
    """An independent key for the purpose numbered ``tag``, shape as ``key`` (at least 1-D)."""
    # A second mix of a mixed value, so that the split stream is no shifted copy of the parent's.
    return bits(bits(key, tag), 0x5EED)


def uniform(key: ArrayLike, counter: ArrayLike) -> NDArray[np.float64]:
    """Draws from U[0, 1) with 53 random bits, one for each pair of ``key`` and ``counter``."""
    return (bits(key, counter) >> _S11) * _TO_UNIT


def normal(key: ArrayLike, counter: ArrayLike) -> NDArray[np.float64]:
    """Draws from N(0, 1), one for each pair of ``key`` and ``counter`` (Box and Muller, 1958)."""
    counter = np.asarray(counter, dtype=np.uint64) * np.uint64(2)
    radius = np.sqrt(-2.0 * np.log1p(-uniform(key, counter)))
    return radius * np.cos(2.0 * np.pi * uniform(key, counter + np.uint64(1)))


def key_from_seed(seed: int, tag: int = 1) -> np.uint64:
    """The key that stands for an integer ``seed`` (≥ 0), different for every ``tag`` (≥ 1).

    Raises:
        ValueError: tag 0, which NumPy takes for no tag: it would share the environment's own stream.
    """
    if tag < 1:
        raise ValueError(f"tag must be at least 1, got {tag}")
    return np.random.SeedSequence((seed, tag)).generate_state(1, np.uint64)[0]


def draw_key(rng: np.random.Generator) -> np.uint64:
    """The next episode's key from an environment's own generator (one call per episode)."""
    return rng.integers(0, 2**64, dtype=np.uint64)

"""Counter-based random numbers: any draw of any episode, in any order, in any batch.

An episode owns one 64-bit *key*. Draw number ``counter`` of that episode is a pure function of
``(key, counter)``: the SplitMix64 generator (Steele, Lea & Flood, "Fast splittable pseudorandom number
generators", OOPSLA 2014) evaluated at position ``counter`` of the sequence that starts at ``key``. Nothing is
stored and nothing is consumed, so results depend neither on how episodes are batched nor on how many worker
processes share them, and a whole batch is drawn with a handful of array operations.

With NumPy keys are uint64. With torch, which has no such numbers, they are the same bits as int64, and draws are
tensors on the keys' device: those of `bits`, `split` and `uniform` bit for bit, those of `normal` up to rounding.
"""

from __future__ import annotations

import operator
from collections.abc import Sequence
from typing import Any

import numpy as np
from array_api_compat import array_namespace, is_torch_array
from numpy.typing import ArrayLike, NDArray

from rise_envs import arithmetic

_GOLDEN = np.uint64(0x9E3779B97F4A7C15)
_MIX1 = np.uint64(0xBF58476D1CE4E5B9)
_MIX2 = np.uint64(0x94D049BB133111EB)
_S30, _S27, _S31, _S11 = (np.uint64(s) for s in (30, 27, 31, 11))
_PAIR = np.array([0, 1], np.uint64)
_TO_UNIT = np.float64(2.0**-53)
_EPISODES = 3  # tag of the streams that episodes come from


def bits(key: ArrayLike, counter: ArrayLike) -> NDArray[np.uint64]:
    """64 random bits for each pair of ``key`` and ``counter`` (broadcast against each other)."""
    if is_torch_array(key):
        return arithmetic.mix(key, counter)
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
    if is_torch_array(key):
        return arithmetic.uniform(key, counter)
    return (bits(key, counter) >> _S11) * _TO_UNIT


def normal(key: Any, counter: Any) -> Any:
    """Draws from N(0, 1), one for each pair of ``key`` and ``counter`` (Box and Muller, 1958)."""
    if is_torch_array(key):
        xp, first = array_namespace(key), 2 * counter
        radius = xp.sqrt(-2.0 * xp.log1p(-uniform(key, first)))
        return radius * xp.cos(2.0 * np.pi * uniform(key, first + 1))
    # Both uniform draws in one pass: for the few numbers that one agent wants, the calls are what costs.
    counter = np.atleast_1d(np.asarray(counter, dtype=np.uint64))[..., None] * np.uint64(2) + _PAIR
    draws = uniform(np.asarray(key, dtype=np.uint64)[..., None], counter)
    return np.sqrt(-2.0 * np.log1p(-draws[..., 0])) * np.cos(2.0 * np.pi * draws[..., 1])


def key_from_seed(seed: int, tag: int = 1) -> np.uint64:
    """The key that stands for an integer ``seed`` (≥ 0), different for every ``tag`` (≥ 1).

    Raises:
        ValueError: tag 0, which NumPy takes for no tag: it would share the environment's own stream.
    """
    if tag < 1:
        raise ValueError(f"tag must be at least 1, got {tag}")
    return np.random.SeedSequence((seed, tag)).generate_state(1, np.uint64)[0]


def seed_keys(seeds: Sequence[int], tag: int) -> NDArray[np.uint64]:
    """Keys that stand for integer seeds, different for every ``tag``: as many as there are, (B,).

    Args:
        seeds: whole numbers ≥ 0, (B,); a ``range`` takes no time.
        tag: the purpose.

    Raises:
        ValueError: a seed that is negative or no whole number.
    """
    if isinstance(seeds, range) and seeds.step == 1 and 0 <= seeds.start <= seeds.stop <= 2**64:
        words = np.arange(len(seeds), dtype=np.uint64) + np.uint64(seeds.start)
    else:
        words = np.array([_word(seed) for seed in seeds], np.uint64)
    return split(words, tag)


def seed_bases(seeds: Sequence[int]) -> NDArray[np.int64]:
    """Where the episodes of environments with these seeds, as in `seed_keys`, come from: see `episode_keys`."""
    return seed_keys(seeds, _EPISODES).view(np.int64)


def checked_seed(seed: Any) -> int:
    """A seed as a plain int, of any size; raises ``ValueError`` if it is negative or no whole number."""
    try:
        whole = operator.index(seed)
    except TypeError:
        whole = None
    if whole is None or isinstance(seed, bool | np.bool_):
        raise ValueError(f"a seed must be a whole number, got {seed!r}")
    if whole < 0:
        raise ValueError(f"a seed must not be negative, got {whole}")
    return whole


def _word(seed: int) -> int:
    """A seed as 64 bits: itself, if it is no longer."""
    whole = checked_seed(seed)
    return whole if whole < 2**64 else int(key_from_seed(whole))


def episode_keys(base: NDArray, number: NDArray) -> NDArray:
    """Keys, (B,), of the episodes with these numbers (0, 1, …) since seeding.

    Nothing but two whole numbers per environment has to be kept, and a thousand episodes start as fast as one.

    Args:
        base: of `seed_bases`, int64 of any array library, (B,).
        number: int64, (B,).
    """
    return arithmetic.mix(base, number)

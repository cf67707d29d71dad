"""The counter-based random numbers against an independent SplitMix64 and against their distributions."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from rise_envs import streams

MASK = 2**64 - 1
words = st.integers(0, MASK)


def splitmix64(seed: int, n: int) -> list[int]:
    """The first ``n`` outputs of the published generator, in Python's integers."""
    state, out = seed, []
    for _ in range(n):
        state = (state + 0x9E3779B97F4A7C15) & MASK
        z = state
        z = ((z ^ (z >> 30)) * 0xBF58476D1CE4E5B9) & MASK
        z = ((z ^ (z >> 27)) * 0x94D049BB133111EB) & MASK
        out.append(z ^ (z >> 31))
    return out


def test_reference_has_the_published_outputs() -> None:
    """The first outputs for seed 1234567, as other implementations of SplitMix64 publish them."""
    assert splitmix64(1234567, 3) == [6457827717110365317, 3203168211198807973, 9817491932198370423]


@given(words)
def test_bits_are_splitmix64(key: int) -> None:
    assert streams.bits(np.uint64(key), np.arange(20)).tolist() == splitmix64(key, 20)


@given(st.lists(words, min_size=1, max_size=5), st.lists(st.integers(0, 10**6), min_size=1, max_size=5))
def test_any_draw_in_any_batch_and_order(keys: list[int], counters: list[int]) -> None:
    key, counter = np.array(keys, dtype=np.uint64), np.array(counters)
    for draw in (streams.bits, streams.uniform, streams.normal):
        table = draw(key[:, None], counter)
        assert table.shape == (len(keys), len(counters))
        for i, j in np.ndindex(table.shape):
            assert table[i, j] == draw(key[i], counter[j])[0]
        np.testing.assert_array_equal(draw(key[::-1, None], counter[::-1]), table[::-1, ::-1])


def test_arguments_are_left_alone() -> None:
    key, counter = np.array([3], dtype=np.uint64), np.arange(4, dtype=np.uint64)
    streams.normal(key, counter), streams.split(key, 1)
    assert key.tolist() == [3]
    assert counter.tolist() == [0, 1, 2, 3]


def test_uniform_is_uniform() -> None:
    u = streams.uniform(streams.key_from_seed(0), np.arange(200_000))
    assert 0 <= u.min() < u.max() < 1
    assert stats.kstest(u, "uniform").pvalue > 0.01
    assert np.corrcoef(u[:-1], u[1:])[0, 1] == pytest.approx(0, abs=0.01)
    assert stats.chisquare(np.bincount((u * 64).astype(int), minlength=64)).pvalue > 0.01


def test_uniform_over_keys_at_one_counter() -> None:
    """The first draw of many episodes, whose keys are neighbours or are drawn as environments draw them."""
    drawn = np.random.default_rng(0).integers(0, 2**64, 100_000, dtype=np.uint64)
    for keys in (np.arange(100_000), drawn, streams.split(np.arange(100_000), 3)):
        assert stats.kstest(streams.uniform(keys, 0), "uniform").pvalue > 0.01


def test_normal_is_normal() -> None:
    z = streams.normal(streams.key_from_seed(2), np.arange(200_000))
    assert np.isfinite(z).all()
    assert stats.kstest(z, "norm").pvalue > 0.01
    assert z.mean() == pytest.approx(0, abs=0.01)
    assert z.std() == pytest.approx(1, abs=0.01)
    assert stats.skew(z) == pytest.approx(0, abs=0.02)
    assert stats.kurtosis(z) == pytest.approx(0, abs=0.05)


def test_split_streams_do_not_meet() -> None:
    """Different tags of one key, and the key itself, share no draw among their first 20,000."""
    key = np.array([streams.key_from_seed(0)])
    keys = [key] + [streams.split(key, tag) for tag in range(5)]
    tables = [streams.bits(k, np.arange(20_000)) for k in keys]
    assert len(np.unique(tables)) == 6 * 20_000


def test_split_streams_are_uncorrelated() -> None:
    keys = np.arange(50_000)
    columns = [streams.uniform(streams.split(keys, tag), 0) for tag in range(4)]
    columns.append(streams.uniform(keys, 0))
    off_diagonal = np.array(np.corrcoef(columns))[~np.eye(5, dtype=bool)]
    assert np.abs(off_diagonal).max() < 0.02


def test_seeds_and_tags_give_different_keys() -> None:
    keys = {int(streams.key_from_seed(seed, tag)) for seed in range(300) for tag in (1, 2, 3)}
    assert len(keys) == 900
    assert streams.key_from_seed(5, 1) == streams.key_from_seed(5, 1)
    with pytest.raises(ValueError, match="non-negative"):
        streams.key_from_seed(-1)


def test_seeds_name_streams_of_episodes() -> None:
    """A range, a list, arrays and beyond 64 bits: different seeds, different streams, the same seed the same."""
    seeds = [*range(1000), 2**63, 2**64 - 1, 2**64, 2**200]
    bases = streams.seed_bases(seeds)
    assert bases.dtype == np.int64 and len(np.unique(bases)) == len(seeds)
    np.testing.assert_array_equal(streams.seed_bases(range(1000)), bases[:1000])
    np.testing.assert_array_equal(streams.seed_bases(range(2**64 - 1, 2**64 + 1)), bases[-3:-1])
    np.testing.assert_array_equal(streams.seed_bases(np.arange(5)), bases[:5])
    keys = streams.episode_keys(np.repeat(bases, 50), np.tile(np.arange(50), len(seeds)))
    assert len(np.unique(keys)) == 50 * len(seeds)
    for wrong in (-1, 0.5, "7"):
        with pytest.raises(ValueError, match="seed must"):
            streams.seed_bases([3, wrong])
    with pytest.raises(ValueError, match="negative"):
        streams.seed_bases(range(-1, 3))


def test_streams_are_the_same_on_tensors() -> None:
    keys, counter = streams.seed_keys(range(500), 9), np.arange(500)
    signed, count = torch.from_numpy(keys.view(np.int64)), torch.from_numpy(counter)
    for draw in (streams.bits, streams.uniform):
        np.testing.assert_array_equal(
            draw(signed, count).numpy().view(draw(keys, counter).dtype), draw(keys, counter)
        )
    np.testing.assert_array_equal(streams.split(signed, 3).numpy().view(np.uint64), streams.split(keys, 3))
    np.testing.assert_allclose(
        streams.normal(signed, count).numpy(), streams.normal(keys, counter), rtol=1e-13
    )

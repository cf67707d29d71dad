import numpy as np
import pyarrow as pa
import pytest
from scipy.stats import binomtest

from benchmarks import stats

Z = 1.959963984540054  # 97.5 % quantile of the standard normal distribution


def episodes(*outcomes):
    """Rows of (safe, arrived) outcomes."""
    safe, arrived = zip(*outcomes, strict=True) if outcomes else ((), ())
    return pa.table({"safe": pa.array(safe, pa.bool_()), "arrived": pa.array(arrived, pa.bool_())})


HAND_MADE = episodes(
    (True, True),  # the good one
    (True, True),
    (True, False),  # never collided, never got there: safe, not reached
    (False, True),  # got there after a collision: arrived, neither safe nor reached
    (False, False),
)


def test_rates_of_hand_made_episodes_follow_the_definitions_of_the_paper():
    assert stats.safety_rate(HAND_MADE) == 3 / 5
    assert stats.reach_rate(HAND_MADE) == 2 / 5
    assert stats.arrival_rate(HAND_MADE) == 3 / 5


@pytest.mark.parametrize("outcome, rates", [((True, True), (1, 1, 1)), ((False, True), (0, 0, 1))])
def test_rates_of_a_single_episode(outcome, rates):
    one = episodes(outcome)
    assert (stats.safety_rate(one), stats.reach_rate(one), stats.arrival_rate(one)) == rates


def test_reach_exceeds_neither_safety_nor_arrival():
    rng = np.random.default_rng(0)
    for _ in range(200):
        rows = episodes(*(rng.random((rng.integers(1, 30), 2)) < rng.random(2)).tolist())
        reach = stats.reach_rate(rows)
        assert 0 <= reach <= min(stats.safety_rate(rows), stats.arrival_rate(rows)) <= 1


@pytest.mark.parametrize("rate", [stats.safety_rate, stats.reach_rate, stats.arrival_rate])
def test_no_episodes_have_no_rate(rate):
    with pytest.raises(ValueError, match="at least one episode"):
        rate(episodes())


@pytest.mark.parametrize("n", [1, 2, 7, 40, 1000])
@pytest.mark.parametrize("confidence", [0.5, 0.95, 0.99])
def test_wilson_agrees_with_scipy(n, confidence):
    k = np.unique(np.linspace(0, n, 41).astype(int))
    low, high = stats.wilson(k, n, confidence)
    reference = [binomtest(int(i), n).proportion_ci(confidence, method="wilson") for i in k]
    np.testing.assert_allclose(low, [r.low for r in reference], atol=1e-14)
    np.testing.assert_allclose(high, [r.high for r in reference], atol=1e-14)


def test_wilson_by_hand_at_the_ends_and_in_the_middle():
    low, high = stats.wilson([0, 5, 10], 10)
    end = Z**2 / (10 + Z**2)  # the formula at k = 0, simplified
    half = Z / (2 * np.sqrt(10 + Z**2))  # and at k = n / 2
    np.testing.assert_allclose(low, [0, 0.5 - half, 1 - end], atol=1e-12)
    np.testing.assert_allclose(high, [end, 0.5 + half, 1], atol=1e-12)
    assert low[0] == 0 and high[2] == 1  # exactly


def test_wilson_broadcasts():
    low, high = stats.wilson([[3], [5]], [10, 20, 40])
    assert low.shape == high.shape == (2, 3)
    assert low[1, 2] == stats.wilson(5, 40)[0]


@pytest.mark.parametrize("k, n", [(-1, 10), (11, 10), (0, 0), ([1, 5], [4, 4]), (np.nan, 10)])
def test_wilson_refuses_impossible_counts(k, n):
    with pytest.raises(ValueError, match="successes"):
        stats.wilson(k, n)


@pytest.mark.parametrize("confidence", [0, 1, 95])
def test_wilson_refuses_impossible_confidence(confidence):
    with pytest.raises(ValueError, match="confidence"):
        stats.wilson(1, 2, confidence)

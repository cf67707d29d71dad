import itertools
from statistics import NormalDist

import numpy as np
import pyarrow as pa
import pytest
from scipy.stats import binomtest, bootstrap, t, trim_mean

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


# --- several training seeds on the same scenarios ----------------------------------------------------------------


def test_the_bootstrap_has_the_distribution_of_all_its_draws():
    """Of a table so small that every draw of seeds and scenarios can be listed; an episode is missing."""
    table = np.array([[1.0, 0.0, 5.0], [2.0, np.nan, -1.0]])
    means = []
    for seeds in itertools.product(range(2), repeat=2):
        for scenarios in itertools.product(range(3), repeat=3):
            cells = [table[s, n] for s in seeds for n in scenarios]
            known = [cell for cell in cells if not np.isnan(cell)]
            means.append(sum(known) / len(known) if known else np.nan)
    found = stats.bootstrap_means([table], 20_000)[0]
    assert np.isnan(found).mean() == pytest.approx(np.isnan(means).mean(), abs=0.003)
    values = np.unique(np.round([m for m in means if not np.isnan(m)], 9))
    for value in values:
        share = np.mean(np.array(means) <= value + 1e-6)
        assert np.mean(found <= value + 1e-6) == pytest.approx(share, abs=4 * np.sqrt(0.25 / 20_000))


@pytest.mark.parametrize("shape", [(1, 30), (5, 40), (3, 1), (20, 7)])
def test_the_bootstrap_has_the_moments_of_multinomial_weights(shape):
    s, n = shape
    table = np.random.default_rng(s).normal(size=shape) + np.random.default_rng(n).normal(size=(s, 1))
    # Second moments of the counts: 1 - 1/S, plus 1 on the diagonal.
    seeds, scenarios = (np.eye(k) + 1 - 1 / k for k in shape)
    second = np.einsum("ij,kl,ik,jl", seeds, scenarios, table, table) / (s * n) ** 2
    deviation = np.sqrt(second - table.mean() ** 2)
    means = stats.bootstrap_means([table], 20_000)[0]
    assert means.mean() == pytest.approx(table.mean(), abs=4 * deviation / np.sqrt(20_000))
    assert means.std() == pytest.approx(deviation, rel=0.03)


@pytest.mark.parametrize("n", [15, 200])
def test_with_one_seed_it_is_the_bootstrap_of_scipy(n):
    sample = np.random.default_rng(n).exponential(size=n)
    low, high = stats.bootstrap_intervals([sample[None]])
    reference = bootstrap(
        (sample,), np.mean, n_resamples=20_000, method="percentile", rng=np.random.default_rng(1)
    ).confidence_interval
    width = reference.high - reference.low
    assert (low[0], high[0]) == pytest.approx((reference.low, reference.high), abs=0.03 * width)


def test_the_interval_of_many_normal_scenarios_is_the_normal_one():
    table = np.random.default_rng(2).normal(3.0, 2.0, size=(1, 2_000))
    low, high = stats.bootstrap_intervals([table], 0.9)
    half = 1.6449 * table.std() / np.sqrt(2_000)
    assert (low[0], high[0]) == pytest.approx((table.mean() - half, table.mean() + half), abs=0.05 * half)


def test_means_do_not_depend_on_company_or_memory(monkeypatch):
    rng = np.random.default_rng(0)
    crossed = [(rng.random((s, 50)) < 0.7).astype(float) for s in (5, 1, 3, 5)]
    together = stats.bootstrap_means(crossed, 300)
    assert together.shape == (4, 300)
    np.testing.assert_array_equal(together[2:3], stats.bootstrap_means(crossed[2:3], 300))
    np.testing.assert_allclose(
        together[0] - together[3], stats.bootstrap_means([crossed[0] - crossed[3]], 300)[0], atol=1e-12
    )
    holed = [*crossed, np.where(rng.random((3, 50)) < 0.1, np.nan, 1.0)]
    np.testing.assert_array_equal(together, stats.bootstrap_means(holed, 300)[:4])
    assert (stats.bootstrap_means(holed, 300)[4] == 1).all()
    monkeypatch.setattr(stats, "_BLOCK", 170)
    np.testing.assert_array_equal(together, stats.bootstrap_means(crossed, 300))
    assert stats.bootstrap_means([], 300).shape == (0, 300)
    assert stats.bootstrap_intervals([])[0].shape == (0,)


def crossed_tables(seed_effect, count=400, s=5, n=80):
    """Tables of 0 and 1 whose seeds and scenarios have an effect of their own, and their true rate."""
    rng = np.random.default_rng(11)
    z = 0.8 + seed_effect * rng.normal(size=(count, s, 1)) + rng.normal(size=(count, 1, n))
    z += 0.7 * rng.normal(size=(count, s, n))
    truth = NormalDist().cdf(0.8 / np.sqrt(1 + 0.7**2 + seed_effect**2))
    return list((z > 0).astype(float)), truth


@pytest.mark.parametrize("seed_effect", [0.0, 0.1])
def test_intervals_cover_the_truth_in_simulated_studies(seed_effect):
    studies, truth = crossed_tables(seed_effect)
    low, high = stats.rate_intervals(studies)
    assert 0.92 <= np.mean((low <= truth) & (truth <= high)) <= 0.985
    # Episodes that count as independent claim too much: the seeds share their scenarios.
    low, high = stats.wilson([study.sum() for study in studies], studies[0].size)
    assert np.mean((low <= truth) & (truth <= high)) < 0.85


def studies_of_training(seeds, count=1_000, n=60):
    """Tables of which training is most of the variation; their true mean is 0."""
    rng = np.random.default_rng(seeds)
    return list(
        rng.normal(size=(count, seeds, 1))
        + rng.normal(size=(count, 1, n))
        + rng.normal(size=(count, seeds, n))
    )


@pytest.mark.parametrize(("seeds", "alone", "share"), [(2, 0.63, 0.89), (3, 0.78, 0.92), (5, 0.83, 0.94)])
def test_intervals_of_a_few_seeds_cover_the_truth_where_percentiles_alone_do_not(seeds, alone, share):
    """As often as the page says."""
    studies = studies_of_training(seeds)
    low, high = stats.bootstrap_intervals(studies)
    assert np.mean((low <= 0) & (high >= 0)) == pytest.approx(share, abs=0.025)
    low, high = np.percentile(stats.bootstrap_means(studies, 2_000), [2.5, 97.5], axis=1)
    assert np.mean((low <= 0) & (high >= 0)) == pytest.approx(alone, abs=0.04)


def test_the_standard_error_of_a_sum_of_effects_by_hand():
    """Nothing but what a seed and a scenario add: Satterthwaite's formula for two independent means."""
    seeds, scenarios = np.array([1.0, 2.0, 6.0]), np.array([0.0, 4.0, 8.0, 12.0])
    table = seeds[:, None] + scenarios
    error, freedom = stats.standard_error(table)
    a, b = 7 / 3, (80 / 3) / 4  # variance of each mean
    assert error == pytest.approx(np.sqrt(a + b))
    assert freedom == pytest.approx((a + b) ** 2 / (a**2 / 2 + b**2 / 3))
    holed = np.insert(table, 2, 99.0, axis=1)
    holed[1, 2] = np.nan
    assert stats.standard_error(holed) == (error, freedom)
    assert stats.standard_error(np.ones((3, 4))) == stats.standard_error(table[:1]) == (0.0, np.inf)


def test_the_standard_error_is_how_much_means_vary():
    studies = studies_of_training(5, 4_000)
    squares = np.mean([stats.standard_error(study)[0] ** 2 for study in studies])
    assert squares == pytest.approx(1 / 5 + 1 / 60 + 1 / 300, rel=0.04)


def test_it_is_students_interval_where_scenarios_do_not_differ():
    rates = np.array([0.2, 0.3, 0.5, 0.6])
    low, high = stats.bootstrap_intervals([np.repeat(rates[:, None], 500, axis=1)])
    half = t.ppf(0.975, 3) * rates.std(ddof=1) / 2
    assert high[0] - low[0] == pytest.approx(2 * half)
    assert (low[0], high[0]) == pytest.approx((0.4 - half, 0.4 + half), abs=0.02)


def test_differences_cover_the_truth_in_simulated_studies():
    ours, truth = crossed_tables(0.1)
    theirs = list((np.random.default_rng(5).random(np.shape(ours)) < 0.7).astype(float))
    low, high = stats.difference_intervals([a - b for a, b in zip(ours, theirs, strict=True)])
    assert 0.92 <= np.mean((low <= truth - 0.7) & (truth - 0.7 <= high)) <= 0.985


def test_rate_intervals_are_wilson_s_where_a_bootstrap_says_nothing():
    one = np.array([[1.0, 0.0, 1.0, 1.0, np.nan]])
    every, none = np.ones((3, 5)), np.zeros((3, 5))
    mixed = np.tile([[1.0, 0, 1, 1, 0]], (3, 8))
    low, high = stats.rate_intervals([one, every, none])
    for k, (successes, trials) in enumerate([(3, 4), (5, 5), (0, 5)]):
        assert (low[k], high[k]) == stats.wilson(successes, trials)
    assert stats.rate_intervals([mixed]) == stats.bootstrap_intervals([mixed])


def test_intervals_end_where_rates_and_differences_do():
    apart = np.array([[1.0] * 9 + [0.0], [0.0] * 9 + [1.0]])  # two seeds that say nothing together
    low, high = stats.bootstrap_intervals([apart])
    assert low[0] < -1 and high[0] > 2
    assert stats.rate_intervals([apart]) == (0, 1)
    assert stats.difference_intervals([2 * apart - 1]) == (-1, 1)


def test_difference_intervals_of_differences_that_are_all_equal():
    unseen = float(stats.wilson(0, 8)[1])
    low, high = stats.difference_intervals([np.zeros((2, 8)), np.ones((2, 8)), -np.ones((1, 8))])
    np.testing.assert_allclose(low, [-unseen, 1 - unseen, -1])
    np.testing.assert_allclose(high, [unseen, 1, unseen - 1])


def test_differences_are_paired_by_seed_and_scenario():
    a, b = np.array([[1.0, 0.0], [1.0, 1.0], [0.0, 0.0]]), np.array([[0.0, 0.0], [1.0, np.nan]])
    seeds = np.array([0, 1, 4]), np.array([1, 4])
    np.testing.assert_array_equal(stats.paired_differences(a, seeds[0], b, seeds[1]), [[1, 1], [-1, np.nan]])
    np.testing.assert_array_equal(stats.paired_differences(b, seeds[1], a, seeds[0]), [[-1, -1], [1, np.nan]])
    alone = stats.paired_differences(a, seeds[0], b[:1], np.array([9]))
    np.testing.assert_array_equal(alone, [[1, 0], [1, 1], [0, 0]])
    assert stats.paired_differences(a, seeds[0], b, np.array([2, 3])).shape == (0, 2)


def test_mcnemar_by_hand_and_by_scipy():
    assert stats.mcnemar(1, 6) == pytest.approx(2 * (1 + 7) / 2**7)
    assert stats.mcnemar(0, 5) == stats.mcnemar(5, 0) == pytest.approx(2 / 2**5)
    assert stats.mcnemar([0, 4], [0, 4]).tolist() == [1, 1]
    pairs = [(a, b) for a in (0, 1, 3, 17, 250) for b in (1, 2, 18, 300, 2_500)]
    expected = [binomtest(a, a + b).pvalue for a, b in pairs]
    np.testing.assert_allclose(stats.mcnemar(*zip(*pairs, strict=True)), expected, rtol=1e-9)


def test_holm_by_hand():
    # 4 · 0.005, 3 · 0.01, 2 · 0.03, and 1 · 0.04, which must not fall below the one before.
    np.testing.assert_allclose(stats.holm([0.01, 0.04, 0.03, 0.005]), [0.03, 0.06, 0.06, 0.02])
    np.testing.assert_allclose(stats.holm([0.6, 0.5, 0.5]), [1, 1, 1])
    assert stats.holm([0.2]).tolist() == [0.2] and stats.holm([]).shape == (0,)


@pytest.mark.parametrize("n", range(1, 14))
def test_the_iqm_is_rliable_s(n):
    values = np.random.default_rng(n).normal(size=n)
    assert stats.iqm(values) == pytest.approx(trim_mean(values, 0.25))


def test_the_iqm_by_hand():
    assert stats.iqm([[-100, 2], [4, 1_000]]) == 3

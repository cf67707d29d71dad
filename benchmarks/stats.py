"""Rates of episodes, differences between agents, and how sure we are of them: pure functions.

Every agent meets the same scenarios, so the outcomes of one agent form a *crossed table* (S, N): a row per training
seed, a column per scenario, NaN where an episode is missing. What is random about it are both, the seeds and the
scenarios, and intervals speak of training anew as well as of other scenarios.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from statistics import NormalDist

import numpy as np
import pyarrow as pa
from numpy.typing import ArrayLike, NDArray
from scipy.special import bdtr, stdtrit

Table = NDArray[np.float64]  # (S, N), NaN where an episode is missing
Ends = tuple[NDArray[np.float64], NDArray[np.float64]]  # lower and upper ends, (K,) each

REPLICATES = 10_000
_SEED = 2007  # of the bootstrap: the same episodes give the same intervals
_BLOCK = 2_000_000  # numbers that the weights of one block of replicates may take


def _column(rows: pa.Table, name: str) -> NDArray[np.bool_]:
    if rows.num_rows == 0:
        raise ValueError("a rate needs at least one episode, got no rows")
    return rows[name].to_numpy()


def safety_rate(rows: pa.Table) -> float:
    """Share of episodes in which no step had a collision (the paper's Safety Rate), in [0, 1].

    Raises:
        ValueError: no rows.
    """
    return float(_column(rows, "safe").mean())


def reach_rate(rows: pa.Table) -> float:
    """Share of episodes that reached the goal and never collided (the paper's Reach Rate), in [0, 1].

    It can exceed neither the Safety Rate nor the arrival rate.

    Raises:
        ValueError: no rows.
    """
    return float((_column(rows, "arrived") & _column(rows, "safe")).mean())


def arrival_rate(rows: pa.Table) -> float:
    """Share of episodes that reached the goal, collisions ignored, in [0, 1].

    Raises:
        ValueError: no rows.
    """
    return float(_column(rows, "arrived").mean())


def wilson(successes: ArrayLike, trials: ArrayLike, confidence: float = 0.95) -> tuple[NDArray, NDArray]:
    """Wilson score interval of a proportion (Wilson, JASA 1927), which also holds near 0 and 1.

    Trials count as independent: for the scenarios of one trained policy, not for several training seeds.

    Args:
        successes: counts, any shape that broadcasts against ``trials``.
        trials: counts, at least 1.
        confidence: probability to cover the true proportion, in (0, 1).

    Returns:
        Lower and upper ends, in [0, 1], of the broadcast shape; exactly 0 or 1 where no or every trial
        succeeded.

    Raises:
        ValueError: no trials, successes outside [0, trials], or confidence outside (0, 1).
    """
    k, n = np.broadcast_arrays(np.asarray(successes, float), np.asarray(trials, float))
    if not 0 < confidence < 1:
        raise ValueError(f"confidence must lie in (0, 1), got {confidence}")
    if not (np.all(n >= 1) and np.all((k >= 0) & (k <= n))):
        raise ValueError(f"need trials >= 1 and 0 <= successes <= trials, got {k} of {n}")
    z = NormalDist().inv_cdf(0.5 + confidence / 2)
    p = k / n
    centre = (p + z**2 / (2 * n)) / (1 + z**2 / n)
    half = z / (1 + z**2 / n) * np.sqrt(p * (1 - p) / n + z**2 / (4 * n**2))
    # Rounding must not push the ends past 0 and 1, where the formula is exact on paper.
    return np.where(k == 0, 0.0, centre - half), np.where(k == n, 1.0, centre + half)


def bootstrap_means(tables: Sequence[Table], replicates: int = REPLICATES, seed: int = _SEED) -> Table:
    """Means of crossed tables in a bootstrap of both factors ("pigeonhole", Owen, Ann. Appl. Stat. 2007).

    A replicate draws as many training seeds and as many scenarios as there are, each with replacement and
    independently of each other, and takes the mean over the episodes where they cross, as often as both were drawn.
    All tables share the draws of scenarios, and those of equally many seeds the draws of seeds.

    Args:
        tables: K tables (S_k, N) with the same scenarios; S_k = 1 leaves the scenarios alone to chance.
        replicates: how many: R.
        seed: of the draws.

    Returns:
        (K, R); NaN where a replicate met only missing episodes.
    """
    if not tables:
        return np.empty((0, replicates))
    known = [~np.isnan(table) for table in tables]
    complete = all(cells.all() for cells in known)
    values = [np.nan_to_num(table) for table in tables]
    sizes = np.array([[table.size] for table in tables], float)
    seeds = {size: _seed_counts(size, replicates, seed) for size in {len(table) for table in tables}}
    means = np.empty((len(tables), replicates))
    for block, scenarios in _scenario_counts(tables[0].shape[1], replicates, seed):
        of_block = {size: counts[block] for size, counts in seeds.items()}
        sums = _weighted_sums(values, of_block, scenarios)
        episodes = sizes if complete else _weighted_sums(known, of_block, scenarios)
        with np.errstate(invalid="ignore"):  # 0 / 0
            means[:, block] = sums / episodes
    return means


def _weighted_sums(tables: Sequence[NDArray], seeds: Mapping[int, NDArray], scenarios: Table) -> Table:
    """Sums (K, B) over tables (S_k, N), each cell as often as its seed (B, S_k) and scenario (B, N) were drawn."""
    # One product for all tables. Outcomes are whole numbers, and so are these sums: exact, whoever multiplies.
    products = scenarios @ np.concatenate(tables).T
    by_table = np.split(products, np.cumsum([len(table) for table in tables])[:-1], axis=1)
    return np.array([np.einsum("bs,bs->b", seeds[each.shape[1]], each) for each in by_table])


def _seed_counts(size: int, replicates: int, seed: int) -> NDArray:
    """How often each of ``size`` training seeds is drawn in each replicate, (R, S)."""
    return np.random.default_rng([seed, 1, size]).multinomial(size, np.full(size, 1 / size), replicates)


def _scenario_counts(size: int, replicates: int, seed: int) -> Iterator[tuple[slice, Table]]:
    """How often each of ``size`` scenarios is drawn, in blocks (B, N) of replicates that fit into memory."""
    rng = np.random.default_rng([seed, 0, size])
    step = max(1, _BLOCK // size)
    for start in range(0, replicates, step):
        rows = min(step, replicates - start)
        drawn = rng.integers(0, size, (rows, size)) + size * np.arange(rows)[:, None]
        counts = np.bincount(drawn.ravel(), minlength=rows * size).reshape(rows, size)
        yield slice(start, start + rows), counts.astype(float)


def bootstrap_intervals(tables: Sequence[Table], confidence: float = 0.95) -> Ends:
    """Percentile intervals of the means of crossed tables, stretched where a few training seeds say too little.

    A bootstrap of S seeds sees (S - 1) / S of how much training varies, and knows no more than S numbers: of 95 %,
    percentiles alone cover the truth in some 83 % with five seeds, in 63 % with two, where training is most of the
    variation. So where Student's interval (:func:`standard_error`) is wider, both ends move away from the mean, by one
    factor, until they are as far from each other as its own.

    Args:
        tables: K tables (S_k, N) with the same scenarios.
        confidence: probability to cover the true mean, in (0, 1).
    """
    if not tables:
        return np.empty(0), np.empty(0)
    tail = (1 - confidence) / 2
    ends = np.nanpercentile(bootstrap_means(tables), [100 * tail, 100 - 100 * tail], axis=1)
    for k, table in enumerate(tables):
        error, freedom = standard_error(table)
        wanted, width = 2 * stdtrit(freedom, 1 - tail) * error, np.ptp(ends[:, k])
        if wanted > width > 0:
            centre = np.nanmean(table)
            ends[:, k] = centre + (ends[:, k] - centre) * (wanted / width)
    return ends[0], ends[1]


def standard_error(table: Table) -> tuple[float, float]:
    """Standard error of the mean of a crossed table, and its degrees of freedom.

    By the analysis of variance of two random factors, seeds and scenarios; degrees of freedom after Satterthwaite
    (Biometrics Bulletin 1946). What seeds and scenarios add is never taken to be less than nothing.

    Args:
        table: (S, N); scenarios in which an episode is missing stay out.

    Returns:
        The error, and its degrees of freedom, at least S - 1; 0 and infinity with one seed, or one scenario.
    """
    table = table[:, ~np.isnan(table).any(0)]
    s, n = table.shape
    if min(s, n) < 2:
        return 0.0, np.inf
    rows, columns, mean = table.mean(1, keepdims=True), table.mean(0, keepdims=True), table.mean()
    rest = ((table - rows - columns + mean) ** 2).sum() / ((s - 1) * (n - 1))
    seeds = rows.var(ddof=1) / s  # what chance adds to the mean of a seed is in it
    scenarios = max(columns.var(ddof=1) - rest / s, 0.0) / n
    variance = seeds + scenarios
    if variance == 0:
        return 0.0, np.inf
    freedom = variance**2 / (seeds**2 / (s - 1) + scenarios**2 / (n - 1))
    return float(np.sqrt(variance)), float(freedom)


def rate_intervals(tables: Sequence[Table]) -> Ends:
    """95 % intervals of the rates of crossed tables of 0 and 1, in [0, 1].

    With one training seed: Wilson's. With several: the bootstrap's. Where all or no episodes succeeded, a bootstrap
    sees no variation: Wilson's again, of the scenarios, which the seeds share.

    Args:
        tables: K tables (S_k, N) with the same scenarios, none of them empty.
    """
    known = [trim(table) for table in tables]
    # The scenarios in which any seed succeeded: all or none wherever Wilson's interval of several seeds stays.
    low, high = wilson([np.nanmax(table, 0).sum() for table in known], [table.shape[1] for table in known])
    varied = [k for k, table in enumerate(known) if len(table) > 1 and _varies(table)]
    ends = bootstrap_intervals([tables[k] for k in varied])
    low[varied], high[varied] = np.clip(ends, 0, 1)
    return low, high


def difference_intervals(tables: Sequence[Table]) -> Ends:
    """95 % bootstrap intervals of the means of paired differences of outcomes, in [-1, 1].

    Where all differences are equal a bootstrap sees no variation. Wilson's interval of something that happened in
    none of the scenarios then says how much rarer differences may have gone unseen.

    Args:
        tables: K tables (S_k, N) of -1, 0 and 1 with the same scenarios, none of them empty.
    """
    low, high = np.clip(bootstrap_intervals(tables), -1, 1)
    for k, table in enumerate(tables):
        if not _varies(table):
            unseen = wilson(0, trim(table).shape[1])[1]
            low[k], high[k] = np.clip([low[k] - unseen, high[k] + unseen], -1, 1)
    return low, high


def trim(table: Table) -> Table:
    """A crossed table without the seeds and scenarios of which every episode is missing."""
    known = ~np.isnan(table)
    return table[known.any(1)][:, known.any(0)]


def _varies(table: Table) -> bool:
    return bool(np.nanmin(table) < np.nanmax(table))


def paired_differences(a: Table, seeds_a: NDArray, b: Table, seeds_b: NDArray) -> Table:
    """``a - b``, episode by episode: the same scenario and training seed.

    Training seed k of two agents is one draw of demonstrations, so seeds are matched by number. A table of one seed
    is compared with every seed of the other. Of two that have several, those that both have are compared; others
    stay out, and the mean can then differ from the difference of the two rates.

    Args:
        a: (S_a, N).
        seeds_a: training seeds (S_a,) of the rows of ``a``.
        b: (S_b, N), the same scenarios.
        seeds_b: training seeds (S_b,) of the rows of ``b``.

    Returns:
        (S, N), NaN where either episode is missing; S = 0 if there is nothing to compare.
    """
    if min(len(a), len(b)) == 1:
        return a - b
    _, rows_a, rows_b = np.intersect1d(seeds_a, seeds_b, return_indices=True)
    return a[rows_a] - b[rows_b]


def mcnemar(only_a: ArrayLike, only_b: ArrayLike) -> NDArray[np.float64]:
    """Exact two-sided p-values of McNemar's test: are pairs that differ as often for ``a`` as for ``b``?

    It counts pairs as independent. Pooled over training seeds, which share scenarios, it speaks of these trained
    policies, not of training anew, and is too sure of itself where the seeds fail in the same scenarios.

    Args:
        only_a: pairs in which only ``a`` succeeded, whole numbers of any shape.
        only_b: pairs in which only ``b`` did.
    """
    a, b = np.asarray(only_a, np.int64), np.asarray(only_b, np.int64)
    # The binomial distribution of 1/2 is symmetric: both tails are as large as the smaller one.
    return np.minimum(1.0, 2 * bdtr(np.minimum(a, b), a + b, 0.5))


def holm(p: ArrayLike) -> NDArray[np.float64]:
    """P-values (M,) corrected for M comparisons (Holm, Scand. J. Stat. 1979): family-wise error."""
    p = np.asarray(p, float)
    order = np.argsort(p)
    corrected = np.empty_like(p)
    corrected[order] = np.maximum.accumulate(p[order] * np.arange(len(p), 0, -1))
    return np.minimum(corrected, 1.0)


def iqm(values: ArrayLike) -> float:
    """Interquartile mean: of what is left without the lowest and the highest quarter, each rounded down.

    Robust to outliers, and steadier than the median (Agarwal et al., NeurIPS 2021, "rliable"). Fewer than four
    values lose none.
    """
    ordered = np.sort(np.ravel(values))
    cut = len(ordered) // 4
    return float(ordered[cut : len(ordered) - cut].mean())

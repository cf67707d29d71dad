"""The tables of a run, computed from its episodes: a line per agent and condition, a line per pair of agents."""

from __future__ import annotations

import itertools
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeVar, get_type_hints

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from benchmarks import stats
from benchmarks.labels import headline, is_reference
from benchmarks.pages import csv_lines, csv_text
from benchmarks.results import StrPath, atomic_write_text, group_edges, sort_rows

_CONDITION = ("env", "noise_model", "noise_level")
_METRICS = {"safety": "safe", "reach": "reached"}  # name -> column of the episodes


@dataclass(frozen=True, slots=True)
class SummaryRow:
    """What the episodes of one (env, agent, noise model, noise level) amount to; a line of summary.csv.

    Rates lie in [0, 1]; ``low`` and ``high`` are their 95 % interval (:func:`benchmarks.stats.rate_intervals`).
    ``diff`` is the rate less that of the agent ``against``, the first of the run, as in :class:`ComparisonRow`;
    None for that agent itself, and between reference rows.
    """

    env: str
    agent: str
    noise_model: str
    noise_level: float
    train_seeds: int  # how many
    episodes: int
    safety_rate: float
    safety_low: float
    safety_high: float
    reach_rate: float
    reach_low: float
    reach_high: float
    arrival_rate: float
    mean_cost: float
    mean_steps: float
    safety_iqm: float  # interquartile mean of the rates of the training seeds
    reach_iqm: float
    clearance_iqm: float  # m, interquartile mean of the episodes' smallest clearance
    against: str = ""
    safety_diff: float | None = None
    safety_diff_low: float | None = None
    safety_diff_high: float | None = None
    safety_diff_p: float | None = None
    reach_diff: float | None = None
    reach_diff_low: float | None = None
    reach_diff_high: float | None = None
    reach_diff_p: float | None = None


@dataclass(frozen=True, slots=True)
class ComparisonRow:
    """Two agents on the same scenarios under one condition; a line of comparisons.csv.

    ``diff`` is the rate of ``agent`` (a) less that of ``other`` (b) over the episodes that both have
    (:func:`benchmarks.stats.paired_differences`), ``low`` and ``high`` are its 95 % interval
    (:func:`benchmarks.stats.difference_intervals`). ``p`` is of McNemar's test (:func:`benchmarks.stats.mcnemar`),
    Holm-corrected over all p-values of both metrics in one env.
    """

    env: str
    noise_model: str
    noise_level: float
    agent: str
    other: str
    seeds: int  # pairs of training seeds
    scenarios: int
    safety_diff: float
    safety_low: float
    safety_high: float
    safety_only_a: int  # episodes safe with agent, not with other
    safety_only_b: int
    safety_p: float
    reach_diff: float
    reach_low: float
    reach_high: float
    reach_only_a: int
    reach_only_b: int
    reach_p: float


Row = TypeVar("Row", SummaryRow, ComparisonRow)


@dataclass(frozen=True, eq=False)
class _Group:
    """The episodes of one agent under one condition.

    Attributes:
        name: of the agent.
        rows: its episodes.
        seeds: training seeds (S,), ascending.
        outcomes: per metric a crossed table (S, N) of 0 and 1, N scenarios of the condition.
    """

    name: str
    rows: pa.Table
    seeds: NDArray[np.int64]
    outcomes: dict[str, stats.Table]


def analyse(
    rows: pa.Table, agents: Sequence[str] = (), compared: Sequence[Collection[str]] = ()
) -> tuple[list[SummaryRow], list[ComparisonRow]]:
    """Both tables of a run: everything that its pages and figures say follows from them.

    Args:
        rows: episodes (:data:`benchmarks.results.SCHEMA`), in any order.
        agents: the order of the agents; those not named follow, by name.
        compared: groups of agents; only agents of a common group are compared. None: all with all.

    Returns:
        A line per (env, agent, noise model, noise level), in that order; and per env, noise model and level a line
        per pair of agents in their order, in which reference rows come second and are not compared with each other.

    Raises:
        ValueError: an episode that occurs twice, or a scenario that differs between agents.
    """
    rank = {agent: index for index, agent in enumerate(agents)}
    summary: list[SummaryRow] = []
    comparisons: list[ComparisonRow] = []
    # Sorted down to the episode, so that sums of floats do not depend on how the rows came.
    rows = sort_rows(rows, (*_CONDITION, "agent", "train_seed", "scenario")).combine_chunks()
    for condition in _split(rows, _CONDITION):
        groups = sorted(_groups(condition), key=lambda group: (rank.get(group.name, len(rank)), group.name))
        summary += _summarise(groups)
        comparisons += _compare(groups, compared)
    comparisons = _corrected(comparisons)
    summary.sort(key=lambda r: (r.env, rank.get(r.agent, len(rank)), r.agent, r.noise_model, r.noise_level))
    return _with_differences(summary, comparisons), comparisons


def summarise(rows: pa.Table, agents: Sequence[str] = ()) -> list[SummaryRow]:
    """The first table of :func:`analyse`."""
    return analyse(rows, agents)[0]


def headline_level(summary: Sequence[SummaryRow]) -> float:
    """The level that is spoken of (:func:`benchmarks.labels.headline`) of those that were measured."""
    return headline(row.noise_level for row in summary)


def write_table(path: StrPath, kind: type[Row], rows: Sequence[Row]) -> None:
    """Write rows as CSV: columns as in ``kind``, floats to six significant digits, None as an empty cell."""
    atomic_write_text(path, csv_text(kind, rows))


def read_table(path: StrPath, kind: type[Row]) -> list[Row]:
    """The inverse of :func:`write_table`, but for the digits it left out.

    Raises:
        ValueError: no such file, or not a table of ``kind``.
    """
    hints = get_type_hints(kind)
    lines = csv_lines(Path(path), kind, "comparisons" if kind is ComparisonRow else "results")
    try:
        return [kind(**{name: _cell(text, hints[name]) for name, text in line.items()}) for line in lines]
    except (KeyError, TypeError, ValueError) as error:  # KeyError: a line with more cells than columns
        raise ValueError(f"{path} is damaged: {error}") from None


def _cell(text: str, hint: Any) -> Any:
    if hint in (str, int, float):
        return hint(text)
    return float(text) if text else None


def _split(rows: pa.Table, keys: Sequence[str]) -> Iterator[pa.Table]:
    """The runs of sorted rows that have the same keys."""
    for start, end in itertools.pairwise(group_edges(rows, keys)):
        yield rows[int(start) : int(end)]


def _groups(condition: pa.Table) -> list[_Group]:
    """The agents that met one condition, their outcomes laid out over the same scenarios."""
    scenarios, first, column = np.unique(
        condition["scenario"].to_numpy(), return_index=True, return_inverse=True
    )
    env, model, level = (condition[name][0].as_py() for name in _CONDITION)
    for name in ("env_seed", "noise_seed"):
        seeds = condition[name].to_numpy()
        odd = np.flatnonzero(seeds != seeds[first][column])
        if odd.size:
            where = f"scenario {scenarios[column[odd[0]]]} of {env} at {model} {level:g}"
            raise ValueError(f"{where} has more than one {name}: such episodes cannot be compared")
    groups, start = [], 0
    for rows in _split(condition, ("agent",)):
        places = column[start : start + rows.num_rows]
        start += rows.num_rows
        seeds, line = np.unique(rows["train_seed"].to_numpy(), return_inverse=True)
        outcomes = {metric: np.full((len(seeds), len(scenarios)), np.nan) for metric in _METRICS}
        for metric, name in _METRICS.items():
            outcomes[metric][line, places] = rows[name].to_numpy()
        agent = rows["agent"][0].as_py()
        if np.count_nonzero(~np.isnan(outcomes["safety"])) < rows.num_rows:
            raise ValueError(f"an episode of {agent} in {env} at {model} {level:g} occurs twice")
        groups.append(_Group(agent, rows, seeds, outcomes))
    return groups


def _summarise(groups: Sequence[_Group]) -> list[SummaryRow]:
    """The lines of the agents that met one condition, not yet compared."""
    ends = {m: stats.rate_intervals([group.outcomes[m] for group in groups]) for m in _METRICS}
    summary = []
    for k, group in enumerate(groups):
        rows, numbers = group.rows, dict[str, float]()
        for metric, (low, high) in ends.items():
            numbers[f"{metric}_low"], numbers[f"{metric}_high"] = float(low[k]), float(high[k])
            numbers[f"{metric}_iqm"] = stats.iqm(np.nanmean(group.outcomes[metric], axis=1))
        columns: dict[str, Any] = {name: rows[name][0].as_py() for name in (*_CONDITION, "agent")} | numbers
        summary.append(
            SummaryRow(
                **columns,
                train_seeds=len(group.seeds),
                episodes=rows.num_rows,
                safety_rate=stats.safety_rate(rows),
                reach_rate=stats.reach_rate(rows),
                arrival_rate=stats.arrival_rate(rows),
                mean_cost=float(rows["episode_cost"].to_numpy().mean()),
                mean_steps=float(rows["steps"].to_numpy().mean()),
                clearance_iqm=stats.iqm(rows["min_clearance"].to_numpy()),
            )
        )
    return summary


def _compare(groups: Sequence[_Group], compared: Sequence[Collection[str]]) -> list[ComparisonRow]:
    """The lines of all pairs of common groups under one condition; p-values not yet corrected."""
    tested = [group for group in groups if not is_reference(group.name)]
    references = [group for group in groups if is_reference(group.name)]
    pairs = [
        (a, b)
        for a, b in [*itertools.combinations(tested, 2), *itertools.product(tested, references)]
        if not compared or any(a.name in names and b.name in names for names in compared)
    ]
    # In the order of the agents, references last.
    order = {group.name: index for index, group in enumerate([*tested, *references])}
    pairs.sort(key=lambda pair: (order[pair[0].name], order[pair[1].name]))
    found, tables = [], {m: list[stats.Table]() for m in _METRICS}
    for a, b in pairs:
        differences = {
            m: stats.paired_differences(a.outcomes[m], a.seeds, b.outcomes[m], b.seeds) for m in _METRICS
        }
        if not np.isnan(differences["safety"]).all():
            found.append((a, b))
            for metric, table in differences.items():
                tables[metric].append(table)
    columns = [_difference_columns(metric, tables[metric]) for metric in _METRICS]
    lines = []
    for k, (a, b) in enumerate(found):
        seeds, scenarios = stats.trim(tables["safety"][k]).shape
        condition = {name: a.rows[name][0].as_py() for name in _CONDITION}
        numbers: dict[str, Any] = {name: cells[k] for each in columns for name, cells in each.items()}
        lines.append(
            ComparisonRow(
                **condition, agent=a.name, other=b.name, seeds=seeds, scenarios=scenarios, **numbers
            )
        )
    return lines


def _difference_columns(metric: str, tables: Sequence[stats.Table]) -> dict[str, list]:
    """The columns of one metric, an entry per table (S, N) of paired differences."""
    low, high = stats.difference_intervals(tables)
    only_a, only_b = ([int(np.sum(table == sign)) for table in tables] for sign in (1, -1))
    return {
        f"{metric}_diff": [float(np.nanmean(table)) for table in tables],
        f"{metric}_low": low.tolist(),
        f"{metric}_high": high.tolist(),
        f"{metric}_only_a": only_a,
        f"{metric}_only_b": only_b,
        f"{metric}_p": stats.mcnemar(only_a, only_b).tolist(),
    }


def _corrected(comparisons: Sequence[ComparisonRow]) -> list[ComparisonRow]:
    """The same lines, p-values Holm-corrected over all lines and both metrics of their env."""
    lines = []
    for _, of_env in itertools.groupby(comparisons, key=lambda row: row.env):
        rows = list(of_env)
        p = (
            stats.holm([value for row in rows for value in (row.safety_p, row.reach_p)])
            .reshape(-1, 2)
            .tolist()
        )
        lines += [replace(row, safety_p=s, reach_p=r) for row, (s, r) in zip(rows, p, strict=True)]
    return lines


def _with_differences(summary: list[SummaryRow], comparisons: Sequence[ComparisonRow]) -> list[SummaryRow]:
    """The same lines, each agent compared with the first one of its env that is no reference."""
    first: dict[str, str] = {}
    for row in summary:
        if not is_reference(row.agent):
            first.setdefault(row.env, row.agent)
    by_other = {
        (c.env, c.noise_model, c.noise_level, c.other): c for c in comparisons if c.agent == first[c.env]
    }
    lines = []
    for row in summary:
        pair = by_other.get((row.env, row.noise_model, row.noise_level, row.agent))
        lines.append(row if pair is None else replace(row, against=pair.agent, **_mirrored(pair)))
    return lines


def _mirrored(pair: ComparisonRow) -> dict[str, Any]:
    """The columns of a summary that say how ``other`` differs from ``agent``."""
    return {  # 0 - x: never "-0"
        "safety_diff": 0 - pair.safety_diff,
        "safety_diff_low": 0 - pair.safety_high,
        "safety_diff_high": 0 - pair.safety_low,
        "safety_diff_p": pair.safety_p,
        "reach_diff": 0 - pair.reach_diff,
        "reach_diff_low": 0 - pair.reach_high,
        "reach_diff_high": 0 - pair.reach_low,
        "reach_diff_p": pair.reach_p,
    }

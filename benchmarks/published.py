"""Episodes that were published before, in place of running them again: ``python -m benchmarks.run --published DIR``.

An evaluation is taken if DIR has the very same one: the same checkpoint (its name holds a digest of the version, the
demonstrations and all settings of its training), acting by the same settings, in the same scenarios under the same
noise. Rows that are not trained follow from the package version alone.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from benchmarks import report, results
from benchmarks.jobs import Job, checkpoint_name, complete_settings
from benchmarks.labels import count, split_row
from benchmarks.protocol import Plan, Scenarios
from rise_agents import checkpoint

_PACKAGE = "rise-suite"  # whose version results depend on, in ``versions``
_GROUP = results.KEY[:-1]  # the episodes that differ in their scenarios alone
_MAPPINGS = (
    "agents",
    "settings",
    "trainings",
    "demonstrations",
)  # of run.json, whose values are mappings too
_HINT = "python -m benchmarks.publish makes one from a run folder"


@dataclass(frozen=True, eq=False)
class Published:
    """A folder of published results, see :mod:`benchmarks.publish`.

    Attributes:
        folder: where it lies.
        record: its ``run.json``.
        rows: its episodes, sorted by :data:`benchmarks.results.KEY`.
        places: (env, agent, training seed, noise model, noise level) -> the first of its ``rows`` and the one after
            its last.
    """

    folder: Path
    record: dict[str, Any]
    rows: pa.Table
    places: dict[tuple[Any, ...], tuple[int, int]]

    @property
    def version(self) -> str:
        """Of the package, when these results were made."""
        return str(self.record["versions"].get(_PACKAGE, "unknown"))

    @property
    def same_version(self) -> bool:
        """Whether that is the version that is at work here."""
        return self.version == checkpoint.versions()[_PACKAGE]

    def origin(self) -> list[dict[str, Any]]:
        """What ``run.json`` says of a run that took episodes from here: how they were made, the oldest first."""
        told = {name: self.record.get(name) for name in ("command", "device", "versions", "python")}
        before = [each for each in self.record.get("taken_from", []) if each != told]
        return [*before, told]

    def card(self, env: str, expert: str, episodes: int) -> dict[str, Any] | None:
        """The card of the demonstrations that these results come from, if it is of such a set."""
        asked = {"env": env, "expert": expert, "episodes": episodes, "seed": 0}
        cards = self.record["demonstrations"].values() if self.same_version else ()
        return next((card for card in cards if all(card.get(k) == v for k, v in asked.items())), None)


@dataclass(frozen=True, eq=False)
class Match:
    """An evaluation whose episodes were published.

    Attributes:
        job: the evaluation.
        who: the arguments of the job that runs these episodes: that which ``job`` repeats, or itself.
        rows: the episodes.
    """

    job: Job
    who: dict[str, Any]
    rows: pa.Table


def read(folder: Path) -> Published:
    """A folder of published results.

    Raises:
        ValueError: it is none, or a file in it is missing or damaged.
    """
    record = _record(folder)
    rows = results.sort_rows(results.read_rows(folder / report.EPISODES), results.KEY).combine_chunks()
    edges = results.group_edges(rows, _GROUP)
    first = rows.select(list(_GROUP)).take(pa.array(edges[:-1]))
    keys = zip(*(first[name].to_pylist() for name in _GROUP), strict=True)
    ends = zip(edges[:-1].tolist(), edges[1:].tolist(), strict=True)
    return Published(folder, record, rows, dict(zip(keys, ends, strict=True)))


def _record(folder: Path) -> dict[str, Any]:
    """``run.json`` of published results; raises ``ValueError`` if it is something else."""
    try:
        record = json.loads((folder / report.RECORD).read_bytes())
        fits = isinstance(record, dict) and isinstance(record["versions"], dict)
        fits = fits and all(isinstance(each, dict) for name in _MAPPINGS for each in record[name].values())
        fits = fits and isinstance(record.get("taken_from", []), list)
        fits = fits and all(_is_end(end) for ends in record["trainings"].values() for end in ends.values())
    except (OSError, ValueError, LookupError, TypeError, AttributeError, RecursionError) as error:
        reason = getattr(error, "strerror", None) or f"{type(error).__name__}: {error}"
        raise ValueError(
            f"{str(folder)!r} is no folder of published results ({report.RECORD}: {reason}): {_HINT}"
        ) from None
    if not fits:
        raise ValueError(f"{str(folder)!r} is no folder of published results ({report.RECORD}): {_HINT}")
    return record


def _is_end(end: Any) -> bool:
    """Whether this says how a training ended."""
    fits = isinstance(end["seconds"], int | float) and isinstance(end["device"], str)
    return fits and isinstance(end["end"], dict)


def matches(published: Published, plan: Plan, out: Path, evaluations: Sequence[Job]) -> list[Match]:
    """The evaluations of a plan whose episodes are all in ``published``, made by the very same policy.

    Args:
        published: where to look.
        plan: of the run.
        out: its folder.
        evaluations: of :func:`benchmarks.jobs.evaluation_jobs`.
    """
    if not published.same_version:
        return []

    @cache  # a policy has many evaluations
    def same(env: str, row: str, seed: int, trained: Path | None) -> bool:
        if trained is None:
            return True
        named = published.record["agents"].get(env, {}).get(f"{row}-seed{seed}")
        if named != checkpoint_name(plan, trained, out):
            return False
        base = split_row(row)[0]
        here = json.loads(json.dumps(complete_settings(plan, env, base)))
        return published.record["settings"].get(f"{base}@{env}") == here

    arguments = {job.output: job.arguments for job in evaluations}
    found = []
    for job in evaluations:
        # A row on true readings is run once: its other evaluations say whose episodes they list, and where.
        who = {**arguments.get(job.arguments.get("source", job.output), {}), **job.arguments}
        if same(who["env"], who["row"], who["seed"], who["checkpoint"]):
            rows = _episodes(published, who)
            found += [] if rows is None else [Match(job, who, rows)]
    return found


def _episodes(published: Published, who: dict[str, Any]) -> pa.Table | None:
    """The episodes of an evaluation in the order of their scenarios; None unless all of them are there."""
    part: Scenarios = who["scenarios"]
    key = (who["env"], who["row"], who["seed"], who["noise_model"], float(who["noise_level"]))
    start, end = published.places.get(key, (0, 0))
    group = published.rows[start:end]
    at = int(np.searchsorted(group["scenario"].to_numpy(), part.start))
    rows, seeds = group[at : at + part.count], part.seeds()
    expected = {
        "scenario": np.arange(part.start, part.start + part.count),
        "env_seed": seeds,
        "noise_seed": seeds,
    }
    same = all(np.array_equal(rows[name].to_numpy(), values) for name, values in expected.items())
    return rows if same else None


def take(published: Published, found: Sequence[Match]) -> str:
    """Write the outputs of evaluations that are not done yet, and records of the trainings that they come from.

    Returns:
        A line that says what was taken.

    Raises:
        OSError: a file cannot be written.
    """
    taken = Counter[str]()
    for match in found:
        if match.who["checkpoint"] is not None:
            _restore_training(published, match.who["env"], match.who["checkpoint"])
        if not match.job.output.exists():
            results.write_rows(match.job.output, match.rows)
            taken[match.who["row"]] += match.rows.num_rows
    if taken:
        amount = f"{count([taken.total()], 'episode')} of {count([len(taken)], 'row')}"
    elif found:
        amount = "nothing that is not here already"
    elif not published.same_version:
        amount = f"nothing: it is of version {published.version}, this is {checkpoint.versions()[_PACKAGE]}"
    else:
        amount = "nothing: it has none of these evaluations"
    return f"taken from {published.folder}: {amount}"


def _restore_training(published: Published, env: str, trained: Path) -> None:
    """The record beside a checkpoint that is not here, as far as it was published."""
    end = published.record["trainings"].get(env, {}).get(trained.stem)
    path = trained.with_suffix(".json")
    if end is None or path.exists() or trained.exists():
        return
    curve = [end["end"]] if end["end"] else []
    record = {"seconds": end["seconds"], "device": end["device"], "curve": curve}
    results.atomic_write_text(path, json.dumps(record) + "\n")

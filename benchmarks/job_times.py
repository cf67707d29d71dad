"""How much work jobs were: a line per job in the run folder, from which the time of other runs is estimated."""

from __future__ import annotations

import json
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benchmarks.executors import Watcher
from benchmarks.jobs import Job, train
from benchmarks.pages import csv_lines, csv_text
from benchmarks.protocol import digest

NAME = "job_times.csv"
_AMOUNTS = ("count", "episodes", "scenarios")  # arguments that say how much there is to do


@dataclass(frozen=True)
class Time:
    """How long a job took.

    Attributes:
        kind: its function, for instance ``jobs.train``.
        env: environment.
        who: agent, row or expert.
        settings: a digest of those of a training; else empty.
        amount: of work, in the kind's own unit: updates or steps, episodes.
        seconds: that a core was busy with it, which on a machine with nothing else to do are those that it took.
    """

    kind: str
    env: str
    who: str
    settings: str
    amount: float
    seconds: float


def described(job: Job, seconds: float = 0.0) -> Time:
    """A job as a line of the table."""
    known = job.arguments
    env = next((known[name] for name in ("env", "env_id") if name in known), "")
    who = next((known[name] for name in ("row", "agent", "expert") if name in known), "")
    config = known.get("config")
    settings = "" if config is None else digest(config)
    return Time(kind(job), env, who, settings, _amount(known), seconds)


def kind(job: Job) -> str:
    """The function of a job, by its module and name."""
    return f"{job.run.__module__.rpartition('.')[2]}.{job.run.__name__}"


def _amount(known: dict[str, Any]) -> float:
    if "config" in known:
        steps = [
            value for name, value in known["config"].items() if name.endswith(("updates", "total_steps"))
        ]
        return float(sum(steps)) or 1.0
    if "seeds" in known:
        return float(len(known["seeds"]))
    value = next((known[name] for name in _AMOUNTS if name in known), 1)
    return float(getattr(value, "count", value))


def noting(path: Path, watch: Watcher) -> Watcher:
    """``watch`` that also writes the times of jobs that end into a file."""

    def noted(job: Job, share: float, figures: dict[str, float]) -> None:
        if share == 1 and figures and not _resumed(job, figures["seconds"]):
            _append(path, described(job, figures["core_seconds"]))
        watch(job, share, figures)

    return noted


def _resumed(job: Job, seconds: float) -> bool:
    """Whether a training that took so many seconds had begun before: then nobody knows the time of all of it."""
    if job.run is not train:
        return False
    return float(json.loads(job.output.with_suffix(".json").read_text())["seconds"]) > seconds


def _append(path: Path, time: Time) -> None:
    header = csv_text(Time, ())
    line = csv_text(Time, [time]).removeprefix(header)
    with path.open("a") as file:
        file.write(line if file.tell() else header + line)


def read(path: Path) -> list[Time]:
    """The lines of a table; one that a kill has left unfinished is skipped.

    Raises:
        ValueError: no such file, or another one.
    """
    times = []
    for line in csv_lines(path, Time, "the times of jobs"):
        with suppress(TypeError, ValueError):
            amount, seconds = float(line.pop("amount")), float(line.pop("seconds"))
            if amount > 0 and seconds >= 0:
                times.append(Time(amount=amount, seconds=seconds, **line))
    return times


class Estimate:
    """Seconds that jobs will take, from those that the most similar ones took per unit of work."""

    def __init__(self, times: Iterable[Time]) -> None:
        self._sums: dict[tuple[str, ...], tuple[float, float]] = {}
        for time in times:
            names = _names(time.who)[:1]
            for key in _keys(time, names):
                spent, done = self._sums.get(key, (0.0, 0.0))
                self._sums[key] = spent + time.seconds, done + time.amount

    def seconds(self, job: Job) -> float | None:
        """Seconds of one core; None: no job of this kind has been measured."""
        time = described(job)
        for key in _keys(time, _names(time.who)):
            if key in self._sums:
                spent, done = self._sums[key]
                return spent / done * time.amount
        return None


def _keys(time: Time, names: Iterable[str]) -> list[tuple[str, ...]]:
    """What a job has in common with others, the most telling first."""
    return [
        (time.kind, time.env, time.who, time.settings),
        *((time.kind, time.env, name) for name in names),
        (time.kind, time.env),
        (time.kind,),
    ]


def _names(who: str) -> list[str]:
    """Whom a row is like: rise-belief-mean like rise-belief, and then like rise."""
    names = [who]
    while (cut := max(names[-1].rfind("-"), names[-1].rfind("+"))) > 0:
        names.append(names[-1][:cut])
    return names

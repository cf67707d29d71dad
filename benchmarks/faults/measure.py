"""What a row is, how its trials are made, and what is kept of them."""

from __future__ import annotations

import math
import multiprocessing
import shutil
import tempfile
import time
import zlib
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from benchmarks.pages import csv_lines, csv_text, reason
from benchmarks.results import atomic_write_text

# Told the share that is done and figures of the moment.
Tell = Callable[[float, dict[str, float]], None]


class Unavailable(Exception):
    """This machine lacks what a row needs; the message says what."""


class Fault(NamedTuple):
    """Something that went wrong in a trial: what kind of fault, and the details."""

    kind: str
    details: str


@dataclass
class Findings:
    """What the trials of a row found.

    Attributes:
        trials: how many were made.
        faults: (number of the trial, fault) each.
        figure: what the target is about, where it is not the number of faults.
        note: what else is worth knowing.
    """

    trials: int = 0
    faults: list[tuple[int, Fault]] = field(default_factory=list)
    figure: float | None = None
    note: str = ""

    def add(self, number: int, faults: Iterable[Fault], trials: int = 1) -> None:
        """Count trial ``number``, which stands for ``trials``."""
        self.trials += trials
        self.faults += [(number, Fault(*fault)) for fault in faults]


@dataclass(frozen=True)
class Effort:
    """How much is tried, and with what.

    Attributes:
        share: of the full number of trials.
        seed: of everything random.
        workers: processes, for rows whose trials do not depend on each other.
        only: the one trial to make.
        folder: for the files of trials; removed unless something went wrong.
        row: whose turn it is.
    """

    share: float = 1.0
    seed: int = 0
    workers: int = 1
    only: int | None = None
    folder: Path = Path()
    row: str = ""

    def count(self, full: int, least: int = 1) -> int:
        """How many of ``full`` are made."""
        return max(least, math.ceil(full * self.share - 1e-9))

    def numbers(self, full: int, least: int = 1) -> Sequence[int]:
        """The numbers of the trials to make."""
        return range(self.count(full, least)) if self.only is None else [self.only]

    def rng(self, number: int) -> np.random.Generator:
        """All that is random in a trial."""
        return np.random.default_rng([self.seed, zlib.crc32(self.row.encode()), number])

    @contextmanager
    def scratch(self, number: int | str) -> Iterator[Path]:
        """A folder of a trial, removed when it went well."""
        place = self.folder / f"{self.row}-{number}"
        shutil.rmtree(place, ignore_errors=True)
        place.mkdir(parents=True)
        yield place
        shutil.rmtree(place, ignore_errors=True)

    def keep(self, path: Path, name: str) -> None:
        """Put a file or a folder of a trial that went wrong aside; it is kept."""
        kept = self.folder / f"{self.row}-faults"
        kept.mkdir(exist_ok=True)
        if path.is_dir():
            shutil.copytree(path, kept / name, dirs_exist_ok=True)
        else:
            shutil.copy(path, kept / name)

    def each(
        self, function: Callable[..., Any], tasks: Sequence[tuple], fresh: bool = False
    ) -> Iterator[tuple[tuple, Any]]:
        """Tasks with ``function(*task)``, as they come, in order; several processes if there are several workers.

        Args:
            function: module-level.
            tasks: its arguments.
            fresh: each in a process of its own, which does nothing else.
        """
        if self.workers == 1 and not fresh:
            yield from ((task, function(*task)) for task in tasks)
            return
        context = multiprocessing.get_context("spawn")
        once = 1 if fresh else None
        with ProcessPoolExecutor(self.workers, context, max_tasks_per_child=once) as pool:
            try:
                futures = [pool.submit(function, *task) for task in tasks]
                yield from ((task, future.result()) for task, future in zip(tasks, futures, strict=True))
            except BaseException:
                pool.shutdown(wait=False, cancel_futures=True)
                raise


@dataclass(frozen=True)
class Target:
    """At most so many faults or, for a row with a figure of its own, at least so much of it."""

    bound: float = 0.0
    unit: str = ""

    def met(self, findings: Findings) -> bool:
        """Whether the findings keep to it."""
        if findings.figure is None:
            return len(findings.faults) <= self.bound
        return findings.figure >= self.bound and not findings.faults

    def text(self) -> str:
        """As tables show it."""
        return f"≥ {self.bound:g} {self.unit}" if self.unit else f"{self.bound:g}"


@dataclass(frozen=True)
class Row:
    """A row of the table.

    Attributes:
        name: for ``--rows`` and the CSV.
        title: what is tried, for people.
        trials: what a trial is, in the plural.
        faults: the kinds of faults that are looked for, in words.
        run: makes the trials.
        target: what must be reached.
        scaled: whether the target holds for a share of the trials too.
    """

    name: str
    title: str
    trials: str
    faults: str
    run: Callable[[Effort, Tell], Findings]
    target: Target = Target()
    scaled: bool = True


@dataclass(frozen=True)
class Result:
    """A row that was tried, as in ``faults.csv``; ``found`` says in words what ``met`` judges."""

    name: str
    trials: int
    faults: int
    found: str
    target: str
    met: str
    seconds: float
    share: float
    seed: int
    note: str = ""


def measure(row: Row, effort: Effort, tell: Tell) -> tuple[Result, list[str]]:
    """Make the trials of a row.

    Returns:
        The result, and a line for each fault, which says how to repeat its trial.
    """
    effort, started = replace(effort, row=row.name), time.perf_counter()
    try:
        findings = row.run(effort, tell)
    except Unavailable as error:
        note = f"not tried: {error}"
        return Result(row.name, 0, 0, "–", row.target.text(), "", 0.0, effort.share, effort.seed, note), []
    except Exception as error:
        findings = Findings(faults=[(effort.only or 0, Fault("the row itself failed", reason(error)))])
    return summarise(row, effort, findings, time.perf_counter() - started), repeats(row, effort, findings)


def summarise(row: Row, effort: Effort, findings: Findings, seconds: float) -> Result:
    """The findings in a line."""
    kinds = Counter(fault.kind for _, fault in findings.faults)
    found = ", ".join(f"{count} {kind}" for kind, count in kinds.items())
    if findings.figure is not None:
        found = ", ".join(filter(None, [f"{findings.figure:.4g} {row.target.unit}", found]))
    nothing = not findings.trials and not findings.faults and findings.figure is None
    judged = row.scaled or (effort.share >= 1 and effort.only is None)
    met = ("yes" if row.target.met(findings) else "no") if judged or findings.faults else ""
    if nothing:
        found, met = "no such trial", "no"
    return Result(
        row.name,
        findings.trials,
        len(findings.faults),
        found or "0",
        row.target.text(),
        met,
        seconds,
        effort.share,
        effort.seed,
        findings.note,
    )


def repeats(row: Row, effort: Effort, findings: Findings) -> list[str]:
    """A line for each fault."""
    again = f"--rows {row.name} --seed {effort.seed}"
    return [
        f"{row.name}: {fault.kind}: {fault.details} (again: {again} --only {number})"
        for number, fault in findings.faults
    ]


@contextmanager
def temporary_folder(keep: Callable[[], bool]) -> Iterator[Path]:
    """A folder that is removed at the end unless ``keep()``."""
    folder = Path(tempfile.mkdtemp(prefix="rise-faults-"))
    try:
        yield folder
    finally:
        if not keep():
            shutil.rmtree(folder, ignore_errors=True)


def write_csv(path: Path, rows: Sequence[Result]) -> None:
    """Write results; floats with six digits."""
    atomic_write_text(path, csv_text(Result, rows))


def read_csv(path: Path) -> list[Result]:
    """The inverse of :func:`write_csv`.

    Raises:
        ValueError: no such file, or one with other columns.
    """
    lines = csv_lines(path, Result, "faults")
    kinds = {"trials": int, "faults": int, "seed": int, "seconds": float, "share": float}
    return [Result(**{name: kinds.get(name, str)(text) for name, text in line.items()}) for line in lines]

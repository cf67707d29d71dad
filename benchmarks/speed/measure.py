"""What a row is, and how it is measured: two sides in turn, medians, quartiles of the paired ratios."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.pages import csv_lines, csv_text
from benchmarks.results import atomic_write_text

Side = Callable[[], float]  # does its work once; the figure in the row's unit


class Unavailable(Exception):
    """This machine lacks what a row needs; the message says what."""


@dataclass(frozen=True)
class Effort:
    """How much to measure.

    Attributes:
        repeats: measurements of each side.
        seconds: the least duration of one.
        quick: small sizes, for a pass that only shows that everything runs.
        folder: for what a row leaves behind.
    """

    repeats: int = 7
    seconds: float = 0.25
    quick: bool = False
    folder: Path = Path("runs/speed")

    def size(self, full: int, quick: int) -> int:
        """How large something is made."""
        return quick if self.quick else full


@dataclass(frozen=True)
class Sides:
    """What takes turns; ``note`` says, after all turns, what else they found."""

    ours: Side
    peer: Side | None = None
    note: Callable[[], str] = str


@dataclass(frozen=True)
class Target:
    """A bound on the ratio to the peer or, where there is no peer, on the figure itself."""

    bound: float
    at_least: bool = True

    def met(self, figure: float) -> bool:
        """Whether ``figure`` keeps the bound."""
        return figure >= self.bound if self.at_least else figure <= self.bound

    def text(self, unit: str) -> str:
        """As tables show it: "≥ 0.5 ×"."""
        return f"{'≥' if self.at_least else '≤'} {self.bound:,g} {unit}"


@dataclass(frozen=True)
class Row:
    """A row of the table.

    Attributes:
        name: for ``--rows`` and the CSV.
        title: what is measured, for people.
        unit: of both figures.
        peer: what it is compared to; empty if there is only a bound.
        target: what is to be reached; None: reported only.
        sides: a context manager that makes what is measured and closes it again.
        repeats: instead of the effort's, where one measurement is long or short.
        warm_up: do each side once before it counts.
        by_default: measured without being asked for by name.
    """

    name: str
    title: str
    unit: str
    peer: str
    target: Target | None
    sides: Callable[[Effort], AbstractContextManager[Sides]]
    repeats: int | None = None
    warm_up: bool = True
    by_default: bool = True


@dataclass(frozen=True)
class Result:
    """A measured row, as in ``speed.csv``; None where nothing was measured.

    ``ratio``, ``ratio_low`` and ``ratio_high`` are the median and the quartiles of the ratios of neighbouring
    measurements.
    """

    name: str
    value: float | None
    unit: str
    peer: str
    peer_value: float | None = None
    ratio: float | None = None
    ratio_low: float | None = None
    ratio_high: float | None = None
    target: str = ""
    met: str = ""
    repeats: int = 0
    note: str = ""


def measure(row: Row, effort: Effort, tell: Callable[[float, dict[str, float]], None]) -> Result:
    """Measure a row; ``tell`` is given the share done and the last figures."""
    repeats = effort.repeats if row.repeats is None else row.repeats
    repeats = min(repeats, effort.repeats) if effort.quick else repeats
    with row.sides(effort) as sides:
        ours, peers = take_turns(sides, repeats, row.warm_up and not effort.quick, tell)
        return summarise(row, ours, peers, sides.note())


def take_turns(
    sides: Sides, repeats: int, warm_up: bool, tell: Callable[[float, dict[str, float]], None]
) -> tuple[list[float], list[float]]:
    """``repeats`` figures of each side; who is first alternates, so that neither always follows the other."""
    turns = [side for side in (sides.ours, sides.peer) if side]
    figures: list[list[float]] = [[], []]
    if warm_up:
        for side in turns:
            side()
    for repeat in range(repeats):
        for which in range(len(turns))[:: 1 if repeat % 2 == 0 else -1]:
            figures[which].append(turns[which]())
        names = ("ours", "peer")[: len(turns)]
        tell((repeat + 1) / repeats, {name: figures[i][-1] for i, name in enumerate(names)})
    return figures[0], figures[1]


def summarise(row: Row, ours: Sequence[float], peers: Sequence[float], note: str = "") -> Result:
    """Medians, also of the ratios, and whether the target is met."""
    value = float(np.median(ours))
    peer_value = ratio = low = high = None
    if peers:
        peer_value = float(np.median(peers))
        low, ratio, high = (float(q) for q in np.percentile(np.divide(ours, peers), (25, 50, 75)))
    target = met = ""
    if row.target:
        target = row.target.text("×" if peers else row.unit)
        met = "yes" if row.target.met(value if ratio is None else ratio) else "no"
    return Result(
        row.name,
        value,
        row.unit,
        row.peer,
        peer_value,
        ratio,
        low,
        high,
        target,
        met,
        repeats=len(ours),
        note=note,
    )


def not_measured(row: Row, why: str) -> Result:
    """The result of a row that could not be measured."""
    target = row.target.text("×" if row.peer else row.unit) if row.target else ""
    return Result(row.name, None, row.unit, row.peer, target=target, note=f"not measured: {why}")


def rate(work: Callable[[], int], seconds: float) -> float:
    """How many pieces per second ``work`` does, which says at each call how many it did."""
    pieces, started = 0, time.perf_counter()
    while True:
        pieces += work()
        elapsed = time.perf_counter() - started
        if elapsed >= seconds:
            return pieces / elapsed


def paced(ours: Callable[[], int], peer: Callable[[], int], effort: Effort) -> Sides:
    """Two sides in pieces per second."""
    return Sides(lambda: rate(ours, effort.seconds), lambda: rate(peer, effort.seconds))


def write_csv(path: Path, rows: Sequence[Result]) -> None:
    """Write results; floats with six digits."""
    atomic_write_text(path, csv_text(Result, rows))


def read_csv(path: Path) -> list[Result]:
    """The inverse of :func:`write_csv`.

    Raises:
        ValueError: no such file, or one with other columns.
    """
    lines = csv_lines(path, Result, "speeds")
    numbers = {"value", "peer_value", "ratio", "ratio_low", "ratio_high"}
    rows = []
    for line in lines:
        cells = {name: (float(text) if text else None) for name, text in line.items() if name in numbers}
        words = {name: text for name, text in line.items() if name not in numbers | {"repeats"}}
        rows.append(Result(**words, **cells, repeats=int(line["repeats"])))  # type: ignore[arg-type]
    return rows

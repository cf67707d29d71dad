"""The distance between Bullet and the model as people read it: ``fidelity.csv``, two tables, a figure."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from dataclasses import astuple, dataclass, fields
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from benchmarks.fidelity.measure import Loops, Paths
from benchmarks.pages import FIDELITY, markdown_table
from benchmarks.plots import GRID, INK
from benchmarks.results import atomic_write_text

BLOCK = FIDELITY
TITLES = {
    "random": "random, away from the table",
    "table": "random, on the table",
    "cbf": "of the CBF expert",
    "mpc": "of the MPC expert",
}
_TARGETS = {"random": 8.0, "cbf": 4.0, "mpc": 4.0}  # mm
_POINTS = 3.0
_COLOURS = ("#0072B2", "#E69F00", "#009E73", "#CC79A7")


@dataclass(frozen=True)
class Row:
    """One figure of ``fidelity.csv``; ``target`` is an upper bound of its absolute value."""

    name: str
    noise_level: float | None
    quantity: str
    value: float
    unit: str
    episodes: int
    target: float | None = None

    @property
    def met(self) -> bool:
        """Whether the target, if any, is met."""
        return self.target is None or abs(self.value) <= self.target


def path_rows(name: str, paths: Paths) -> list[Row]:
    """The figures of one kind of actions."""
    hand, error, count = 1e3 * paths.hand, 1e3 * paths.clearance, paths.hand.shape[1]
    values = {
        "hand, mean": np.nanmean(hand),
        "hand, 95 %": np.nanquantile(hand, 0.95),
        "clearance, mean": np.nanmean(error),
        "clearance, rms": np.sqrt(np.nanmean(error**2)),
    }
    target = {"hand, mean": _TARGETS.get(name)}
    return [
        Row(name, None, quantity, float(value), "mm", count, target.get(quantity))
        for quantity, value in values.items()
    ] + [Row(name, None, "episodes on the table", 100.0 * paths.table.any(0).mean(), "%", count)]


def loop_rows(name: str, level: float, loops: Loops) -> list[Row]:
    """The figures of one agent at one noise level."""
    bullet, model = loops.bullet, loops.model
    count = len(bullet.safe)
    values = {
        "Safety, Bullet": (100.0 * bullet.safe.mean(), "%"),
        "Safety, model": (100.0 * model.safe.mean(), "%"),
        "Safety, difference": (100.0 * (model.safe.mean() - bullet.safe.mean()), "points"),
        "Reach, Bullet": (100.0 * bullet.reached.mean(), "%"),
        "Reach, model": (100.0 * model.reached.mean(), "%"),
        "same outcome": (100.0 * (bullet.safe == model.safe).mean(), "%"),
        "hand, mean": (1e3 * float(np.nanmean(loops.hand)), "mm"),
    }
    target = {"Safety, difference": _POINTS}
    return [Row(name, level, q, float(v), unit, count, target.get(q)) for q, (v, unit) in values.items()]


def write_csv(path: Path, rows: Sequence[Row]) -> None:
    """Write ``fidelity.csv``."""
    sink = io.StringIO()
    table = csv.writer(sink, lineterminator="\n")
    table.writerow([*(field.name for field in fields(Row)), "met"])
    for row in rows:
        cells = [f"{cell:.4g}" if isinstance(cell, float) else cell for cell in astuple(row)]
        table.writerow([*cells, "" if row.target is None else "yes" if row.met else "no"])
    atomic_write_text(path, sink.getvalue())


def _table(header: Sequence[str], lines: Sequence[Sequence[str]]) -> str:
    return markdown_table(header, ["---", *["---:"] * (len(header) - 1)], lines)


def markdown(rows: Sequence[Row], picture: str) -> str:
    """Two tables and the figure."""
    found = {(row.name, row.noise_level, row.quantity): row for row in rows}

    def value(name: str, level: float | None, quantity: str, digits: int = 1) -> str:
        return f"{found[name, level, quantity].value:.{digits}f}".replace("-", "−")

    paths = [
        (
            TITLES[name],
            value(name, None, "hand, mean"),
            value(name, None, "hand, 95 %"),
            value(name, None, "clearance, mean"),
            value(name, None, "clearance, rms"),
            f"{found[name, None, 'hand, mean'].episodes:,}",
        )
        for name in dict.fromkeys(row.name for row in rows if row.noise_level is None)
    ]
    loops = [
        (
            f"{name}, noise {level:g}",
            *(
                f"{value(name, level, f'{rate}, Bullet')} / {value(name, level, f'{rate}, model')}"
                for rate in ("Safety", "Reach")
            ),
            value(name, level, "same outcome"),
            value(name, level, "hand, mean"),
            f"{found[name, level, 'hand, mean'].episodes:,}",
        )
        for name, level in dict.fromkeys((r.name, r.noise_level) for r in rows if r.noise_level is not None)
    ]
    head = (
        "the same actions",
        "hand, mean (mm)",
        "95 % (mm)",
        "clearance, mean error (mm)",
        "rms (mm)",
        "episodes",
    )
    loop_head = (
        "the same agent",
        "Safety, Bullet / model",
        "Reach, Bullet / model",
        "as safe",
        "hand, mean (mm)",
        "scenarios",
    )
    return "\n\n".join(
        (_table(head, paths), _table(loop_head, loops), f"![Distance of the hands]({picture})")
    )


def figure(paths: Mapping[str, Paths]) -> Figure:
    """Mean distance of the hands after each step, and where nine in ten are."""
    drawn = Figure(figsize=(6.0, 3.2), layout="constrained")
    axes = drawn.add_subplot()
    for (name, path), colour in zip(paths.items(), _COLOURS, strict=False):
        hand, lasting = 1e3 * path.hand, np.isfinite(path.hand).sum(1)
        steps = np.flatnonzero(
            lasting >= max(2, 0.1 * hand.shape[1])
        )  # few are left at the end: their mean jumps
        mean, most = np.nanmean(hand[steps], axis=1), np.nanquantile(hand[steps], 0.9, axis=1)
        axes.plot(steps + 1, mean, color=colour, label=TITLES[name])
        axes.plot(steps + 1, most, color=colour, linewidth=0.8, linestyle=":")
    axes.set_yscale("log")
    axes.yaxis.set_major_formatter("{x:g}")
    axes.set_xlabel("step", color=INK)
    axes.set_ylabel("distance of the hands (mm)", color=INK)
    axes.set_title(
        "The same actions in Bullet and in the model; dotted: nine in ten are nearer", fontsize=10, color=INK
    )
    axes.grid(color=GRID)
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend(frameon=False, fontsize=8)
    return drawn

"""Throughput against the size of the batch: measured in turn at every size, and drawn."""

from __future__ import annotations

import csv
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium import Env
from gymnasium.vector import VectorEnv
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine

from benchmarks.pages import csv_text, reason
from benchmarks.plots import FAINT, GRID, INK
from benchmarks.results import atomic_write_text
from benchmarks.speed import envs
from benchmarks.speed.measure import Effort, rate

SIZES = (1, 10, 100, 1_000, 10_000, 100_000)


@dataclass(frozen=True)
class Point:
    """A line of ``throughput.csv``: median and quartiles of the steps per second at one batch size."""

    series: str
    batch: int
    steps_per_second: float
    low: float
    high: float


@dataclass(frozen=True)
class Series:
    """A line of the figure; one that is not batched is a level across it."""

    label: str
    colour: str
    marker: str
    make: Callable[[int], tuple[Env | VectorEnv, envs.Work]]
    largest: int = SIZES[-1]
    peer: bool = False


def _batch(env_id: str) -> Callable[[int], tuple[VectorEnv, envs.Work]]:
    def make(size: int) -> tuple[VectorEnv, envs.Work]:
        env = envs.make_batch(env_id, size)
        return env, envs.steps_together(env, env_id)

    return make


def _torch(size: int) -> tuple[VectorEnv, envs.Work]:
    env = envs.make_torch_vehicles(size, "cpu")
    return env, envs.steps_together(env, envs.VEHICLE, "cpu")


def _alone(env_id: str) -> Callable[[int], tuple[Env, envs.Work]]:
    def make(size: int) -> tuple[Env, envs.Work]:
        env = envs.make(env_id)
        return env, envs.steps_alone(env, 50)

    return make


SERIES = {
    "vehicles": Series("Vehicles, NumPy", "#0072B2", "o", _batch(envs.VEHICLE)),
    "vehicles-torch": Series("Vehicles, torch", "#56B4E9", "s", _torch),
    "cartpoles": Series("Gymnasium's CartPoleVectorEnv", "#7F7F7F", "o", _batch(envs.CARTPOLE), peer=True),
    "arms": Series("Kinematic Pandas", "#009E73", "D", _batch(envs.ARMS), largest=10_000),
    "panda": Series("Panda in Bullet", "#D55E00", "^", _alone(envs.PANDA), largest=1),
    "reach": Series("panda-gym's PandaReach-v3", "#BDBDBD", "v", _alone(envs.REACH), largest=1, peer=True),
}


def sweep(effort: Effort, tell: Callable[[float, dict[str, float]], None]) -> tuple[list[Point], list[str]]:
    """Measure every series at every size; at each size they take turns.

    Returns:
        The points, and a line for each series that could not be measured.
    """
    points: list[Point] = []
    failed: dict[str, str] = {}
    sizes = SIZES[:2] if effort.quick else SIZES
    for place, size in enumerate(sizes):
        with _opened(size, failed) as works:
            figures: dict[str, list[float]] = {name: [] for name in works}
            for repeat in range(min(effort.repeats, 3)):
                for name in list(works)[:: 1 if repeat % 2 == 0 else -1]:
                    figures[name].append(rate(works[name], effort.seconds))
        for name, values in figures.items():
            low, median, high = (float(q) for q in np.percentile(values, (25, 50, 75)))
            points.append(Point(name, size, median, low, high))
        tell((place + 1) / len(sizes), {"batch": size})
    return points, [f"{name}: {reason}" for name, reason in failed.items()]


@contextmanager
def _opened(size: int, failed: dict[str, str]) -> Iterator[dict[str, envs.Work]]:
    """All series that have this size, each warmed up; one that fails is noted and left out from then on."""
    opened, works = [], {}
    for name, series in SERIES.items():
        if size > series.largest or name in failed:
            continue
        try:
            env, work = series.make(size)
            opened.append(env)
            work()
            works[name] = work
        except Exception as error:
            failed[name] = reason(error)
    try:
        yield works
    finally:
        for env in opened:
            env.close()


def write_points(path: Path, points: Sequence[Point]) -> None:
    """Write ``throughput.csv``."""
    atomic_write_text(path, csv_text(Point, points))


def read_points(path: Path) -> list[Point]:
    """The inverse of :func:`write_points`."""
    with path.open(newline="") as file:
        return [
            Point(
                line["series"],
                int(line["batch"]),
                *(float(line[key]) for key in ("steps_per_second", "low", "high")),
            )
            for line in csv.DictReader(file)
        ]


def figure(points: Sequence[Point]) -> Figure:
    """Steps per second against the batch size, both logarithmic; a level for what is not batched."""
    names = [name for name in SERIES if any(point.series == name for point in points)]
    height, below = 5.6, 1.1
    layout = ConstrainedLayoutEngine(rect=(0.005, 0.01, 0.985, 0.985 - below / height))
    drawn = Figure(figsize=(10.0, height), layout=layout)
    drawn.text(
        0.015, 1 - 0.14 / height, "Throughput against the size of the batch",
        va="top", size=14.5, weight="bold", color=INK,
    )  # fmt: skip
    note = "Random actions, resets included  ·  one core, torch all  ·  median of 3, shaded: quartiles"
    drawn.text(0.015, 1 - 0.45 / height, note, va="top", size=10.5, color=FAINT)
    axis = drawn.subplots()
    batches = sorted({point.batch for point in points})
    handles = []
    for name in names:
        series = SERIES[name]
        own = sorted((point for point in points if point.series == name), key=lambda point: point.batch)
        x, y = [point.batch for point in own], [point.steps_per_second for point in own]
        style: dict[str, Any] = {"color": series.colour, "linewidth": 1.9}
        style["linestyle"] = ":" if series.largest == 1 else "--" if series.peer else "-"
        if series.largest == 1:
            axis.axhline(y[0], **style)
        else:
            axis.fill_between(
                x, [p.low for p in own], [p.high for p in own], color=series.colour, alpha=0.16, linewidth=0
            )
        handles += axis.plot(x, y, label=series.label, marker=series.marker, markersize=6, **style)
    axis.set(xscale="log", yscale="log", xlabel="environments in the batch", ylabel="steps per second")
    axis.set_xticks(batches, [f"{batch:,}" for batch in batches])
    axis.yaxis.set_major_formatter(lambda value, place: _short(value))
    axis.minorticks_off()
    axis.spines[["top", "right"]].set_visible(False)
    axis.tick_params(labelsize=10.5, colors=INK)
    axis.xaxis.label.set(size=10, color=FAINT)
    axis.yaxis.label.set(size=10, color=FAINT)
    axis.grid(color=GRID)
    axis.set_axisbelow(True)
    drawn.legend(
        handles=handles, loc="upper left", bbox_to_anchor=(0.008, 1 - 0.66 / height), ncols=3,
        columnspacing=1.6, fontsize=10.5, labelcolor=INK, frameon=False,
    )  # fmt: skip
    return drawn


def _short(value: float) -> str:
    """1,000 to 100,000 as they are, larger ones in millions."""
    return f"{value / 1e6:,g} M" if value >= 1e6 else f"{value:,g}"

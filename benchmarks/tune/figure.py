"""What a search saw, in one figure: what each setting can do on true readings, and at noise level 1."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.lines import Line2D

from benchmarks.labels import agent_label, env_label
from benchmarks.plots import FAINT, GRID, INK, colour, head, style
from benchmarks.tune.ranking import Rates

_TOP = 0.99  # inches that the words above the panels take
_SHOWN = 8.0  # points below the best on true readings: settings that lose more are counted, not drawn
_TITLE = "What the search saw"
_NOTE = "Each mark one setting, the mean of Safety and Reach Rate on validation scenarios (%)"

# By agent, environment and trial: the mean over the training seeds that a setting was measured with, and their number.
Marks = Mapping[tuple[str, str], Mapping[int, tuple[Rates, int]]]


def figure(
    marks: Marks, chosen: Mapping[tuple[str, str], int], clean_loss: float, best: Mapping[str, Rates]
) -> Figure:
    """A panel per environment: the score at level 1 over that on true readings.

    Args:
        marks: all settings.
        chosen: of each study, the number of the trial.
        clean_loss: what may be lost on true readings, in [0, 1].
        best: on true readings, of each environment.

    Raises:
        ValueError: there are no settings.
    """
    envs = list(dict.fromkeys(env for (_, env), trials in marks.items() if trials))
    if not envs:
        raise ValueError("there are no settings to draw")
    agents = list(dict.fromkeys(agent for agent, _ in marks))
    height = _TOP + 4.2
    layout = ConstrainedLayoutEngine(rect=(0.005, 0.01, 0.99, 0.99 - _TOP / height), w_pad=0.1)
    drawn = Figure(figsize=(max(5.4, 5.0 * len(envs)), height), layout=layout)
    head(drawn, _TITLE, [_NOTE])
    for env, axis in zip(envs, drawn.subplots(1, len(envs), squeeze=False)[0], strict=True):
        left = 100 * best[env].clean - _SHOWN
        for agent in agents:
            trials = {
                n: mark for n, mark in marks.get((agent, env), {}).items() if 100 * mark[0].clean >= left
            }
            _draw(axis, trials, chosen.get((agent, env)), colour(agents, agent))
        axis.set_xlim(left - 0.2, 100.3)
        every = [rates for (_, of), trials in marks.items() if of == env for rates, _ in trials.values()]
        if lost := sum(100 * rates.clean < left for rates in every):
            note, place = f"← {lost} further left", axis.transAxes  # above the panel, where no mark is
            axis.text(1.0, 1.02, note, transform=place, ha="right", va="bottom", size=10, color=FAINT)
        _limit(axis, 100 * (best[env].clean - clean_loss))
        style(axis, env_label(env))
        axis.set(xlabel="on true readings", ylabel="at noise level 1")
    drawn.legend(
        handles=_legend(agents),
        loc="upper left",
        bbox_to_anchor=(0.008, 1 - 0.66 / height),
        ncols=len(agents) + 4,
        columnspacing=1.4,
        fontsize=10,
        labelcolor=INK,
        frameon=False,
    )
    return drawn


def _draw(axis: Axes, trials: Mapping[int, tuple[Rates, int]], chosen: int | None, paint: str) -> None:
    """Hollow marks of one training seed, full ones of several, a ring around the chosen one."""
    for number, (rates, seeds) in trials.items():
        place = 100 * rates.clean, 100 * rates.score
        full: dict[str, Any] = {"markerfacecolor": paint if seeds > 1 else "white", "clip_on": False}
        axis.plot(*place, "o", markersize=6.5, color=paint, markeredgewidth=1.4, zorder=3, **full)
        if number == chosen:
            axis.plot(*place, "o", markersize=14, color=INK, markerfacecolor="none", zorder=4, clip_on=False)


def _limit(axis: Axes, where: float) -> None:
    """The end of what may be lost; how far below it a setting may lie depends on how well it is known."""
    axis.axvline(where, color=FAINT, linestyle="--", linewidth=1, zorder=1)
    axis.grid(color=GRID)


def _legend(agents: Sequence[str]) -> list[Line2D]:
    mark: dict[str, Any] = {"linestyle": "none", "marker": "o", "markersize": 6.5}
    shown = [Line2D([], [], color=colour(agents, each), label=agent_label(each), **mark) for each in agents]
    grey: dict[str, Any] = {**mark, "color": FAINT, "markeredgewidth": 1.4}
    return [
        *shown,
        Line2D([], [], label="one seed", markerfacecolor="white", **grey),
        Line2D([], [], label="several", **grey),
        Line2D([], [], label="chosen", **{**mark, "color": INK, "markersize": 12}, markerfacecolor="none"),
        Line2D([], [], label="limit of loss", color=FAINT, linestyle="--", linewidth=1),
    ]

"""Figures of a summary, as matplotlib ``Figure`` objects: no pyplot, no global state, no time stamps."""

from __future__ import annotations

import io
import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.lines import Line2D

from benchmarks.labels import (
    agent_label,
    condition_label,
    env_label,
    interval,
    is_reference,
    noise_label,
    percent,
    sample,
    split_row,
)
from benchmarks.results import StrPath, atomic_write_bytes
from benchmarks.sections import Section
from benchmarks.tables import SummaryRow, headline_level

# Okabe & Ito's colours, which colour-blind readers tell apart; greys are left to the reference rows.
_COLOURS = {
    **{"rise": "#0072B2", "pcbc": "#E69F00", "cppo": "#009E73", "rise-belief": "#CC79A7"},
    **{"expert": "#7F7F7F", "random": "#BDBDBD"},
}
_SPARE_COLOURS = ("#D55E00", "#56B4E9", "#7B5BA6", "#8C6D1F", "#A3423C")
_GREYS = ("#7F7F7F", "#A6A6A6", "#595959")
_MARKERS = "osD^vPX*<>"
INK, FAINT, GRID = "#222222", "#6A6A6A", "#E6E6E6"
_INTERVALS = "95 % intervals"  # which ones: benchmarks.stats
_WIDTH = 10.0  # inches
_LEGEND_LETTERS = 90  # that fit into its width
_NOTE_LETTERS, _NOTE_HEIGHT = 130, 0.2  # that fit beside each other; inches from line to line

Rate = tuple[float, float, float]  # rate, lower end, upper end


@dataclass(frozen=True)
class Metric:
    """A rate as figures show it: where it is in a summary row, its name, and what is counted."""

    key: str
    title: str
    meaning: str

    def of(self, row: SummaryRow) -> Rate:
        """The rate of ``row`` with its interval."""
        rate, low, high = (getattr(row, f"{self.key}_{part}") for part in ("rate", "low", "high"))
        return rate, low, high


METRICS = (
    Metric("safety", "Safety Rate", "no collision\n(% of episodes)"),
    Metric("reach", "Reach Rate", "goal reached, no collision\n(% of episodes)"),
)


def comparison(summary: Sequence[SummaryRow], level: float, noise_model: str | None = None) -> Figure:
    """The paper's figure: Safety and Reach Rate of every agent at one noise level, a row of panels per task.

    Args:
        summary: rows of :func:`benchmarks.tables.summarise`.
        level: noise level to show.
        noise_model: needed if the summary holds several.

    Raises:
        ValueError: nothing was measured at that level, or it is not clear of which noise model.
    """
    rows = _of_model(summary, noise_model)
    shown = [row for row in rows if row.noise_level == level]
    if not shown:
        measured = ", ".join(f"{x:g}" for x in sorted({row.noise_level for row in rows}))
        raise ValueError(f"no episodes at noise level {level:g}; measured were {measured or 'none'}")
    agents, envs = _names(rows, "agent"), _names(rows, "env")
    condition = condition_label(shown[0].noise_model, level)
    notes = [condition[0].upper() + condition[1:], sample(shown, "bar"), _INTERVALS]
    title = "Safety and reach under noisy obstacle readings"
    figure, axes = _panels(envs, 0.85 + 0.33 * len(agents), title, notes)
    for env, pair in zip(envs, axes, strict=True):
        of_env = {row.agent: row for row in shown if row.env == env}
        for axis, metric in zip(pair, METRICS, strict=True):
            bars = {place: metric.of(of_env[agent]) for place, agent in enumerate(agents) if agent in of_env}
            _draw_bars(axis, bars, [colour(agents, agent) for agent in agents])
            axis.set_yticks(range(len(agents)), [agent_label(agent) for agent in agents])
            axis.set_xlabel(metric.meaning.replace("\n", " "))
        pair[1].tick_params(labelleft=False)
    return figure


def grouped(sections: Sequence[Section]) -> Figure:
    """Safety and Reach Rate of the rows of sections of one task, at the level of the figures: a group per section.

    A section of several noise models has a group for each.

    Raises:
        ValueError: no sections.
    """
    groups = [group for section in sections for group in _groups(section)]
    if not groups:
        raise ValueError("there are no rows to draw")
    shown = [row for _, rows in groups for row in rows]
    # A place for the title of each group, one for each row, and one between groups.
    places = [entry for title, rows in groups for entry in ("", title, *rows)][1:]
    levels = sorted({row.noise_level for row in shown})
    notes = [
        f"Noise level {' or '.join(f'{level:g}' for level in levels)}",
        sample(shown, "bar"),
        _INTERVALS,
    ]
    title = "Controls, sweeps and other noise"
    figure, (pair,) = _panels([shown[0].env], 0.75 + 0.25 * len(places), title, notes)
    names = list(dict.fromkeys(_family(row) for row in shown))
    colours = [colour(names, _family(entry)) if isinstance(entry, SummaryRow) else "" for entry in places]
    words = [agent_label(entry.agent) if isinstance(entry, SummaryRow) else "" for entry in places]
    for axis, metric in zip(pair, METRICS, strict=True):
        rates = {place: metric.of(row) for place, row in enumerate(places) if isinstance(row, SummaryRow)}
        _draw_bars(axis, rates, colours)
        axis.set_yticks(range(len(places)), words)
        axis.set_xlabel(metric.meaning.replace("\n", " "))
    for place, entry in enumerate(places):
        if isinstance(entry, str):
            look: dict[str, Any] = {"size": 10.5, "weight": "bold", "color": INK, "in_layout": False}
            pair[0].text(1, place, entry, va="center", backgroundcolor="white", **look)
    pair[0].set_zorder(1)  # long titles reach over the other panel, where their lines are empty
    pair[0].patch.set_visible(False)
    pair[1].tick_params(labelleft=False)
    return figure


def _groups(section: Section) -> list[tuple[str, list[SummaryRow]]]:
    """Title and rows of the groups of a section, at its headline level."""
    noisy = [row for row in section.rows if row.noise_level] or section.rows
    groups = []
    for model in dict.fromkeys(row.noise_model for row in noisy):
        of_model = [row for row in noisy if row.noise_model == model]
        level = headline_level(of_model)
        title = f"{section.title}: {noise_label(model)}" if model != "step" else section.title
        groups.append((title, [row for row in of_model if row.noise_level == level]))
    return groups


def _family(row: SummaryRow) -> str:
    """The agent whose variant a row is, as far as its name says: what its colour stands for."""
    base = split_row(row.agent)[0]
    return next((name for name in sorted(_COLOURS, key=len, reverse=True) if base.startswith(name)), base)


def noise_curve(summary: Sequence[SummaryRow], noise_model: str | None = None) -> Figure:
    """Safety and Reach Rate against the noise level: a line with its interval per agent, a row per task.

    Args:
        summary: rows of :func:`benchmarks.tables.summarise`.
        noise_model: needed if the summary holds several.

    Raises:
        ValueError: no rows, or it is not clear of which noise model.
    """
    rows = _of_model(summary, noise_model)
    if not rows:
        raise ValueError("no episodes to draw a noise curve of")
    agents, envs = _names(rows, "agent"), _names(rows, "env")
    notes = [f"Noise: {noise_label(rows[0].noise_model)}", sample(rows, "point"), _INTERVALS]
    title = "Safety and reach as the obstacle readings get noisier"
    columns = max(1, _LEGEND_LETTERS // (8 + max(len(agent_label(agent)) for agent in agents)))
    legend_height = 0.12 + 0.24 * -(-len(agents) // columns)
    figure, axes = _panels(envs, 2.9, title, notes, legend_height)
    levels = sorted({row.noise_level for row in rows})
    bottom = 10 * int(10 * min(row.reach_low for row in rows))
    styles = {agent: _line_style(agents, agent) for agent in agents}
    for env, pair in zip(envs, axes, strict=True):
        for axis, metric in zip(pair, METRICS, strict=True):
            lines = {
                a: {r.noise_level: metric.of(r) for r in rows if (r.env, r.agent) == (env, a)} for a in agents
            }
            _draw_lines(axis, lines, styles)
            axis.set_xticks(levels, [f"{level:g}" for level in levels])
            axis.set(ylim=(bottom, 102.5), xlabel="noise level", ylabel=metric.meaning)
    handles = [Line2D([], [], label=agent_label(agent), **styles[agent]) for agent in agents]
    top = 1 - (0.66 + _NOTE_HEIGHT * (len(_lines(notes)) - 1)) / figure.get_figheight()
    figure.legend(
        handles=handles,
        loc="upper left",
        bbox_to_anchor=(0.008, top),
        ncols=columns,
        columnspacing=1.6,
        fontsize=10.5,
        labelcolor=INK,
        frameon=False,
    )
    return figure


def save_png(figure: Figure, path: StrPath, dpi: int = 160) -> None:
    """Write a figure as PNG: the same figure and library versions give the same bytes.

    Raises:
        OSError: the file cannot be written; an earlier one is intact.
    """
    FigureCanvasAgg(figure)
    sink = io.BytesIO()
    figure.savefig(sink, format="png", dpi=dpi, facecolor="white", metadata={"Software": None})
    atomic_write_bytes(path, sink.getvalue())


def colour(agents: Sequence[str], agent: str) -> str:
    """The colour of an agent: known ones always have the same, others take spare ones in turn, references greys."""
    if agent in _COLOURS:
        return _COLOURS[agent]
    grey = is_reference(agent)
    others = [name for name in agents if name not in _COLOURS and is_reference(name) == grey]
    place = others.index(agent)
    return _GREYS[place % len(_GREYS)] if grey else spare_colour(place)


def spare_colour(place: int) -> str:
    """A colour for what has none of its own: the one at ``place``."""
    return _SPARE_COLOURS[place % len(_SPARE_COLOURS)]


def _names(rows: Sequence[SummaryRow], column: str) -> list[str]:
    """The agents or environments, in the order of the summary."""
    return list(dict.fromkeys(getattr(row, column) for row in rows))


def _of_model(summary: Sequence[SummaryRow], noise_model: str | None) -> list[SummaryRow]:
    """The rows of one model; at level 0, which is the same for all, those of another where it has none itself."""
    models = sorted({row.noise_model for row in summary})
    if noise_model is None and len(models) > 1:
        raise ValueError(f"the summary holds the noise models {', '.join(models)}: choose one for a figure")
    own = [row for row in summary if noise_model in (None, row.noise_model)]
    clean = {(row.env, row.agent): row for row in summary if row.noise_level == 0}
    missing = {(row.env, row.agent) for row in own} - {(r.env, r.agent) for r in own if r.noise_level == 0}
    return own + [row for key, row in clean.items() if key in missing]


def _lines(notes: Sequence[str]) -> list[str]:
    """Notes beside each other, in as many lines as they need."""
    return [line.strip(" ·") for line in textwrap.wrap("  ·  ".join(notes), _NOTE_LETTERS)]


def _panels(
    envs: Sequence[str], panel_height: float, title: str, notes: Sequence[str], legend_height: float = 0.0
) -> tuple[Figure, list[list[Axes]]]:
    """A figure with a header and empty panels, a row per env and a column per metric; heights in inches."""
    header = 0.74 + _NOTE_HEIGHT * (len(_lines(notes)) - 1) + legend_height
    height = header + panel_height * len(envs)
    below = (0.005, 0.01, 0.99, 0.99 - header / height)
    layout = ConstrainedLayoutEngine(rect=below, h_pad=0.08, w_pad=0.08)
    figure = Figure(figsize=(_WIDTH, height), layout=layout)
    head(figure, title, _lines(notes))
    axes = figure.subplots(len(envs), len(METRICS), squeeze=False).tolist()
    for env, pair in zip(envs, axes, strict=True):
        for axis, metric in zip(pair, METRICS, strict=True):
            style(axis, f"{env_label(env)}: {metric.title}")
    return figure, axes


def head(figure: Figure, title: str, notes: Sequence[str]) -> None:
    """Write a title over a figure, and lines of notes below it."""
    height = figure.get_figheight()
    figure.text(0.015, 1 - 0.14 / height, title, va="top", size=14.5, weight="bold", color=INK)
    for place, line in enumerate(notes):
        below_title = 0.45 + _NOTE_HEIGHT * place
        figure.text(0.015, 1 - below_title / height, line, va="top", size=10.5, color=FAINT)


def style(axis: Axes, title: str) -> None:
    """Give a panel its title and the look of all panels."""
    axis.set_title(title, loc="left", size=12, weight="bold", color=INK)
    axis.spines[["top", "right"]].set_visible(False)
    axis.tick_params(labelsize=10.5, colors=INK)
    axis.xaxis.label.set(size=10, color=FAINT)
    axis.yaxis.label.set(size=10, color=FAINT)
    axis.set_axisbelow(True)


def _draw_bars(axis: Axes, rates: Mapping[int, Rate], colours: Sequence[str]) -> None:
    """A horizontal bar per place, top to bottom, its interval as a whisker and in figures beside it.

    Args:
        axis: of the panel.
        rates: by place; where one is missing nothing was run.
        colours: of all places; a place of none is left empty.
    """
    for place, paint in enumerate(colours):
        if not paint:
            continue
        if place not in rates:
            axis.text(1, place, "not run", va="center", size=10, color=FAINT, style="italic")
            continue
        rate, low, high = rates[place]
        axis.barh(place, 100 * rate, height=0.66, color=paint)
        ends = [[100 * (rate - low)], [100 * (high - rate)]]
        axis.errorbar(100 * rate, place, xerr=ends, color=INK, elinewidth=1.4, capsize=3.5, capthick=1.4)
        _beside(axis, place, 55, f"{percent(rate)} %", size=11, weight="bold", color=INK)
        _beside(axis, place, 119, interval(low, high), size=9.5, color=FAINT)
    axis.set(xlim=(0, 101.5), ylim=(len(colours) - 0.4, -0.6))
    axis.tick_params(axis="y", length=0)
    axis.grid(axis="x", color=GRID)


def _beside(axis: Axes, place: float, points: float, words: str, **style: Any) -> None:
    """Words level with a bar that end ``points`` right of the panel."""
    # In points, so that columns line up and never meet, however wide the panel is.
    where: dict[str, Any] = {
        "xy": (1, place),
        "xycoords": axis.get_yaxis_transform(),
        "textcoords": "offset points",
    }
    axis.annotate(words, xytext=(points, 0), ha="right", va="center", **where, **style)


def _line_style(agents: Sequence[str], agent: str) -> dict:
    """Colour, marker and dashes of an agent's line; references are dashed, so that agents stand out."""
    marker = _MARKERS[agents.index(agent) % len(_MARKERS)]
    dashes = "--" if is_reference(agent) else "-"
    return {
        "color": colour(agents, agent),
        "marker": marker,
        "linestyle": dashes,
        "markersize": 5.5,
        "linewidth": 1.9,
    }


def _draw_lines(axis: Axes, lines: Mapping[str, Mapping[float, Rate]], styles: Mapping[str, dict]) -> None:
    """A line per agent over noise levels with its interval: a band, or a whisker where there is one level."""
    for place, (agent, line) in enumerate(lines.items()):
        levels = sorted(line)
        rate, low, high = ([100 * line[level][i] for level in levels] for i in range(3))
        if (
            len(levels) == 1
        ):  # a band would have no width; points beside each other, or they would hide each other
            x = levels[0] + 0.02 * (place - (len(lines) - 1) / 2)
            axis.errorbar(x, rate, yerr=[[rate[0] - low[0]], [high[0] - rate[0]]], capsize=3, **styles[agent])
            axis.margins(x=0.5)
        elif levels:
            axis.fill_between(levels, low, high, color=styles[agent]["color"], alpha=0.16, linewidth=0)
            axis.plot(levels, rate, clip_on=False, **styles[agent])  # whole markers at 0 and 100
    if not any(lines.values()):
        axis.text(0.5, 0.5, "not run", transform=axis.transAxes, ha="center", color=FAINT, style="italic")
    axis.grid(color=GRID)

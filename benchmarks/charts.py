"""The interactive charts of the report, as plotly.js takes them: plain values, drawn in the colours of the page.

A chart is a dict with ``title``, ``data`` (traces) or ``choices`` (traces by what a reader can choose), ``layout`` and
``height`` (px).
"""

from __future__ import annotations

import math
import textwrap
from collections.abc import Mapping, Sequence
from typing import Any

from benchmarks import plots
from benchmarks.labels import agent_label, env_label, interval, is_reference, percent
from benchmarks.plots import METRICS, Metric
from benchmarks.tables import SummaryRow, headline_level

Chart = dict[str, Any]
Curves = Mapping[str, Sequence[Mapping[str, float]]]  # figures of progress by training
_POINTS = 200  # of a training curve that are drawn
_SYMBOLS = ("circle", "square", "diamond", "triangle-up", "triangle-down", "pentagon", "cross", "x", "star")


def comparison(rows: Sequence[SummaryRow], metric: Metric) -> Chart:
    """A bar per agent of one task under one condition, the first on top, its interval as a whisker."""
    agents = [row.agent for row in rows]
    rates = [metric.of(row) for row in rows]
    whiskers = {"array": [_up(rate) for rate in rates], "arrayminus": [_down(rate) for rate in rates]}
    bars = {
        "type": "bar",
        "orientation": "h",
        "y": [_wrapped(agent) for agent in agents],
        "x": [_percent(rate[0]) for rate in rates],
        "error_x": {"type": "data", "symmetric": False, **whiskers},
        "marker": {"color": [plots.colour(agents, agent) for agent in agents]},
        "customdata": [_words(rate) for rate in rates],
        "hovertemplate": "%{y}: %{customdata}<extra></extra>",
    }
    layout = {
        "xaxis": {
            "range": [0, 101.5],
            "dtick": 25,
            "ticksuffix": " %",
            "fixedrange": True,
        },
        "yaxis": {"autorange": "reversed", "fixedrange": True},
        "margin": {"l": 8, "r": 28, "t": 8, "b": 28},
    }
    return _chart(f"{env_label(rows[0].env)}: {metric.title}", layout, 48 + 38 * len(rows), data=[bars])


def curve(rows: Sequence[SummaryRow], metric: Metric) -> Chart:
    """A line per agent of one task over noise levels, with intervals."""
    agents = list(dict.fromkeys(row.agent for row in rows))
    data = []
    for place, agent in enumerate(agents):
        line = sorted((row for row in rows if row.agent == agent), key=lambda row: row.noise_level)
        rates = [metric.of(row) for row in line]
        whiskers = {"array": [_up(rate) for rate in rates], "arrayminus": [_down(rate) for rate in rates]}
        data.append(
            {
                **_style(agents, agent, place),
                "x": [row.noise_level for row in line],
                "y": [_percent(rate[0]) for rate in rates],
                "error_y": {
                    "type": "data",
                    "symmetric": False,
                    **whiskers,
                    "thickness": 1,
                    "color": plots.colour(agents, agent),
                },
                "customdata": [_words(rate) for rate in rates],
                "hovertemplate": "%{customdata}",
            }
        )
    layout = {
        "xaxis": {
            "title": {"text": "noise level"},
            "tickvals": sorted({row.noise_level for row in rows}),
            "fixedrange": True,
        },
        "yaxis": {"ticksuffix": " %", "rangemode": "tozero", "fixedrange": True},
        "hovermode": "x",
    }
    return _chart(
        f"{env_label(rows[0].env)}: {metric.title}", _legend(layout), 360 + 20 * len(agents), data=data
    )


def pareto(rows: Sequence[SummaryRow]) -> Chart:
    """Reach Rate against Safety Rate of one task under one noise model: at each noise level, and along all of them.

    The level of the figures comes first: where all are drawn, those of good agents lie in a corner.
    """
    agents, headline = list(dict.fromkeys(row.agent for row in rows)), headline_level(rows)
    levels = sorted({row.noise_level for row in rows})
    choices = {
        f"noise level {level:g}": _front_at([row for row in rows if row.noise_level == level], agents)
        for level in sorted(levels, key=lambda level: (level != headline, level))
    }
    if len(levels) > 1:
        lines = ([row for row in rows if row.agent == agent] for agent in agents)
        choices["all noise levels"] = [_both_rates(line, agents) for line in lines]
    layout = {
        "xaxis": {"title": {"text": "Safety Rate"}, "ticksuffix": " %", "fixedrange": True},
        "yaxis": {"title": {"text": "Reach Rate"}, "ticksuffix": " %", "fixedrange": True},
        "hovermode": "closest",
    }
    return _chart(env_label(rows[0].env), _legend(layout), 400 + 20 * len(agents), choices=choices)


def _both_rates(rows: Sequence[SummaryRow], agents: Sequence[str]) -> Chart:
    """The rates of one agent, from its lowest noise level to its highest."""
    line, agent = sorted(rows, key=lambda row: row.noise_level), rows[0].agent
    safety, reach = METRICS
    return {
        **_style(agents, agent, agents.index(agent)),
        "x": [_percent(row.safety_rate) for row in line],
        "y": [_percent(row.reach_rate) for row in line],
        "customdata": [
            f"noise level {row.noise_level:g}: Safety {_words(safety.of(row))}, Reach {_words(reach.of(row))}"
            for row in line
        ],
        "hovertemplate": "%{customdata}",
    }


def _front_at(rows: Sequence[SummaryRow], agents: Sequence[str]) -> list[Chart]:
    """A mark with both intervals per agent at one level, and rings around the Pareto front, joined by a line."""
    marks = [
        _both_rates([row], agents)
        | {"marker": _style(agents, row.agent, n)["marker"] | {"size": max(9, 17 - 3 * n)}}
        | {
            f"error_{axis}": {
                "type": "data",
                "symmetric": False,
                "array": [_up(metric.of(row))],
                "arrayminus": [_down(metric.of(row))],
                "thickness": 1,
                "color": plots.colour(agents, row.agent),
            }
            for axis, metric in zip("xy", METRICS, strict=True)
        }
        for n, row in enumerate(rows)  # later ones are smaller: of marks in one place all can be seen
    ]
    best = front([(row.safety_rate, row.reach_rate) for row in rows])
    joined = {
        "type": "scatter",
        "mode": "lines+markers",
        "marker": {"color": "#888888", "symbol": "circle-open", "size": 24},
        "name": "Pareto front",
        "x": [_percent(x) for x, _ in best],
        "y": [_percent(y) for _, y in best],
        "line": {"dash": "dot", "width": 1.5, "color": "#888888"},
        "hoverinfo": "skip",
    }
    return [*marks, joined]


def front(points: Sequence[tuple[float, float]]) -> list[tuple[float, float]]:
    """Those of ``points`` that no other one reaches in both coordinates and beats in one, by the first coordinate."""
    best = {p for p in points if not any(q != p and q[0] >= p[0] and q[1] >= p[1] for q in points)}
    return sorted(best)


def training(title: str, curves: Curves, paint: str) -> Chart | None:
    """Every figure of progress of some trainings against the share of the training; None where there is none.

    Args:
        title: of the chart.
        curves: by training; each point has ``share`` and named figures.
        paint: colour of the lines; later trainings are paler.
    """
    names = dict.fromkeys(name for points in curves.values() for point in points for name in point)
    figures = [
        name for name in names if name not in ("share", "steps")
    ]  # which go straight from corner to corner
    choices: dict[str, list[Chart]] = {}
    for figure in figures:
        lines = []
        for place, (label, points) in enumerate(curves.items()):
            known = [(point["share"], point[figure]) for point in points if {"share", figure} <= set(point)]
            known = [each for each in known if all(map(math.isfinite, each))]
            thinned = known[:: max(1, len(known) // _POINTS)]
            lines.append(
                {
                    "type": "scatter",
                    "mode": "lines",
                    "name": label,
                    "x": [round(100 * share, 2) for share, _ in thinned],
                    "y": [float(f"{value:.5g}") for _, value in thinned],
                    "line": {"width": 1.6, "color": paint},
                    "opacity": 1 / (1 + 0.35 * place),
                    "hovertemplate": "%{y}",
                }
            )
        choices[figure.replace("_", " ")] = lines
    if not choices:
        return None
    layout = {
        "xaxis": {"ticksuffix": " %", "title": {"text": "share of the training"}, "fixedrange": True},
        "yaxis": {"fixedrange": True},
        "showlegend": len(curves) > 1,
        "hovermode": "x",
    }
    return _chart(title, _legend(layout), 280, choices=choices)


def _chart(title: str, layout: Chart, height: int, **traces: Any) -> Chart:
    return {"title": title, "layout": layout, "height": height, **traces}


def _legend(layout: Chart) -> Chart:
    """``layout`` with a legend below: beside the chart there is no room on a phone."""
    below = {"orientation": "h", "yref": "container", "y": 0, "yanchor": "bottom", "x": 0}
    return {"legend": below, **layout}


def _style(agents: Sequence[str], agent: str, place: int) -> Chart:
    """Name, colour, mark and dashes of an agent's line; references are dashed."""
    paint = plots.colour(agents, agent)
    return {
        "type": "scatter",
        "mode": "lines+markers",
        "name": agent_label(agent),
        "line": {"color": paint, "width": 2, "dash": "dash" if is_reference(agent) else "solid"},
        "marker": {"color": paint, "symbol": _SYMBOLS[place % len(_SYMBOLS)], "size": 9},
    }


def _wrapped(agent: str) -> str:
    """The name of an agent in lines that leave a phone room for its bar."""
    return "<br>".join(textwrap.wrap(agent_label(agent), 15))


def _percent(rate: float) -> float:
    return round(100 * rate, 3)


def _up(rate: plots.Rate) -> float:
    return _percent(rate[2] - rate[0])


def _down(rate: plots.Rate) -> float:
    return _percent(rate[0] - rate[1])


def _words(rate: plots.Rate) -> str:
    return f"{percent(rate[0])} % [{interval(rate[1], rate[2])}]"

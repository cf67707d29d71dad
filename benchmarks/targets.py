"""The figures that the project set itself, and whether the tables of a run meet them."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

from benchmarks.labels import env_label, interval, percent, points, points_interval
from benchmarks.pages import markdown_table
from benchmarks.tables import ComparisonRow, SummaryRow

VEHICLE, PANDA = "RISE-GroundVehicle-v0", "RISE-SafePanda-v0"
METRICS = ("safety", "reach")
_NAMES = {"safety": "Safety Rate", "reach": "Reach Rate"}
_HEADER = ("Figure", "Task", "Safety Rate, %", "Reach Rate, %", "Target", "Met")


@dataclass(frozen=True)
class Figure:
    """A rate, or a difference of rates, with its 95 % interval; a share, not a percentage."""

    value: float
    low: float
    high: float


@dataclass(frozen=True)
class Rule:
    """What is asked of a figure.

    Attributes:
        text: how a page says it, with a place for the bound in per cent or percentage points.
        holds: whether a figure meets the bound, a share.
    """

    text: str
    holds: Callable[[Figure, float], bool]


AT_LEAST = Rule("≥ {}", lambda x, bound: x.value >= bound)
ABOVE = Rule("> {}", lambda x, bound: x.value > bound)
SURELY_ABOVE = Rule("> {}, all of the interval", lambda x, bound: x.low > bound)
NOT_BELOW = Rule(
    "≥ {}, or the interval holds it", lambda x, bound: x.value >= bound or x.low <= bound <= x.high
)


@dataclass(frozen=True)
class Target:
    """One line of the table: both rates of a row, or by how much it exceeds another, under one condition.

    Attributes:
        agent: row of the tables.
        model: noise model; of no account at level 0, which is the same for all.
        level: noise level.
        env: task.
        bounds: of Safety and Reach Rate, in per cent or percentage points.
        rule: what the bounds are.
        other: row that is subtracted; none if empty.
    """

    agent: str
    model: str
    level: float
    env: str
    bounds: tuple[float, float]
    rule: Rule = AT_LEAST
    other: str = ""

    @property
    def title(self) -> str:
        """What is measured, as a page names it."""
        who = f"`{self.agent}` − `{self.other}`" if self.other else f"`{self.agent}`"
        return f"{who}, `{self.model}` {self.level:g}" if self.level else f"{who}, level 0"

    @property
    def asked(self) -> str:
        """The bounds, as a page names them."""
        texts = [f"{bound:g}".replace("-", "−") for bound in self.bounds]
        return self.rule.text.format(" / ".join(dict.fromkeys(texts)))


TARGETS = (
    *(
        Target("rise", "step", 1.0, env, (0.0, 0.0), SURELY_ABOVE, other)
        for other in ("pcbc", "cppo")
        for env in (VEHICLE, PANDA)
    ),
    *(Target("rise-belief", "step", 1.0, env, (0.0, 0.0), SURELY_ABOVE, "cppo") for env in (VEHICLE, PANDA)),
    Target("rise-belief-shield", "step", 1.0, VEHICLE, (99.5, 98.0)),
    Target("rise-belief-shield", "step", 1.0, PANDA, (98.0, 97.0)),
    Target("rise-belief", "step", 1.0, VEHICLE, (98.0, 97.0)),
    Target("rise-belief", "step", 1.0, PANDA, (95.0, 94.0)),
    Target("rise-belief", "step", 2.0, VEHICLE, (98.0, 96.0)),
    Target("rise-belief", "step", 2.0, PANDA, (88.0, 87.0)),
    Target("rise-belief", "episode", 1.0, VEHICLE, (96.0, 93.0)),
    Target("rise-belief", "episode@position", 1.0, VEHICLE, (0.0, 0.0), ABOVE, "expert-cbf"),
    *(Target("rise-belief", "", 0.0, env, (0.0, 0.0), NOT_BELOW, "pcbc") for env in (VEHICLE, PANDA)),
    *(Target("rise", "", 0.0, env, (-1.0, -1.0), AT_LEAST, "pcbc") for env in (VEHICLE, PANDA)),
)


def measured(
    target: Target, summary: Sequence[SummaryRow], comparisons: Sequence[ComparisonRow]
) -> dict[str, Figure] | None:
    """The figures of a target, by metric; None if the tables lack its rows or its condition."""
    if not target.other:
        found = (_rates(row) for row in summary if _under(target, row) and row.agent == target.agent)
    else:
        pair = (target.agent, target.other)
        found = (
            _differences(row, turned=row.agent != target.agent)
            for row in comparisons
            if _under(target, row) and (row.agent, row.other) in (pair, pair[::-1])
        )
    return next(found, None)


def met(target: Target, figures: Mapping[str, Figure]) -> dict[str, bool]:
    """Whether each metric meets its bound."""
    return {
        metric: target.rule.holds(figures[metric], bound / 100)
        for metric, bound in zip(METRICS, target.bounds, strict=True)
    }


def acceptance(
    summary: Sequence[SummaryRow], comparisons: Sequence[ComparisonRow], targets: Sequence[Target] = TARGETS
) -> str:
    """Markdown: how many targets are met, and a table of them all."""
    lines, counts = [], {"yes": 0, "not measured": 0}
    for target in targets:
        figures = measured(target, summary, comparisons)
        verdict = _verdict(target, figures)
        counts[verdict] = counts.get(verdict, 0) + 1
        cells = [_cell(target, figures[metric]) if figures else "–" for metric in METRICS]
        lines.append([target.title, env_label(target.env), *cells, target.asked, verdict])
    tested = len(lines) - counts["not measured"]
    lacking = f"; {counts['not measured']} not measured" if counts["not measured"] else ""
    head = f"{counts['yes']} of {tested} targets are met on both rates{lacking}. In brackets: 95 % intervals."
    table = markdown_table(_HEADER, ("---", "---", "---:", "---:", "---", "---"), lines)
    return f"{head}\n\n{table}\n"


def _under(target: Target, row: SummaryRow | ComparisonRow) -> bool:
    same_model = row.noise_model == target.model or target.level == 0
    return row.env == target.env and row.noise_level == target.level and same_model


def _rates(row: SummaryRow) -> dict[str, Figure]:
    return {m: Figure(*(getattr(row, f"{m}_{part}") for part in ("rate", "low", "high"))) for m in METRICS}


def _differences(row: ComparisonRow, turned: bool) -> dict[str, Figure]:
    """By how much ``agent`` exceeds ``other``, or ``turned`` the other way round."""
    figures = {}
    for metric in METRICS:
        value, low, high = (getattr(row, f"{metric}_{part}") for part in ("diff", "low", "high"))
        figures[metric] = Figure(0 - value, 0 - high, 0 - low) if turned else Figure(value, low, high)
    return figures


def _verdict(target: Target, figures: Mapping[str, Figure] | None) -> str:
    if figures is None:
        return "not measured"
    good = [_NAMES[metric] for metric, holds in met(target, figures).items() if holds]
    return "yes" if len(good) == len(METRICS) else f"only {good[0]}" if good else "no"


def _cell(target: Target, figure: Figure) -> str:
    if target.other:
        return f"{points(figure.value)} {points_interval(figure.low, figure.high)}"
    return f"{percent(figure.value)} [{interval(figure.low, figure.high)}]"

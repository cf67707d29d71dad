"""A run in a few numbers: pure functions of its log."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rise_agents.runtime.log import Log

TOLERANCE = 0.1  # of the period: what counts as on time


@dataclass(frozen=True)
class Summary:
    """What a run was like.

    Attributes:
        periods: that were run.
        missed: that were left out, since others took too long.
        error_p50: median over periods of how far duration / period is from 1.
        error_p99: its 99th percentile.
        on_time: share of periods within 10 % of the nominal one.
        work_p99: 99th percentile of the time from the beginning of a period until its command (s).
        overruns: periods whose work ended after the next one should have begun.
        age: greatest age (s) of a reading that was acted on; NaN: none was.
        stops: why the robot was stopped, in order.
        standing: share of periods without a command of the policy.
        episodes: that began.
        goals: times that a goal was reached.
        collisions: times that clearance fell below 0.
        clearance: least one (m); NaN: unknown.
    """

    periods: int
    missed: int
    error_p50: float
    error_p99: float
    on_time: float
    work_p99: float
    overruns: int
    age: float
    stops: tuple[str, ...]
    standing: float
    episodes: int
    goals: int
    collisions: int
    clearance: float


def errors(log: Log) -> NDArray[np.float64]:
    """How far each period's duration was from the nominal one, as a share of it, (T − 1,)."""
    return np.abs(np.diff(log.numbers["begin"]) / float(log.about["period"]) - 1.0)


def summarise(log: Log) -> Summary:
    """The numbers of a log; its ``about`` tells the ``period`` (s)."""
    error = errors(log) if len(log) > 1 else np.zeros(1)
    events = [event for row in log.events for event in row.split("; ") if event]
    going = np.isfinite(log.vectors["wanted"]).all(1)
    clearance = log.numbers["clearance"]
    known = clearance[np.isfinite(clearance)]
    begins = log.flags["begins"]
    return Summary(
        periods=len(log),
        missed=int(log.period[-1]) + 1 - len(log) if len(log) else 0,
        error_p50=float(np.percentile(error, 50)),
        error_p99=float(np.percentile(error, 99)),
        on_time=float((error <= TOLERANCE).mean()),
        work_p99=float(np.percentile(log.numbers["work"], 99)) if len(log) else 0.0,
        overruns=events.count("overrun"),
        age=float(log.numbers["age"][going].max()) if going.any() else np.nan,
        stops=tuple(event.removeprefix("stop: ") for event in events if event.startswith("stop: ")),
        standing=float(1 - going.mean()) if len(log) else 1.0,
        episodes=int(begins.sum()),
        goals=_rises(log.flags["reached"], begins),
        collisions=_rises(clearance < 0, begins),
        clearance=float(known.min()) if len(known) else np.nan,
    )


def _rises(flag: NDArray[np.bool_], begins: NDArray[np.bool_]) -> int:
    """How often a flag became true; an episode that begins with it counts anew."""
    before = np.concatenate(([False], flag[:-1])) & ~begins
    return int((flag & ~before).sum())


def text(s: Summary) -> str:
    """For people."""
    age = "none acted on" if np.isnan(s.age) else f"{1e3 * s.age:.1f} ms at most when acted on"
    gap = "unknown" if np.isnan(s.clearance) else f"{s.clearance:.3f} m at least"
    lines = [
        f"periods     {s.periods:,} run, {s.missed} missed, {s.overruns} overran; command after "
        f"{1e3 * s.work_p99:.1f} ms (p99)",
        f"timing      {100 * s.on_time:.2f} % within {100 * TOLERANCE:.0f} % of the period; error p50 "
        f"{100 * s.error_p50:.2f} %, p99 {100 * s.error_p99:.2f} %",
        f"readings    {age}",
        f"stops       {len(s.stops)}; standing {100 * s.standing:.1f} % of the time",
        *(f"            {words}" for words in s.stops[:10]),
        f"task        {s.episodes} episodes, {s.goals} goals reached, {s.collisions} collisions, clearance {gap}",
    ]
    return "\n".join(lines)

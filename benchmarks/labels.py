"""Names and numbers as people read them; shared by tables, figures and pages."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING

from rise_agents.filters import FILTERS, filter_class
from rise_envs.noise import parts_of

if TYPE_CHECKING:
    from benchmarks.tables import SummaryRow

REFERENCES = ("expert", "random")  # rows to compare with, not agents under test
TRUE = "true"  # ``ROW+true``: the row on true readings, at whatever level the others meet noise
_AGENTS = {
    "rise": "RISE",
    "pcbc": "PC-BC",
    "cppo": "C-PPO",
    "rise-belief": "RISE-belief",
    "expert": "Expert",
    "random": "Random",
}
_ENVS = {  # others are read off their id
    "RISE-SafePanda-v0": "Franka Panda",
    "RISE-SafePandaKinematic-v0": "Franka Panda, kinematic model",
}
_NOISE = {
    "step": "fresh noise at every step",
    "outlier": "fresh noise with outliers",
    "episode": "one constant error per episode",
    "drift": "a drifting error",
    "dropout": "lost readings",
    "delay": "delayed readings",
    "quantise": "rounded readings",
}
_GROUPS = {"position": "positions", "velocity": "velocities", "radius": "radii"}


def split_row(row: str) -> tuple[str, str]:
    """Who acts in a row of the tables, and what stands before it: ``pcbc+kalman`` is ("pcbc", "kalman")."""
    base, _, filtered = row.partition("+")
    return base, filtered


def is_reference(row: str) -> bool:
    """Whether a row of the tables is one to compare with: chance, or an expert (``expert``, ``expert-cbf``, …)."""
    return split_row(row)[0].split("-")[0] in REFERENCES


def name_rows(labels: Mapping[str, str]) -> None:
    """Say how rows are called from here on in this process: those that no registry knows, such as variants."""
    _AGENTS.update(labels)


def agent_label(name: str) -> str:
    """The usual spelling of a row's name: "RISE", "Expert (cbf)", "PC-BC behind a Kalman filter".

    Names that neither a registry nor :func:`name_rows` knows stay as they are.
    """
    base, filtered = split_row(name)
    kind, _, which = base.partition("-")
    label = f"Expert ({which})" if kind == "expert" and which else _AGENTS.get(base, base)
    if filtered == TRUE:
        return f"{label} on true readings"
    if filtered in FILTERS:
        return f"{label} {filter_class(filtered).label}"
    return f"{label}+{filtered}" if filtered else label


def env_label(env: str) -> str:
    """A task in plain words: ``RISE-GroundVehicle-v0`` is "Ground vehicle"; foreign ids keep theirs."""
    match = re.fullmatch(r"RISE-(\w+)-v\d+", env)
    if env in _ENVS or match is None:
        return _ENVS.get(env, env)
    return re.sub(r"(?<=[a-z0-9])(?=[A-Z])", " ", match[1]).capitalize()


def model_order(model: str) -> tuple[bool, str]:
    """By what noise models are sorted: the paper's first, then by name."""
    return model != "step", model


def noise_label(model: str) -> str:
    """A noise model (``rise_envs.noise``) in a few words: ``delay:2@position`` is "delayed readings (2), …"."""
    return " + ".join(
        _NOISE.get(name, name)
        + f" ({':'.join(values)})" * bool(values)
        + f", {_GROUPS.get(group, group)} only" * bool(group)
        for name, values, group in parts_of(model)
    )


def condition_label(model: str, level: float) -> str:
    """A noise model at a level, in words."""
    return f"noise level {level:g} ({noise_label(model) if level else 'clean readings'})"


def percent(rate: float) -> str:
    """A rate in [0, 1] as a percentage without its sign: one decimal, or two where one would lie.

    Only a true 1 reads "100.0" and only a true 0 reads "0.0": one collision in 5,000 must stay visible.
    """
    text = f"{100 * rate:.1f}"
    if text in ("0.0", "100.0") and rate not in (0.0, 1.0):
        return f"{min(max(100 * rate, 0.01), 99.99):.2f}"
    return text


def interval(low: float, high: float) -> str:
    """An interval of rates, in per cent: ``83.6–87.9``."""
    return f"{percent(low)}–{percent(high)}"


def points(difference: float) -> str:
    """A difference of rates in percentage points, without "points": ``9.9``, ``−0.3``."""
    return "−" * (difference < 0) + percent(abs(difference))


def points_interval(low: float, high: float) -> str:
    """An interval of a difference of rates, in percentage points: ``[−1.2, 2.0]``."""
    return f"[{points(low)}, {points(high)}]"


def p_value(p: float) -> str:
    """``p < 0.001``, or two significant digits: ``p = 0.012``."""
    return "p < 0.001" if p < 0.001 else f"p = {p:.2g}"


def count(values: Iterable[int], noun: str) -> str:
    """How many of something there are in every row: "1,000 episodes", "1 episode", "500–1,000 episodes"."""
    counts = sorted(set(values))
    text = "–".join(f"{n:,}" for n in dict.fromkeys((counts[0], counts[-1])))
    return f"{text} {noun}" if counts[-1] == 1 else f"{text} {noun}s"


def headline(levels: Iterable[float]) -> float:
    """The noise level that figures, clips and sentences speak of: the paper's, 1, or the one nearest it."""
    return min(levels, key=lambda level: (abs(level - 1), level))


def several_seeds(rows: Iterable[SummaryRow]) -> bool:
    """Whether intervals of ``rows`` are the bootstrap's over training seeds and scenarios, not Wilson's."""
    return any(row.train_seeds > 1 for row in rows)


def sample(rows: Sequence[SummaryRow], mark: str) -> str:
    """How much evidence a ``mark`` stands for: "5,000 episodes per bar of 5 training seeds"."""
    # Reference rows are not trained: they say nothing about training seeds.
    seeds = {row.train_seeds for row in rows if not is_reference(row.agent)} or {1}
    trained = "" if seeds == {1} else f" of {count(seeds, 'training seed')}"
    return f"{count([row.episodes for row in rows], 'episode')} per {mark}{trained}"

"""What a run found, in words and tables: text for the terminal and ``summary.md``."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from typing import Any

from rich import box
from rich.console import Console
from rich.table import Table

from benchmarks.labels import (
    agent_label,
    condition_label,
    count,
    env_label,
    interval,
    noise_label,
    percent,
    sample,
)
from benchmarks.results import SummaryRow, headline_level

FIGURES = {
    "comparison.png": "Safety Rate and Reach Rate of every agent",
    "noise_curve.png": "Safety Rate and Reach Rate against the noise level",
}
_COLUMNS = (
    "Agent",
    "Noise level",
    "Safety Rate % [95 %]",
    "Reach Rate % [95 %]",
    "Arrived %",
    "Mean cost",
    "Mean steps",
)
_MEANING = """\
**Safety Rate**: episodes without any collision. **Reach Rate**: episodes that reach the goal without any \
collision. **Arrived**: episodes that reach the goal, collisions ignored. **Mean cost**: steps in collision \
per episode. In brackets: 95 % Wilson intervals over all episodes.\
"""


def summary_table_text(summary: Sequence[SummaryRow], env: str) -> str:
    """The results of one environment as a text table, 80 columns wide or as wide as its agents' names need.

    Raises:
        ValueError: no rows of ``env``.
    """
    rows = _rows_of(summary, env)
    table = Table(box=box.SIMPLE_HEAD, pad_edge=False)
    for name in _COLUMNS:
        words = name.replace(" %", "\n%", 1).replace("Mean ", "Mean\n").replace("Noise ", "Noise\n")
        table.add_column(words, justify="left" if name == "Agent" else "right", no_wrap=True)
    for index, row in enumerate(rows):
        last_of_level = index + 1 == len(rows) or _condition(rows[index + 1]) != _condition(row)
        table.add_row(*_cells(row, rows), end_section=last_of_level)
    text = io.StringIO()
    Console(file=text, width=200, color_system=None).print(table)
    lines = [_title(rows), *text.getvalue().strip("\n").splitlines()]
    return "\n".join(line.rstrip() for line in lines) + "\n"


def summary_markdown(summary: Sequence[SummaryRow], run: Mapping[str, Any]) -> str:
    """The page ``summary.md``: the findings in words, figures, a table per task, training, how to repeat.

    Args:
        summary: rows of :func:`benchmarks.results.summarise`.
        run: ``command`` (how to repeat the run); ``agents`` (name → facts of its training, which may be
            mappings themselves, such as facts per environment); optionally ``figures`` (relative path →
            caption; pictures are shown, other files linked), by default :data:`FIGURES`.

    Raises:
        ValueError: an empty summary.
    """
    if not summary:
        raise ValueError("no results to report: the summary is empty")
    envs = list(dict.fromkeys(row.env for row in summary))
    blocks = ["# Results", *(_findings(_rows_of(summary, env)) for env in envs)]
    for path, caption in run.get("figures", FIGURES).items():
        blocks.append(f"{'!' if path.endswith('.png') else ''}[{caption}]({path})")
    blocks += ["## Tables", _MEANING]
    for env in envs:
        rows = _rows_of(summary, env)
        blocks += [f"### {_title(rows)}", _markdown_table(rows)]
    lines = [line for name, facts in run["agents"].items() for line in _fact(agent_label(name), facts)]
    if lines:
        blocks += ["## How the agents were trained", "\n".join(lines)]
    blocks += ["## How to repeat", f"```sh\n{run['command']}\n```"]
    return "\n\n".join(blocks) + "\n"


def _condition(row: SummaryRow) -> tuple[str, float]:
    return row.noise_model, row.noise_level


def _rows_of(summary: Sequence[SummaryRow], env: str) -> list[SummaryRow]:
    """The rows of one env by noise, so that the agents that met the same noise stand together."""
    rows = [row for row in summary if row.env == env]
    if not rows:
        raise ValueError(
            f"no results of {env}; there are some of {', '.join(sorted({r.env for r in summary}))}"
        )
    return sorted(rows, key=_condition)  # stable: agents keep their order


def _title(rows: Sequence[SummaryRow]) -> str:
    models = " / ".join(noise_label(model) for model in dict.fromkeys(row.noise_model for row in rows))
    return f"{env_label(rows[0].env)}: {models}, {sample(rows, 'row')}"


def _cells(row: SummaryRow, rows: Sequence[SummaryRow]) -> tuple[str, ...]:
    """What a table says of ``row``; it names the noise model only where ``rows`` have several."""
    model = f"{row.noise_model} " if len({r.noise_model for r in rows}) > 1 else ""
    return (
        agent_label(row.agent),
        f"{model}{row.noise_level:g}",
        f"{percent(row.safety_rate)} [{interval(row.safety_low, row.safety_high)}]",
        f"{percent(row.reach_rate)} [{interval(row.reach_low, row.reach_high)}]",
        percent(row.arrival_rate),
        f"{row.mean_cost:.2f}",
        f"{row.mean_steps:.1f}",
    )


def _findings(rows: Sequence[SummaryRow]) -> str:
    """The rates of one env at the headline level, in a sentence for each noise model."""
    level = headline_level(rows)
    sentences = [f"**{env_label(rows[0].env)}.**"]
    for model in dict.fromkeys(row.noise_model for row in rows if row.noise_level == level):
        first, *others = (_clause(row) for row in rows if _condition(row) == (model, level))
        agent, safe, reached, episodes = first
        clauses = [
            f"{agent} kept {safe} of {episodes} safe and reached the goal without collision in {reached}"
        ]
        clauses += [f"{agent} {safe} and {reached}" for agent, safe, reached, _ in others]
        sentences.append(f"At {condition_label(model, level)} {'; '.join(clauses)}.")
    return " ".join(sentences)


def _clause(row: SummaryRow) -> tuple[str, str, str, str]:
    """Agent, Safety Rate, Reach Rate and number of episodes, ready for a sentence."""
    safe = f"{percent(row.safety_rate)} % ({interval(row.safety_low, row.safety_high)})"
    reached = f"{percent(row.reach_rate)} % ({interval(row.reach_low, row.reach_high)})"
    return agent_label(row.agent), safe, reached, count([row.episodes], "episode")


def _markdown_table(rows: Sequence[SummaryRow]) -> str:
    lines = [_COLUMNS, ("---",) + ("---:",) * (len(_COLUMNS) - 1), *(_cells(row, rows) for row in rows)]
    return "\n".join(f"| {' | '.join(cells)} |" for cells in lines)


def _fact(name: str, value: Any, indent: str = "") -> list[str]:
    """``name: value`` as a list item; a mapping is one line, or a list if it holds mappings."""
    if not isinstance(value, Mapping):
        return [f"{indent}- {name}: {_plain(value)}"]
    if not any(isinstance(inner, Mapping) for inner in value.values()):
        facts = ", ".join(f"{_words(key)} {_plain(inner)}" for key, inner in value.items())
        return [f"{indent}- **{name}**: {facts}" if facts else f"{indent}- **{name}**"]
    lines = [f"{indent}- **{name}**"]
    for key, inner in value.items():
        lines += _fact(env_label(_words(key)), inner, indent + "  ")
    return lines


def _words(key: str) -> str:
    return key.replace("_", " ")


def _plain(value: Any) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, int):
        return f"{value:,}"
    if isinstance(value, float):
        return f"{value:g}"
    if isinstance(value, (list, tuple)):
        return f"[{', '.join(_plain(item) for item in value)}]"
    return str(value)

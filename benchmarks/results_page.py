"""The page of published results: blocks that follow from the tables beside it, among words that people wrote."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from benchmarks.labels import agent_label, count, env_label, interval, name_rows, noise_label, percent, sample
from benchmarks.pages import Block, csv_text, markdown_table
from benchmarks.report import EPISODES, claims, others_figure, read_run, what_is_left
from benchmarks.results import atomic_write_text, read_rows
from benchmarks.sections import Section, compared, sections
from benchmarks.tables import ComparisonRow, SummaryRow, analyse, headline_level, read_table
from benchmarks.targets import acceptance
from rise_agents import AGENTS, agent_class
from rise_agents.agent import config_to_dict, make_config

PAGE = "README.md"
SUMMARY, COMPARISONS = "summary.csv", "comparisons.csv"
_TOLD = ("run", "settings", "claims", "acceptance", "controls", "tables")
BLOCKS = {name: Block(name, "make results") for name in _TOLD}
_SKELETON = """\
# Results

`episodes.parquet` holds every episode, a row each; all tables and figures here follow from it.

## What was run

{run}

## How to repeat

The command above (without `--published` and `--hours`, if it has them) runs everything anew; `make results` then renews
this folder. Without running anything, from the episodes that are here:

```sh
python -m benchmarks.report docs/results --out tables   # the same CSV files, byte for byte
python -m benchmarks.publish docs/results --check       # whether tables and page are those of the episodes
```

## Settings

{settings}

## What the figures say

![Safety Rate and Reach Rate of every agent](comparison.png)

![Safety Rate and Reach Rate against the noise level](noise_curve.png)

{claims}

## Targets

{acceptance}

## Controls

{controls}

## What was tried and failed

## Tables

{tables}
"""


def check_page(folder: Path) -> None:
    """Raise ``ValueError`` if there is a page in ``folder`` that lacks a block."""
    if (folder / PAGE).exists():
        for block in BLOCKS.values():
            block.check(folder / PAGE)


def renew_page(folder: Path) -> None:
    """Renew the blocks of the page from the tables in ``folder``; a page that is not there is begun.

    Raises:
        ValueError: a table or block is missing or damaged.
        OSError: the page cannot be written.
    """
    path = folder / PAGE
    page = path.read_text() if path.exists() else _begun()
    atomic_write_text(path, _filled(page, contents(folder)))


def contents(folder: Path) -> dict[str, str]:
    """What belongs in each of :data:`BLOCKS`, from ``summary.csv``, ``comparisons.csv`` and ``run.json``."""
    summary = read_table(folder / SUMMARY, SummaryRow)
    comparisons = read_table(folder / COMPARISONS, ComparisonRow)
    run = read_run(folder)
    name_rows(run.get("labels", {}))
    asked, *others = sections(summary, run.get("blocks", ()))
    return {
        "run": what_was_run(asked.rows, run),
        "settings": settings_tables(asked.rows, run),
        "claims": "\n\n".join(claims(asked.rows)),
        "acceptance": acceptance(summary, comparisons),
        "controls": control_tables(others) or "Nothing else was measured.",
        "tables": compact_tables(asked.rows),
    }


def stale(folder: Path) -> list[str]:
    """What in a folder of published results is not what its episodes say: files, and blocks of the page.

    Raises:
        ValueError: there are no such results, or a file is damaged.
    """
    run = read_run(folder)
    name_rows(run.get("labels", {}))
    groups = compared(run.get("blocks", ()))
    summary, comparisons = analyse(read_rows(folder / EPISODES), run.get("rows", ()), groups)
    expected = {SUMMARY: csv_text(SummaryRow, summary), COMPARISONS: csv_text(ComparisonRow, comparisons)}
    found = [name for name, text in expected.items() if _bytes(folder / name) != text.encode()]
    if found:
        return found  # the page speaks of these tables
    page = BLOCKS["run"].check(folder / PAGE)
    check_page(folder)
    texts = contents(folder).items()
    return [f"{PAGE}, block {name}" for name, text in texts if BLOCKS[name].replaced(page, text) != page]


def what_was_run(summary: Sequence[SummaryRow], run: Mapping[str, Any]) -> str:
    """Markdown: the command, what of it is not done, and how much was measured in each environment."""
    lines = [f"```sh\n{run['command']}\n```\n"] if "command" in run else []
    lines += [f"{sentence}\n" for sentence in what_is_left(run)]
    for env in dict.fromkeys(row.env for row in summary):
        rows = [row for row in summary if row.env == env]
        models = ", ".join(f"`{model}`" for model in dict.fromkeys(row.noise_model for row in rows))
        levels = ", ".join(f"{level:g}" for level in sorted({row.noise_level for row in rows}))
        amount = f"{count([len({row.agent for row in rows})], 'row')}, {sample(rows, 'row')} and condition"
        lines.append(f"- **{env_label(env)}**: {amount}; noise {models}, levels {levels}")
    return "\n".join(lines)


def settings_tables(summary: Sequence[SummaryRow], run: Mapping[str, Any]) -> str:
    """Markdown: a table per task of what each agent learned from, and in which settings it is not as its defaults."""
    blocks = []
    for env in dict.fromkeys(row.env for row in summary):
        names = dict.fromkeys(row.agent for row in summary if row.env == env)
        trained = {name: run.get("training", {}).get(name, {}).get(env) for name in names}
        lines = [
            [
                agent_label(name),
                entry.get("learned from", "–"),
                _chosen(run["variants"].get(name, name), env, entry),
            ]
            for name, entry in trained.items()
            if entry
        ]
        if lines:
            header = ("Agent", "Learned from", "Settings other than its defaults")
            blocks += [f"{env_label(env)}:", markdown_table(header, ["---"] * 3, lines)]
    return "\n\n".join(blocks) or "No agent was trained."


def _chosen(agent: str, env: str, entry: Mapping[str, Any]) -> str:
    """Those of an entry of ``training`` in ``run.json``; settings that this version does not know count, too."""
    defaults = config_to_dict(make_config(agent_class(agent), env, {})) if agent in AGENTS else {}
    facts = ("learned from", "training time")
    chosen = {k: v for k, v in entry.items() if k not in facts and (k not in defaults or defaults[k] != v)}
    return ", ".join(f"`{name}` {_value(value)}" for name, value in chosen.items()) or "none"


def _value(value: Any) -> str:
    if isinstance(value, list | tuple):
        return " × ".join(map(_value, value))
    return f"{value:,}" if isinstance(value, int) and not isinstance(value, bool) else str(value)


def compact_tables(summary: Sequence[SummaryRow]) -> str:
    """Markdown: a table per environment and noise model.

    The level of the figures with its intervals, the others as "Safety Rate / Reach Rate".
    """
    blocks = ["All in per cent; in brackets: 95 % intervals; at other levels: Safety Rate / Reach Rate."]
    for env, model in dict.fromkeys((row.env, row.noise_model) for row in summary):
        rows = [row for row in summary if (row.env, row.noise_model) == (env, model)]
        blocks += [f"### {env_label(env)}: {noise_label(model)} (`{model}`)", _compact_table(rows)]
    return "\n\n".join(blocks)


def control_tables(others: Sequence[Section]) -> str:
    """Markdown: a table per section and task, a column per condition with "Safety Rate / Reach Rate"."""
    envs = dict.fromkeys(row.env for section in others for row in section.rows)
    blocks = [f"![{env_label(env)}: controls, sweeps and other noise]({others_figure(env)})" for env in envs]
    for section in others:
        blocks.append(f"### {section.title}")
        for env in dict.fromkeys(row.env for row in section.rows):
            rows = [row for row in section.rows if row.env == env]
            blocks += [f"{env_label(env)}, {sample(rows, 'row')} and condition:", _condition_table(rows)]
    return "\n\n".join(blocks)


def _condition_table(rows: Sequence[SummaryRow]) -> str:
    """The table of one task: a line per agent, a column per condition, clean readings first."""
    conditions = sorted({(row.noise_level > 0, row.noise_model, row.noise_level) for row in rows})
    by_key = {(row.agent, row.noise_model, row.noise_level): row for row in rows}
    lines = []
    for agent in dict.fromkeys(row.agent for row in rows):
        cells = [by_key.get((agent, model, level)) for _, model, level in conditions]
        lines.append([agent_label(agent), *(_both(row) for row in cells)])
    header = [
        "Agent",
        *(f"`{model}` {level:g}" if noisy else "level 0" for noisy, model, level in conditions),
    ]
    return markdown_table(header, ["---", *["---:"] * len(conditions)], lines)


def _both(row: SummaryRow | None) -> str:
    return f"{percent(row.safety_rate)} / {percent(row.reach_rate)}" if row else "–"


def _compact_table(rows: Sequence[SummaryRow]) -> str:
    """The table of one environment and noise model."""
    headline = headline_level(rows)
    others = [level for level in sorted({row.noise_level for row in rows}) if level != headline]
    by_key = {(row.agent, row.noise_level): row for row in rows}
    at = f"level {headline:g}"
    header = ["Agent", f"Safety Rate, {at}", f"Reach Rate, {at}", *(f"level {level:g}" for level in others)]
    lines = []
    for agent in dict.fromkeys(row.agent for row in rows):
        cells = _rates(by_key.get((agent, headline)))
        for level in others:
            cells.append(_both(by_key.get((agent, level))))
        lines.append([agent_label(agent), *cells])
    return markdown_table(header, ["---", *["---:"] * (len(header) - 1)], lines)


def _rates(row: SummaryRow | None) -> list[str]:
    """Both rates with their intervals."""
    if row is None:
        return ["–", "–"]
    return [
        f"{percent(row.safety_rate)} [{interval(row.safety_low, row.safety_high)}]",
        f"{percent(row.reach_rate)} [{interval(row.reach_low, row.reach_high)}]",
    ]


def _begun() -> str:
    """A page with empty blocks."""
    return _SKELETON.format(**{name: f"{block.begin}\n\n{block.end}" for name, block in BLOCKS.items()})


def _filled(page: str, texts: Mapping[str, str]) -> str:
    for name, text in texts.items():
        page = BLOCKS[name].replaced(page, text)
    return page


def _bytes(path: Path) -> bytes:
    """A file's content; raises ``ValueError`` if it cannot be read."""
    try:
        return path.read_bytes()
    except OSError as error:
        raise ValueError(f"cannot read {path}: {error.strerror}") from None

"""The results as people read them: a table in the terminal, ``faults.md``, and the block of the documentation."""

from __future__ import annotations

from collections.abc import Sequence

from rich import box
from rich.table import Table

from benchmarks.faults.measure import Result
from benchmarks.faults.rows import ROWS
from benchmarks.pages import FAULTS, markdown_table, table_lines

BLOCK = FAULTS
_COLUMNS = ("", "Trials", "Looked for", "Found", "Target", "Met")


def cells(result: Result) -> tuple[str, ...]:
    """A row of the table as words."""
    row = ROWS.get(result.name)
    title, trials, faults = (row.title, row.trials, row.faults) if row else (result.name, "", "")
    counted = f"{result.trials:,} {trials}" if result.trials else "–"
    return title, counted, faults, result.found, result.target, result.met


def table_text(results: Sequence[Result], width: int = 170) -> str:
    """The table for a terminal."""
    table = Table(box=box.SIMPLE_HEAD, pad_edge=False)
    for place, name in enumerate(_COLUMNS):
        table.add_column(name, justify="right" if place == 1 else "left", no_wrap=place != 2)
    for result in results:
        table.add_row(*(cell.replace("`", "") for cell in cells(result)))
    return table_lines(table, width, (f"{r.name}: {r.note}" for r in results if r.note))


def markdown(results: Sequence[Result], about: str) -> str:
    """The machine, the table and its notes."""
    rules = ("---", "---:", "---", "---", "---", "---")
    seeds = {result.seed for result in results}
    shares = {result.share for result in results}
    if shares != {1.0}:
        about += " Shares of the full number of trials: " + ", ".join(f"{s:g}" for s in sorted(shares)) + "."
    blocks = [f"{about} Seed: {', '.join(map(str, sorted(seeds)))}."]
    blocks.append(markdown_table(_COLUMNS, rules, [cells(result) for result in results]))
    notes = [f"- {cells(result)[0]}: {result.note}." for result in results if result.note]
    return "\n\n".join([*blocks, *(["\n".join(notes)] if notes else [])]) + "\n"

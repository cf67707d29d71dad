"""The results as people read them: a table in the terminal, ``speed.md``, and the block of the documentation."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from rich import box
from rich.table import Table

from benchmarks.pages import SPEED, markdown_table, table_lines
from benchmarks.speed.measure import Result
from benchmarks.speed.rows import ROWS

BLOCK = SPEED
_COLUMNS = ("", "Ours", "Peer", "", "Ratio [quartiles]", "Target", "Met")


def quantity(value: float | None, unit: str) -> str:
    """A figure with three digits and its unit: "14.5 M steps/s", "23.1 µs"."""
    if value is None:
        return "–"
    if value >= 1e6:
        return f"{value / 1e6:,.3g} M {unit}"
    digits = f"{value:.3g}"
    return f"{float(digits):,.0f} {unit}" if abs(value) >= 100 else f"{digits} {unit}"


def cells(result: Result) -> tuple[str, ...]:
    """A row of the table as words."""
    title = ROWS[result.name].title if result.name in ROWS else result.name
    theirs = quantity(result.peer_value, result.unit) if result.peer else ""
    ratio = ""
    if result.ratio is not None:
        ratio = f"{result.ratio:.3g} × [{result.ratio_low:.3g}–{result.ratio_high:.3g}]"
    return title, quantity(result.value, result.unit), theirs, result.peer, ratio, result.target, result.met


def table_text(results: Sequence[Result], width: int = 140) -> str:
    """The table for a terminal."""
    table = Table(box=box.SIMPLE_HEAD, pad_edge=False)
    for place, name in enumerate(_COLUMNS):
        table.add_column(name, justify="left" if place in (0, 3, 6) else "right", no_wrap=True)
    for result in results:
        table.add_row(*(cell.replace("`", "") for cell in cells(result)))
    return table_lines(table, width, (f"{r.name}: {r.note}" for r in results if r.note))


def markdown(results: Sequence[Result], about: str, picture: str | None) -> str:
    """The machine, the table with its notes, and the picture."""
    rules = ("---", "---:", "---:", "---", "---:", "---:", "---")
    blocks = [about, markdown_table(_COLUMNS, rules, [cells(result) for result in results])]
    notes = [f"- {cells(result)[0]}: {result.note}." for result in results if result.note]
    if notes:
        blocks.append("\n".join(notes))
    if picture:
        blocks.append(f"![Steps per second against the size of the batch]({picture})")
    return "\n\n".join(blocks) + "\n"


def update_page(path: Path, results: Sequence[Result], about: str, picture: Path | None) -> None:
    """Renew the block of a page in ``docs/``; the picture, if any, lies beside or below it.

    Raises:
        ValueError: no such page, or no such block in it.
    """
    link = picture.relative_to(path.parent).as_posix() if picture else None
    BLOCK.update(path, markdown(results, about, link))

"""The results as people read them: a table in the terminal, ``speed.md``, and the block of the documentation."""

from __future__ import annotations

import io
import platform
from collections.abc import Sequence
from importlib import metadata
from pathlib import Path

from rich import box
from rich.console import Console
from rich.table import Table

from benchmarks.results import atomic_write_text
from benchmarks.speed.measure import Result
from benchmarks.speed.rows import ROWS
from rise_agents.workers import available_cores

BEGIN, END = "<!-- speed: begin, made by `make speed` -->", "<!-- speed: end -->"
_COLUMNS = ("", "Ours", "Peer", "", "Ratio [quartiles]", "Target", "Met")
_LIBRARIES = ("numpy", "gymnasium", "torch", "stable-baselines3", "panda-gym", "pybullet", "numba")


def machine() -> str:
    """What was measured on, in a sentence."""
    versions = ", ".join(f"{name} {metadata.version(name)}" for name in _LIBRARIES)
    cores = available_cores()
    return (
        f"{_processor()}, {cores} core{'s' if cores > 1 else ''}{_gpu()}; {platform.system()}, "
        f"Python {platform.python_version()}, {versions}."
    )


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        lines = []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()


def _gpu() -> str:
    import torch

    return f", {torch.cuda.get_device_name()}" if torch.cuda.is_available() else ""


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
    text = io.StringIO()
    Console(file=text, width=width, color_system=None).print(table)
    lines = [line.rstrip() for line in text.getvalue().strip("\n").splitlines()]
    return "\n".join([*lines, *(f"{r.name}: {r.note}" for r in results if r.note)]) + "\n"


def markdown(results: Sequence[Result], about: str, picture: str | None) -> str:
    """The machine, the table with its notes, and the picture."""
    lines = [
        _COLUMNS,
        ("---", "---:", "---:", "---", "---:", "---:", "---"),
        *(cells(result) for result in results),
    ]
    blocks = [about, "\n".join(f"| {' | '.join(row)} |" for row in lines)]
    notes = [f"- {cells(result)[0]}: {result.note}." for result in results if result.note]
    if notes:
        blocks.append("\n".join(notes))
    if picture:
        blocks.append(f"![Steps per second against the size of the batch]({picture})")
    return "\n\n".join(blocks) + "\n"


def replace_block(page: str, content: str) -> str:
    """``page`` with what stands between the two markers replaced.

    Raises:
        ValueError: the markers are not there, once each and in order.
    """
    before, begin, rest = page.partition(BEGIN)
    _, end, after = rest.partition(END)
    if not (begin and end) or BEGIN in rest or END in after:
        raise ValueError(f"the page must hold the lines {BEGIN!r} and {END!r} once, in this order")
    return f"{before}{BEGIN}\n\n{content}\n{END}{after}"


def update_page(path: Path, results: Sequence[Result], about: str, picture: Path | None) -> None:
    """Replace the block of a page in ``docs/``; the picture, if any, lies beside or below it.

    Raises:
        ValueError: no such page, or no such block in it.
    """
    try:
        page = path.read_text()
    except OSError as error:
        raise ValueError(f"cannot read the page {path}: {error.strerror}") from None
    link = picture.relative_to(path.parent).as_posix() if picture else None
    atomic_write_text(path, replace_block(page, markdown(results, about, link)))

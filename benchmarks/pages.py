"""What measured tables share: blocks of documentation pages that a command renews, and the machine's description."""

from __future__ import annotations

import csv
import io
import platform
from collections.abc import Iterable, Sequence
from dataclasses import astuple, dataclass, fields
from importlib import metadata
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from benchmarks.results import atomic_write_text
from rise_agents.workers import available_cores

_LIBRARIES = ("numpy", "gymnasium", "torch", "stable-baselines3", "panda-gym", "pybullet", "numba")


@dataclass(frozen=True)
class Block:
    """What stands between two marking lines of a page, made by a command.

    Attributes:
        name: of the table, in both marks.
        command: that renews it, in the first.
    """

    name: str
    command: str

    @property
    def begin(self) -> str:
        """The line above the block."""
        return f"<!-- {self.name}: begin, made by `{self.command}` -->"

    @property
    def end(self) -> str:
        """The line below the block."""
        return f"<!-- {self.name}: end -->"

    def replaced(self, page: str, content: str) -> str:
        """``page`` with ``content`` in the block.

        Raises:
            ValueError: the marks are not there, once each and in order.
        """
        before, begin, rest = page.partition(self.begin)
        _, end, after = rest.partition(self.end)
        if not (begin and end) or self.begin in rest or self.end in after:
            raise ValueError(
                f"the page must hold the lines {self.begin!r} and {self.end!r} once, in this order"
            )
        return f"{before}{self.begin}\n\n{content.strip()}\n\n{self.end}{after}"

    def check(self, path: Path) -> str:
        """The text of a page that has the block.

        Raises:
            ValueError: no such page, or no such block in it.
        """
        try:
            page = path.read_text()
        except (OSError, ValueError) as error:  # ValueError: no UTF-8, or a name with a null character
            reason = getattr(error, "strerror", None) or error
            raise ValueError(f"cannot read the page {str(path)!r}: {reason}") from None
        try:
            self.replaced(page, "")
        except ValueError as error:
            raise ValueError(f"{str(path)!r}: {error}") from None
        return page

    def update(self, path: Path, content: str) -> None:
        """Write ``content`` into the block of a page; raises as :meth:`check`."""
        atomic_write_text(path, self.replaced(self.check(path), content))


SPEED = Block("speed", "make speed")
FIDELITY = Block("fidelity", "python -m benchmarks.fidelity")
FAULTS = Block("faults", "make faults")
CLUSTER = Block("cluster", "python -m benchmarks.cluster_estimate")


def markdown_table(header: Sequence[str], rules: Sequence[str], lines: Sequence[Sequence[str]]) -> str:
    """A table; ``rules`` are the cells of the line below the header."""
    return "\n".join(f"| {' | '.join(cells)} |" for cells in (header, rules, *lines))


def csv_text(kind: Any, rows: Sequence[Any]) -> str:
    """Rows of the dataclass ``kind`` as CSV; floats with six digits."""
    sink = io.StringIO()
    table = csv.writer(sink, lineterminator="\n")
    table.writerow([field.name for field in fields(kind)])
    for row in rows:
        table.writerow([f"{cell:.6g}" if isinstance(cell, float) else cell for cell in astuple(row)])
    return sink.getvalue()


def csv_lines(path: Path, kind: Any, what: str) -> list[dict[str, str]]:
    """The lines of a table of ``what`` that :func:`csv_text` made of ``kind``, by column.

    Raises:
        ValueError: no such file, or one with other columns.
    """
    try:
        with path.open(newline="") as file:
            reader = csv.DictReader(file)
            header, lines = reader.fieldnames, list(reader)
    except OSError as error:
        raise ValueError(f"cannot read {path}: {error.strerror}") from None
    names = [field.name for field in fields(kind)]
    if header != names:
        raise ValueError(f"{path} is not a table of {what}: expected the columns {', '.join(names)}")
    return lines


def table_lines(table: Table, width: int, notes: Iterable[str]) -> str:
    """A table for a terminal, without spaces at the ends of its lines, and notes below."""
    text = io.StringIO()
    Console(file=text, width=width, color_system=None).print(table)
    lines = [line.rstrip() for line in text.getvalue().strip("\n").splitlines()]
    return "\n".join([*lines, *notes]) + "\n"


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


def reason(error: BaseException) -> str:
    """One line that says what went wrong."""
    lines = str(error).strip().splitlines()
    return f"{type(error).__name__}: {lines[0]}" if lines else type(error).__name__


def renewed(old: Sequence[Any], new: Sequence[Any], order: Iterable[str]) -> list[Any]:
    """Results by name, the ``new`` in place of the ``old`` ones, in ``order``; others are dropped."""
    by_name = {each.name: each for each in (*old, *new)}
    return [by_name[name] for name in order if name in by_name]


def known_machine(out: Path) -> str:
    """What ``machine.txt`` in a folder of measurements says; raises ``ValueError`` if it is not there."""
    try:
        return (out / "machine.txt").read_text().strip()
    except OSError as error:
        raise ValueError(f"cannot read {out / 'machine.txt'}: {error.strerror}") from None

"""The rows of a run in the groups that are measured and compared together."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from benchmarks.tables import SummaryRow


@dataclass(frozen=True)
class Section:
    """Rows of the summary that belong together.

    Attributes:
        title: what they ask; empty for the rows that the run was asked for.
        rows: in the order of the summary.
    """

    title: str
    rows: list[SummaryRow]


def sections(summary: Sequence[SummaryRow], blocks: Sequence[Mapping[str, Any]] = ()) -> list[Section]:
    """The rows of each block of a run, those that were asked for first; other ones that are empty are left out.

    Args:
        summary: of the run.
        blocks: as ``run.json`` has them (:meth:`benchmarks.protocol.Plan.described`); none: all in one section.
    """
    if not blocks:
        return [Section("", list(summary))]
    found = [Section(block["title"], [row for row in summary if _belongs(row, block)]) for block in blocks]
    return [found[0], *(section for section in found[1:] if section.rows)]


def compared(blocks: Sequence[Mapping[str, Any]]) -> list[frozenset[str]]:
    """The rows of each block, by name."""
    return [frozenset(block["rows"]) for block in blocks]


def _belongs(row: SummaryRow, block: Mapping[str, Any]) -> bool:
    """Whether a row is one of a block, under one of its conditions; level 0 is the same for all noise models."""
    model = row.noise_level == 0 or row.noise_model in block["noise_models"]
    env = not block["envs"] or row.env in block["envs"]
    return row.agent in block["rows"] and row.noise_level in block["noise_levels"] and model and env

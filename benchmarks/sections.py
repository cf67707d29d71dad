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
    """The rows of each block of a run, those that were asked for first, noise models in the order of the block.

    Of a run that is not finished, other blocks are left out that have no two rows to compare yet.

    Args:
        summary: of the run.
        blocks: as ``run.json`` has them (:meth:`benchmarks.protocol.Plan.described`); none: all in one section.
    """
    if not blocks:
        return [Section("", list(summary))]
    found = [Section(block["title"], _rows(summary, block)) for block in blocks]
    others = zip(found[1:], blocks[1:], strict=True)
    return [
        found[0],
        *(s for s, block in others if len({r.agent for r in s.rows}) >= min(2, len(block["rows"]))),
    ]


def compared(blocks: Sequence[Mapping[str, Any]]) -> list[frozenset[str]]:
    """The rows of each block, by name."""
    return [frozenset(block["rows"]) for block in blocks]


def _rows(summary: Sequence[SummaryRow], block: Mapping[str, Any]) -> list[SummaryRow]:
    """The rows of a block: task by task, its noise models in their order."""
    envs = list(dict.fromkeys(row.env for row in summary))
    models = list(dict.fromkeys([*block["noise_models"], *(row.noise_model for row in summary)]))
    rows = [row for row in summary if _belongs(row, block)]
    return sorted(rows, key=lambda row: (envs.index(row.env), models.index(row.noise_model)))


def _belongs(row: SummaryRow, block: Mapping[str, Any]) -> bool:
    """Whether a row is one of a block, under one of its conditions; level 0 is the same for all noise models."""
    model = row.noise_level == 0 or row.noise_model in block["noise_models"]
    env = not block["envs"] or row.env in block["envs"]
    return row.agent in block["rows"] and row.noise_level in block["noise_levels"] and model and env

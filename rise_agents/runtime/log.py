"""What happened in a run: one row for each period, kept as Parquet, which holds numbers and texts and runs no code.

Shapes: T periods, S state, D dimensions, C reading channels, A actions.
"""

from __future__ import annotations

import io
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from rise_agents.files import StrPath, replace_file
from rise_agents.runtime.robots import Observed
from rise_agents.runtime.streams import Reading
from rise_envs.task import Task

SCHEMA = "rise runtime 1"
NUMBERS = ("begin", "deadline", "work", "age", "clearance")
FLAGS = ("reached", "begins", "fresh")
VECTORS = ("state", "goal", "reading", "wanted", "action")


@dataclass(frozen=True)
class Times:
    """When a period was.

    Attributes:
        period: its number.
        begin: when it began (s from the start).
        deadline: when it should have.
        work: from its beginning until its command was given (s).
        read: when the reading was looked at, on the loop's clock (s).
    """

    period: int
    begin: float
    deadline: float
    work: float
    read: float


@dataclass(frozen=True)
class Log:
    """A run as columns.

    Attributes:
        about: what was run: agent, environment, settings.
        period: numbers of the periods, (T,); those that are missing were left out.
        numbers: ``begin``, ``deadline``, ``work``, ``age`` of the reading (s), ``clearance`` (m), (T,) each; NaN:
            unknown.
        flags: ``reached``, ``begins`` (an episode), ``fresh`` (the policy began anew), (T,) each.
        vectors: ``state`` (T, S), ``goal`` (T, D), ``reading`` (T, C), ``wanted`` by the policy (T, A) and the
            ``action`` after limits (T, A); NaN: there was none.
        events: words, (T,), parted by ``; ``: ``go``, ``overrun``, ``stop: `` and why, and in the last row how the run
            ended, ``end`` or ``interrupted``, which is no stop by a watchdog.
    """

    about: dict[str, Any]
    period: NDArray[np.int64]
    numbers: dict[str, NDArray[np.float64]]
    flags: dict[str, NDArray[np.bool_]]
    vectors: dict[str, NDArray[np.float64]]
    events: list[str]

    def __len__(self) -> int:
        return len(self.period)


class Recorder:
    """Gathers the rows of a run; keeping them costs a few microseconds a period.

    Args:
        task: gives the widths of states, goals and readings.
        actions: how many: A.
        about: what is run, fit for JSON.
    """

    def __init__(self, task: Task, actions: int, about: Mapping[str, Any] | None = None) -> None:
        widths = task.widths
        self.widths = dict(
            zip(
                VECTORS,
                (widths["observation"], task.dim, widths["obstacle"], actions, actions),
                strict=True,
            )
        )
        self.about = dict(about or {})
        self._rows: list[tuple[Any, ...]] = []
        self._events: list[str] = []
        self._before: list[str] = []  # events before the first row

    def add(
        self,
        times: Times,
        observed: Observed,
        reading: Reading | None,
        wanted: NDArray | None,
        action: NDArray,
        fresh: bool,
        events: Sequence[str],
    ) -> None:
        """Note a period; see :class:`Log`."""
        goal = observed.goal if reading is None or reading.goal is None else reading.goal
        age = math.nan if reading is None else times.read - reading.stamp
        self._rows.append(
            (
                times.period,
                (times.begin, times.deadline, times.work, age, observed.clearance),
                (observed.reached, observed.begins, fresh),
                (
                    observed.state,
                    goal,
                    None if reading is None else reading.obstacle,
                    None if wanted is None else np.array(wanted, np.float64),
                    action,
                ),
            )
        )
        self._events.append("; ".join(event.replace("; ", ", ") for event in (*self._before, *events)))
        self._before.clear()

    def amend(self, event: str) -> None:
        """Add an event to the last period; before the first one, to that."""
        if not self._events:
            self._before.append(event)
        else:
            self._events[-1] = "; ".join(filter(None, (self._events[-1], event.replace("; ", ", "))))

    def log(self) -> Log:
        """What was gathered so far."""
        rows = self._rows
        numbers = np.array([row[1] for row in rows], np.float64).reshape(len(rows), len(NUMBERS))
        flags = np.array([row[2] for row in rows], bool).reshape(len(rows), len(FLAGS))
        vectors = {}
        for i, (name, width) in enumerate(self.widths.items()):
            vectors[name] = np.full((len(rows), width), np.nan)
            for t, row in enumerate(rows):
                if row[3][i] is not None and np.shape(row[3][i]) == (width,):
                    vectors[name][t] = row[3][i]
        return Log(
            self.about,
            np.array([row[0] for row in rows], np.int64),
            {name: numbers[:, i] for i, name in enumerate(NUMBERS)},
            {name: flags[:, i] for i, name in enumerate(FLAGS)},
            vectors,
            list(self._events),
        )


def write(path: StrPath, log: Log) -> None:
    """Store a log, whole or not at all; raises ``OSError`` if it cannot be written."""
    columns: dict[str, Any] = {"period": log.period, **log.numbers, **log.flags, "event": log.events}
    for name, rows in log.vectors.items():
        columns |= {f"{name}.{i}": rows[:, i] for i in range(rows.shape[1])}
    table = pa.table({name: pa.array(column) for name, column in columns.items()})
    about = {"schema": SCHEMA, "about": json.dumps(log.about, sort_keys=True)}
    sink = io.BytesIO()
    pq.write_table(table.replace_schema_metadata(about), sink, compression="zstd", write_page_checksum=True)
    replace_file(path, sink.getvalue())


def read(path: StrPath) -> Log:
    """What :func:`write` stored.

    Raises:
        ValueError: no such file, damaged, or none of ours; names it.
    """
    try:
        content = pa.BufferReader(Path(path).read_bytes())
        table = pq.ParquetFile(content, page_checksum_verification=True).read(use_threads=False)
        table.validate(full=True)
        metadata = {key.decode(): value.decode() for key, value in (table.schema.metadata or {}).items()}
        if metadata["schema"] != SCHEMA:
            raise ValueError(f"has schema {metadata['schema']!r}, this version reads {SCHEMA!r}")
        return _log(table, json.loads(metadata["about"]))
    except OSError as error:
        raise ValueError(f"{path}: cannot be read ({error.strerror or error})") from None
    except (LookupError, TypeError, AttributeError, ValueError, pa.ArrowException) as error:
        raise ValueError(f"{path}: is no log of a run ({str(error).splitlines()[0]})") from None


def _log(table: pa.Table, about: Any) -> Log:
    if not isinstance(about, dict):
        raise ValueError("says nothing of its run")

    def column(name: str, kind: type) -> NDArray:
        found = table.column(name)
        array = found.to_numpy()
        if array.dtype != kind or found.null_count:
            raise ValueError(f"column {name!r} is {found.type}")
        return array.copy()

    vectors = {}
    for name in VECTORS:
        own = [known for known in table.column_names if known.startswith(f"{name}.")]
        vectors[name] = np.stack([column(f"{name}.{i}", np.float64) for i in range(len(own))], -1)
    events = table.column("event").to_pylist()
    if not all(isinstance(event, str) for event in events):
        raise ValueError("column 'event' holds no texts")
    return Log(
        about,
        column("period", np.int64),
        {name: column(name, np.float64) for name in NUMBERS},
        {name: column(name, np.bool_) for name in FLAGS},
        vectors,
        events,
    )

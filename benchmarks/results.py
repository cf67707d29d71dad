"""One row per episode: the only reader and writer of result files.

Parquet files are byte-reproducible (the same rows give the same bytes), carry a checksum per page, and appear
whole or not at all.
"""

from __future__ import annotations

import io
import json
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
from numpy.typing import NDArray

from rise_agents.files import replace_file

StrPath = str | os.PathLike[str]

SCHEMA = pa.schema(
    [
        pa.field(name, kind, nullable=False)
        for name, kind in {
            "env": pa.string(),
            "agent": pa.string(),
            "train_seed": pa.int64(),
            "noise_model": pa.string(),
            "noise_level": pa.float64(),
            "scenario": pa.int64(),  # number of the scenario within the protocol
            "env_seed": pa.int64(),
            "noise_seed": pa.int64(),
            "safe": pa.bool_(),  # no step had a collision
            "arrived": pa.bool_(),  # the goal was reached, collisions ignored
            "reached": pa.bool_(),  # arrived and safe
            "steps": pa.int64(),
            "episode_cost": pa.float64(),
            "min_clearance": pa.float64(),  # m, negative in collision
            "episode_return": pa.float64(),
        }.items()
    ]
)
KEY = ("env", "agent", "train_seed", "noise_model", "noise_level", "scenario")
_GRID = (
    2.0**-13
)  # about 1e-4; of powers of two, so that the low bytes of all values are zero and cost nothing
_ROUNDED = ("min_clearance", "episode_return")
_COMPACT: dict[str, Any] = {
    "compression_level": 19,
    "use_dictionary": ["env", "agent", "noise_model", "noise_level", "steps", "episode_cost"],
    "column_encoding": {
        **dict.fromkeys(("train_seed", "scenario", "env_seed", "noise_seed"), "DELTA_BINARY_PACKED"),
        **dict.fromkeys(_ROUNDED, "BYTE_STREAM_SPLIT"),
    },
}


def from_columns(columns: Mapping[str, Any]) -> pa.Table:
    """Rows from arrays, one per column of ``SCHEMA``, each (T,) or one value for all rows.

    Raises:
        ValueError: missing, unknown, uneven or mistyped columns, or contradictory rows.
    """
    n = max((len(value) for value in columns.values() if np.ndim(value)), default=1)
    arrays = {}
    for name, value in columns.items():
        filled = np.full(n, value) if np.ndim(value) == 0 else np.asarray(value)
        try:
            kind = SCHEMA.field(name).type if name in SCHEMA.names else None
            arrays[name] = pa.array(filled, type=kind)
        except (pa.ArrowException, OverflowError) as error:
            raise ValueError(f"new rows: column {name!r}: {error}") from None
    lengths = {name: len(array) for name, array in arrays.items()}
    if len(set(lengths.values())) > 1:
        raise ValueError(f"new rows: columns of different lengths: {lengths}")
    return check(pa.table(arrays), "new rows")


def check(table: pa.Table, where: str) -> pa.Table:
    """``table`` with exactly the columns of ``SCHEMA``, in that order.

    Raises:
        ValueError: names ``where`` and the first offending column.
    """
    for name in SCHEMA.names:
        if table.column_names.count(name) != 1:
            raise ValueError(f"{where}: column {name!r} is missing or doubled")
    for name in table.column_names:
        if name not in SCHEMA.names:
            raise ValueError(f"{where}: unknown column {name!r}; the columns are {', '.join(SCHEMA.names)}")
    for field in SCHEMA:
        column = table[field.name]
        if column.type != field.type:
            raise ValueError(f"{where}: column {field.name!r} is {column.type}, must be {field.type}")
        if column.null_count:
            raise ValueError(f"{where}: column {field.name!r} has {column.null_count} empty entries")
    table = pa.table([table[name] for name in SCHEMA.names], schema=SCHEMA)
    level = table["noise_level"].to_numpy()
    if not np.all(np.isfinite(level) & (level >= 0)):
        raise ValueError(f"{where}: column 'noise_level' must be finite and not negative")
    safe, arrived, reached = (table[name].to_numpy() for name in ("safe", "arrived", "reached"))
    if not np.array_equal(reached, safe & arrived):
        raise ValueError(f"{where}: column 'reached' contradicts 'safe' and 'arrived'")
    return table


def atomic_write_bytes(path: StrPath, content: bytes) -> None:
    """Write a file so that a reader, or the next run after a crash, finds the old content or the new."""
    replace_file(path, content)


def atomic_write_text(path: StrPath, content: str) -> None:
    """As :func:`atomic_write_bytes`, UTF-8, line ends as given."""
    atomic_write_bytes(path, content.encode())


def write_rows(path: StrPath, table: pa.Table) -> None:
    """Write rows, in the order given, as Parquet; the same rows give the same bytes.

    Raises:
        ValueError: rows that do not follow ``SCHEMA``.
        OSError: the file cannot be written; an earlier one is intact.
    """
    _write(path, table, {})


def write_compact(path: StrPath, table: pa.Table) -> None:
    """As :func:`write_rows`, in a third of the bytes: about 6 per row instead of 18."""
    _write(path, table, _COMPACT)


def _write(path: StrPath, table: pa.Table, options: Mapping[str, Any]) -> None:
    rows = check(table, str(path)).combine_chunks()
    sink = io.BytesIO()
    # No Arrow schema inside: the Parquet types say it all, and its encoding may change with the version.
    pq.write_table(rows, sink, compression="zstd", store_schema=False, write_page_checksum=True, **options)
    atomic_write_bytes(path, sink.getvalue())


def rounded(table: pa.Table) -> pa.Table:
    """Rows whose clearance and return are multiples of 2⁻¹³, about 10⁻⁴; a negative clearance stays negative."""
    for name in _ROUNDED:
        nearest = rounded_values(name, table[name].to_numpy())
        table = table.set_column(table.column_names.index(name), SCHEMA.field(name), pa.array(nearest))
    return table


def rounded_values(name: str, values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Values (T,) of the column ``name`` as :func:`rounded` has them."""
    if name not in _ROUNDED:
        return values
    nearest = np.round(values / _GRID) * _GRID + 0.0  # + 0: never "-0"
    return np.where(values < 0, np.minimum(nearest, -_GRID), nearest) if name == "min_clearance" else nearest


def read_rows(path: StrPath) -> pa.Table:
    """Read what :func:`write_rows` wrote.

    Raises:
        ValueError: no such file, not Parquet, damaged, or not of ``SCHEMA``; names file and column.
    """
    try:
        content = pa.BufferReader(Path(path).read_bytes())
    except (OSError, ValueError) as error:  # also of a name that no file can have
        raise ValueError(f"{path} cannot be read: {getattr(error, 'strerror', None) or error}") from None
    try:
        table = pq.ParquetFile(content, page_checksum_verification=True).read(use_threads=False)
        table.validate(full=True)
        _ = table.column_names  # decodes them, which fails where they are damaged
    except (OSError, ValueError, pa.ArrowException) as error:  # Arrow's own are of these kinds, too
        raise ValueError(
            f"{path}: cannot be read as results ({error}); remove it to compute it again"
        ) from None
    return check(table, str(path))


def curve(path: Path) -> list[dict[str, float]]:
    """The figures of progress of one training; raises ``ValueError`` if it is no such record."""
    try:
        return [
            {str(k): float(v) for k, v in point.items()} for point in json.loads(path.read_bytes())["curve"]
        ]
    except (OSError, ValueError, LookupError, TypeError, AttributeError, RecursionError) as error:
        raise ValueError(f"{path} is not the record of a training ({error})") from None


def sort_rows(rows: pa.Table, keys: Sequence[str]) -> pa.Table:
    """Rows in ascending order of the columns ``keys``."""
    return rows.take(_order(rows, keys))


def _order(rows: pa.Table, keys: Sequence[str]) -> pa.Array:
    return pc.sort_indices(rows, sort_keys=[(key, "ascending") for key in keys])


def _same_as_before(rows: pa.Table, keys: Sequence[str]) -> NDArray[np.bool_]:
    """For each row but the first (T - 1,): whether it has the keys of the row before."""
    same = np.ones(max(rows.num_rows - 1, 0), dtype=bool)
    for key in keys:
        column = rows[key].combine_chunks()
        same &= pc.equal(column[1:], column[:-1]).to_numpy(zero_copy_only=False)
    return same


def group_edges(rows: pa.Table, keys: Sequence[str]) -> NDArray[np.int64]:
    """Where runs of rows with the same keys begin, and the number of rows: [0, …, T]."""
    return np.unique([0, *(np.flatnonzero(~_same_as_before(rows, keys)) + 1), rows.num_rows])


def merge(paths: Sequence[StrPath], path: StrPath) -> pa.Table:
    """Join result files into one, sorted by ``KEY``: the same bytes in whatever order the parts come.

    Returns:
        The rows written to ``path``.

    Raises:
        ValueError: no parts, an unreadable part, or an episode that occurs twice.
    """
    if not paths:
        raise ValueError(f"{path}: no result files to merge")
    parts = [read_rows(part) for part in paths]
    source = np.repeat(np.arange(len(parts)), [part.num_rows for part in parts])
    rows = pa.concat_tables(parts)
    order = _order(rows, KEY)
    rows = rows.take(order)
    doubled = np.flatnonzero(_same_as_before(rows, KEY))
    if doubled.size:
        first = int(doubled[0])
        episode = ", ".join(f"{key} {rows[key][first].as_py()}" for key in KEY)
        files = sorted({str(paths[i]) for i in source[order.to_numpy()[first : first + 2]]})
        raise ValueError(f"{path}: the episode of {episode} occurs twice, in {' and '.join(files)}")
    write_rows(path, rows)
    return rows

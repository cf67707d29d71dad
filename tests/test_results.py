import errno
import os
import subprocess
import sys

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hand_made import make_rows

from benchmarks import results


def edited(table, name, array):
    return table.set_column(table.column_names.index(name), name, array)


def test_rows_survive_a_round_trip(tmp_path):
    rows = make_rows()
    results.write_rows(tmp_path / "a.parquet", rows)
    back = results.read_rows(tmp_path / "a.parquet")
    assert back.equals(rows) and back.schema.equals(results.SCHEMA)


def test_the_schema_is_the_documented_one():
    expected = (
        "env agent train_seed noise_model noise_level scenario env_seed noise_seed safe arrived reached "
        "steps episode_cost min_clearance episode_return"
    )
    assert results.SCHEMA.names == expected.split()


def test_equal_rows_give_equal_bytes_however_they_lie_in_memory(tmp_path):
    rows = make_rows(100)
    chunked = pa.concat_tables([rows[:30], rows[30:31], rows[31:]])
    labelled = rows.replace_schema_metadata({"made": "by hand"})
    contents = []
    for index, table in enumerate([rows, chunked, labelled, rows]):
        results.write_rows(tmp_path / f"{index}.parquet", table)
        contents.append((tmp_path / f"{index}.parquet").read_bytes())
    assert len(set(contents)) == 1


def test_merging_does_not_depend_on_order_process_or_split(tmp_path):
    parts = [make_rows(agent=agent, noise_level=level) for agent in ("rise", "pcbc") for level in (2.0, 0.5)]
    whole = pa.concat_tables(parts)
    paths = []
    for index, part in enumerate([*parts, whole[:9], whole[9:]]):
        paths.append(str(tmp_path / f"{index}.parquet"))
        results.write_rows(paths[-1], part)
    merged = results.merge(paths[:4], tmp_path / "a.parquet")
    results.merge(paths[3::-1], tmp_path / "b.parquet")
    results.merge(paths[:3:-1], tmp_path / "c.parquet")
    code = "import sys; from benchmarks import results; results.merge(sys.argv[2:], sys.argv[1])"
    subprocess.run([sys.executable, "-c", code, tmp_path / "d.parquet", *paths[:4]], check=True)
    assert len({(tmp_path / f"{name}.parquet").read_bytes() for name in "abcd"}) == 1
    assert results.read_rows(tmp_path / "a.parquet").equals(merged)
    keys = list(zip(*(merged[key].to_pylist() for key in results.KEY), strict=True))
    assert keys == sorted(keys) and len(keys) == 24


def test_merging_refuses_an_episode_that_occurs_twice_and_names_it(tmp_path):
    for name, start in (("a", 0), ("b", 6), ("c", 11)):
        results.write_rows(tmp_path / name, make_rows(start=start))
    with pytest.raises(ValueError, match=r"scenario 11 occurs twice, in .*b and .*c$"):
        results.merge([tmp_path / name for name in "cab"], tmp_path / "out")
    with pytest.raises(ValueError, match=r"occurs twice, in [^ ]*a$"):
        results.merge([tmp_path / "a", tmp_path / "a"], tmp_path / "out")
    with pytest.raises(ValueError, match="no result files"):
        results.merge([], tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_a_failed_write_leaves_the_old_file_and_no_stray(tmp_path, monkeypatch):
    path = tmp_path / "a.parquet"
    results.write_rows(path, make_rows())
    before = path.read_bytes()

    def full(_):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match="No space"):
        results.write_rows(path, make_rows(5))
    assert path.read_bytes() == before and list(tmp_path.iterdir()) == [path]


def test_files_are_as_readable_for_others_as_any_file_of_the_user(tmp_path):
    results.atomic_write_text(tmp_path / "a.txt", "σ\n")
    (tmp_path / "b.txt").write_text("σ\n", encoding="utf-8")
    assert (tmp_path / "a.txt").read_bytes() == (tmp_path / "b.txt").read_bytes()
    assert (tmp_path / "a.txt").stat().st_mode == (tmp_path / "b.txt").stat().st_mode


@pytest.mark.parametrize(
    "change, message",
    [
        (lambda t: t.drop_columns("steps"), "column 'steps' is missing"),
        (lambda t: t.append_column("colour", t["env"]), "unknown column 'colour'"),
        (lambda t: t.append_column("steps", t["steps"]), "column 'steps' is missing or doubled"),
        (
            lambda t: edited(t, "steps", t["steps"].cast(pa.float64())),
            "column 'steps' is double, must be int64",
        ),
        (lambda t: edited(t, "safe", pa.array([None] * 6, pa.bool_())), "column 'safe' has 6 empty entries"),
        (lambda t: edited(t, "reached", t["safe"]), "'reached' contradicts"),
        (lambda t: edited(t, "noise_level", pa.array([np.nan] * 6)), "column 'noise_level' must be finite"),
        (lambda t: edited(t, "noise_level", pa.array([-1.0] * 6)), "column 'noise_level' must be finite"),
    ],
)
def test_reading_and_writing_name_file_and_column_of_what_is_wrong(tmp_path, change, message):
    table = change(pa.table(make_rows().to_pydict()))
    path = tmp_path / "foreign.parquet"
    with pytest.raises(ValueError, match=rf"foreign\.parquet: .*{message}"):
        results.write_rows(path, table)
    if len(set(table.column_names)) == table.num_columns:
        pq.write_table(table, path)
        with pytest.raises(ValueError, match=rf"foreign\.parquet: .*{message}"):
            results.read_rows(path)


def test_columns_in_another_order_are_the_same_rows():
    rows = make_rows()
    assert results.check(rows.select(rows.column_names[::-1]), "rows").equals(rows)


@pytest.mark.parametrize(
    "changes, message",
    [
        ({"steps": np.arange(5)}, "columns of different lengths"),
        ({"steps": 1.5}, "column 'steps'"),
        ({"env_seed": np.uint64(2**63)}, "column 'env_seed'"),
        ({"colour": "red"}, "unknown column 'colour'"),
    ],
)
def test_new_rows_are_checked(changes, message):
    with pytest.raises(ValueError, match=f"new rows: .*{message}"):
        make_rows(**changes)


def test_no_damaged_file_is_read_as_something_else(tmp_path):
    rows = make_rows(200)
    path = tmp_path / "a.parquet"
    results.write_rows(path, rows)
    good = path.read_bytes()
    rng = np.random.default_rng(0)
    damaged = [b"", b"PAR1", good[:-1], good[: len(good) // 2], b"hello" * 100]
    for _ in range(300):
        flipped = bytearray(good)
        flipped[rng.integers(len(good))] ^= 1 << rng.integers(8)
        damaged.append(bytes(flipped))
    for content in damaged:
        path.write_bytes(content)
        try:
            assert results.read_rows(path).equals(rows)
        except ValueError as error:
            assert str(path) in str(error)
    with pytest.raises(ValueError, match=r"absent\.parquet cannot be read: No such file"):
        results.read_rows(tmp_path / "absent.parquet")

"""Files appear whole or not at all; what the killed leave is swept, what others write is not."""

from __future__ import annotations

import multiprocessing
import os
import signal
import time

import pytest

from rise_agents.files import replace_file, replacing, sole_user, sweep


def test_a_block_that_fails_changes_nothing(tmp_path):
    path = tmp_path / "file"
    replace_file(path, b"old")
    with pytest.raises(RuntimeError), replacing(path) as temporary:
        temporary.write_bytes(b"ne")
        raise RuntimeError
    assert path.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [path]


def test_the_temporary_name_keeps_the_ending(tmp_path):
    with replacing(tmp_path / "clip.mp4") as temporary:
        assert temporary.suffix == ".mp4"
    assert [path.name for path in tmp_path.iterdir()] == ["clip.mp4"]


def test_files_are_shared_as_the_umask_says(tmp_path):
    before = os.umask(0o022)
    try:
        replace_file(tmp_path / "file", b"")
    finally:
        os.umask(before)
    assert (tmp_path / "file").stat().st_mode & 0o777 == 0o644


def _write_for_ever(path, started):
    with replacing(path) as temporary:
        temporary.write_bytes(b"half")
        started.set()
        time.sleep(60)


@pytest.fixture
def writer(tmp_path):
    """A process that is writing a file, and never ends by itself."""
    context = multiprocessing.get_context("spawn")
    started = context.Event()
    process = context.Process(target=_write_for_ever, args=(tmp_path / "file", started))
    process.start()
    assert started.wait(30)
    yield process
    process.kill()
    process.join()


def test_what_is_being_written_is_no_stray_until_its_writer_is_killed(tmp_path, writer):
    (before,) = tmp_path.iterdir()
    sweep(tmp_path)
    assert list(tmp_path.iterdir()) == [before]
    os.kill(writer.pid, signal.SIGKILL)
    writer.join()
    assert list(tmp_path.iterdir()) == [before]
    sweep(tmp_path)
    assert not list(tmp_path.iterdir())


def test_a_sweep_takes_nothing_else(tmp_path):
    for name in ("results.csv", ".hidden", "partial-1-x", ".partial-download-of-another-program"):
        (tmp_path / name).touch()
    sweep(tmp_path)
    assert len(list(tmp_path.iterdir())) == 4


def test_a_sweep_of_one_file_leaves_the_strays_of_others(tmp_path):
    for name in ("a.txt", "b.txt"):
        with pytest.raises(KeyboardInterrupt), replacing(tmp_path / name) as temporary:
            kept = temporary.name
            raise KeyboardInterrupt
        (tmp_path / kept).touch()  # as if it had been killed
    sweep(tmp_path, "a.txt")
    assert [path.name for path in tmp_path.iterdir()] == [kept]


def test_a_link_is_written_through(tmp_path):
    (tmp_path / "real").write_bytes(b"old")
    (tmp_path / "link").symlink_to(tmp_path / "real")
    replace_file(tmp_path / "link", b"new")
    assert (tmp_path / "link").is_symlink() and (tmp_path / "real").read_bytes() == b"new"


def test_long_names_and_errors_name_the_file_itself(tmp_path):
    replace_file(tmp_path / ("x" * 251 + ".csv"), b"")
    with pytest.raises(OSError, match="file/below"):
        (tmp_path / "file").touch()
        replace_file(tmp_path / "file" / "below", b"")


def _hold(folder, held):
    with sole_user(folder):
        held.set()
        time.sleep(60)


def test_a_folder_has_one_user_and_is_free_when_that_is_killed(tmp_path):
    context = multiprocessing.get_context("spawn")
    held = context.Event()
    process = context.Process(target=_hold, args=(tmp_path, held))
    process.start()
    assert held.wait(30)
    with pytest.raises(ValueError, match=f"{tmp_path} is in use by another process"), sole_user(tmp_path):
        pass
    process.kill()
    process.join()
    with sole_user(tmp_path):
        pass

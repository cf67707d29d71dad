"""Checkpoints: nothing is lost, nothing damaged or foreign is accepted, nothing is executed."""

from __future__ import annotations

import hashlib
import os
import pickle
from pathlib import Path

import numpy as np
import pytest

from rise_agents import archive, checkpoint, load_agent
from rise_agents.checkpoint import CheckpointError

DESCRIPTION = {"agent": "pcbc", "env": "RISE-GroundVehicle-v0", "config": {}, "seed": 0}


@pytest.fixture
def stored(tmp_path):
    path = tmp_path / "agent.rise"
    checkpoint.save(path, {"w": np.arange(6, dtype=np.float32).reshape(2, 3)}, DESCRIPTION)
    return path


def test_round_trip(stored):
    arrays, description = checkpoint.load(stored)
    np.testing.assert_array_equal(arrays["w"], [[0, 1, 2], [3, 4, 5]])
    assert description["env"] == DESCRIPTION["env"]
    assert description["versions"]["numpy"] == np.__version__


def test_every_flipped_bit_is_noticed(stored):
    content = stored.read_bytes()
    rng = np.random.default_rng(0)
    for position in rng.integers(0, len(content), 300):
        damaged = bytearray(content)
        damaged[position] ^= 1 << int(rng.integers(8))
        stored.write_bytes(damaged)
        with pytest.raises(CheckpointError):
            checkpoint.load(stored)


@pytest.mark.parametrize("length", [0, 1, 8, 39, 40, 100])
def test_truncated_files_are_refused(stored, length):
    stored.write_bytes(stored.read_bytes()[:length])
    with pytest.raises(CheckpointError, match=str(stored)):
        checkpoint.load(stored)


class _Bomb:
    def __reduce__(self):
        return Path.touch, (Path("exploded"),)


def test_pickles_are_not_opened(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    bomb = pickle.dumps(_Bomb())
    for content in (bomb, archive.MAGIC + bomb, archive.MAGIC + hashlib.sha256(bomb).digest() + bomb):
        Path("bomb").write_bytes(content)
        with pytest.raises(CheckpointError, match=r"no file of ours|damaged"):
            load_agent("bomb")
    assert not Path("exploded").exists()
    pickle.loads(bomb)
    assert Path("exploded").exists()  # it would have gone off


def test_a_foreign_archive_with_a_right_digest_is_refused(tmp_path):
    for body in (b"", b"\x08\x00\x00\x00\x00\x00\x00\x00{}      ", b"junk" * 50):
        (tmp_path / "f").write_bytes(archive.MAGIC + hashlib.sha256(body).digest() + body)
        with pytest.raises(CheckpointError, match="no file of ours"):
            checkpoint.load(tmp_path / "f")


def test_missing_file_and_wrong_environment_are_named(stored):
    with pytest.raises(CheckpointError, match=r"nowhere.*does not exist"):
        load_agent("nowhere")
    with pytest.raises(CheckpointError, match=r"RISE-GroundVehicle-v0.*RISE-SafePanda-v0"):
        load_agent(stored, "RISE-SafePanda-v0")


def test_what_is_no_regular_file_is_not_read(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    for path in (tmp_path, tmp_path / "pipe", Path("/dev/zero")):
        with pytest.raises(CheckpointError, match="no regular file"):
            load_agent(path)


def test_an_environment_that_is_not_registered_is_not_imported(tmp_path, monkeypatch):
    """Gymnasium would import the module that an id ``module:name`` names."""
    (tmp_path / "evil_module.py").write_text("open('imported', 'w').close()")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "f"
    archive.write(path, checkpoint.KIND, {}, {**DESCRIPTION, "env": "evil_module:Env-v0"})
    with pytest.raises(CheckpointError, match="not registered"):
        load_agent(path)
    fine = checkpoint.spaces_digest(DESCRIPTION["env"])
    hostile = {**DESCRIPTION, "agent": "cppo", "spaces": fine, "config": {"train_env": "evil_module:Env-v0"}}
    archive.write(path, checkpoint.KIND, {}, hostile)
    with pytest.raises(CheckpointError, match="train_env"):
        load_agent(path)
    assert not Path("imported").exists()


def test_other_spaces_are_refused_with_both_named(tmp_path):
    path, here = tmp_path / "f", checkpoint.spaces_digest(DESCRIPTION["env"])
    archive.write(path, checkpoint.KIND, {}, {**DESCRIPTION, "spaces": "0123"})
    with pytest.raises(CheckpointError, match=f"0123.*{here}"):
        checkpoint.load(path)


def test_another_schema_and_kind_are_named(stored, monkeypatch):
    with pytest.raises(CheckpointError, match="'agent', not 'training'"):
        checkpoint.load(stored, "training")
    monkeypatch.setattr(archive, "SCHEMA", 77)
    with pytest.raises(CheckpointError, match=r"schema 1.*reads 77"):
        checkpoint.load(stored)


def test_numbers_that_are_not_finite_are_neither_stored_nor_loaded(stored):
    with pytest.raises(ValueError, match=r"w holds.*diverged"):
        checkpoint.save(stored, {"w": np.array([1.0, np.nan])}, DESCRIPTION)
    spaces = {"spaces": checkpoint.spaces_digest(DESCRIPTION["env"])}
    archive.write(stored, checkpoint.KIND, {"w": np.array([np.inf])}, {**DESCRIPTION, **spaces})
    with pytest.raises(CheckpointError, match="w holds a number that is not finite"):
        checkpoint.load(stored)


def test_a_write_that_fails_leaves_the_old_file(stored, monkeypatch):
    before = stored.read_bytes()

    def fail(fd):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", fail)
    with pytest.raises(OSError, match="No space"):
        checkpoint.save(stored, {"w": np.zeros(3, np.float32)}, DESCRIPTION)
    assert stored.read_bytes() == before
    assert list(stored.parent.iterdir()) == [stored]

"""Checkpoints: nothing is lost, nothing damaged or foreign is accepted, nothing is executed."""

from __future__ import annotations

import os
import pickle
from pathlib import Path

import numpy as np
import pytest

from rise_agents import checkpoint, load_agent
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
    (tmp_path / "bomb").write_bytes(pickle.dumps(_Bomb()))
    with pytest.raises(CheckpointError, match="no RISE checkpoint"):
        load_agent("bomb")
    assert not Path("exploded").exists()


def test_a_foreign_archive_with_a_right_digest_is_refused(tmp_path):
    import hashlib

    for body in (b"", b"\x08\x00\x00\x00\x00\x00\x00\x00{}      ", b"junk" * 50):
        (tmp_path / "f").write_bytes(checkpoint.MAGIC + hashlib.sha256(body).digest() + body)
        with pytest.raises(CheckpointError, match="no RISE agent"):
            checkpoint.load(tmp_path / "f")


def test_missing_file_and_wrong_environment_are_named(stored):
    with pytest.raises(CheckpointError, match=r"nowhere.*cannot be read"):
        load_agent("nowhere")
    with pytest.raises(CheckpointError, match=r"RISE-GroundVehicle-v0.*RISE-SafePanda-v0"):
        load_agent(stored, "RISE-SafePanda-v0")


def test_a_write_that_fails_leaves_the_old_file(stored, monkeypatch):
    before = stored.read_bytes()

    def fail(fd):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", fail)
    with pytest.raises(OSError, match="No space"):
        checkpoint.save(stored, {"w": np.zeros(3, np.float32)}, DESCRIPTION)
    assert stored.read_bytes() == before
    assert list(stored.parent.iterdir()) == [stored]

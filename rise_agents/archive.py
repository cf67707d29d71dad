"""The container of every file of numbers that we write: arrays and a JSON description under one SHA-256.

8 bytes of magic, the SHA-256 of all that follows, then a safetensors archive whose header carries the description.
The digest is verified before anything is parsed, and safetensors holds numbers only: reading a file can neither
execute code nor accept a flipped bit.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import safetensors.numpy as st
from numpy.typing import NDArray

from rise_agents.files import StrPath, replace_file, sweep

MAGIC = b"RISEfile"
SCHEMA = 1
_DIGEST = 32


class ArchiveError(Exception):
    """A file that is not what it should be: ``reason`` says why, in words."""

    def __init__(self, reason: str) -> None:
        super().__init__(reason)
        self.reason = reason


def write(path: StrPath, kind: str, arrays: Mapping[str, NDArray], description: Mapping[str, Any]) -> None:
    """Store named ``arrays`` and a JSON-able ``description``, whole or not at all.

    Args:
        path: the file.
        kind: what it holds, told again to :func:`read`.
        arrays: of numbers or bools.
        description: keys are texts, floats finite.

    Raises:
        OSError: the file cannot be written; an earlier one is intact.
        ValueError: the description is no JSON.
    """
    header = json.dumps(
        {"schema": SCHEMA, "kind": kind, "description": dict(description)}, sort_keys=True, allow_nan=False
    )
    # Not ascontiguousarray, which gives a single number an axis.
    body = st.save({name: np.asarray(a, order="C") for name, a in arrays.items()}, metadata={"rise": header})
    sweep(Path(path).parent, Path(path).name)
    replace_file(path, MAGIC + hashlib.sha256(body).digest() + body)


def read(path: StrPath, kind: str) -> tuple[dict[str, NDArray], dict[str, Any]]:
    """The arrays and the description that :func:`write` stored.

    Raises:
        ArchiveError: missing, damaged, foreign, or of another kind or schema.
    """
    body = _verified(_content(Path(path)))
    try:
        arrays = st.load(body)
        size = int.from_bytes(body[:8], "little")
        header = json.loads(json.loads(body[8 : 8 + size])["__metadata__"]["rise"])
        schema, found, description = (header[key] for key in ("schema", "kind", "description"))
    except Exception as error:  # a digest that fits does not make a foreign archive one of ours
        raise ArchiveError(f"is no file of ours ({type(error).__name__}: {error})") from None
    if schema != SCHEMA:
        raise ArchiveError(f"has schema {schema!r}, this version reads {SCHEMA}")
    if found != kind:
        raise ArchiveError(f"holds {found!r}, not {kind!r}")
    if not isinstance(description, dict):
        raise ArchiveError("describes itself with something else than names and values")
    return arrays, description


def _content(path: Path) -> bytes:
    try:
        if not path.is_file():  # a device or a pipe might never end
            raise ArchiveError("is no regular file" if path.exists() else "does not exist")
        return path.read_bytes()
    except (OSError, ValueError) as error:  # ValueError: a name with a null character
        raise ArchiveError(f"cannot be read ({getattr(error, 'strerror', None) or error})") from None


def _verified(content: bytes) -> bytes:
    if content[: len(MAGIC)] != MAGIC:
        raise ArchiveError("is no file of ours")
    body = content[len(MAGIC) + _DIGEST :]
    if hashlib.sha256(body).digest() != content[len(MAGIC) : len(MAGIC) + _DIGEST]:
        raise ArchiveError("is damaged (its SHA-256 does not match)")
    return body

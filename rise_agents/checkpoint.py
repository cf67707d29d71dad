"""The only place that writes or reads a trained agent.

One file: 8 bytes of magic, the SHA-256 of all that follows, then a safetensors archive whose header carries
the JSON description (schema, agent, environment, config, versions). The digest is verified before anything is
parsed, and safetensors holds numbers only: reading a file can neither execute code nor accept a flipped bit.
"""

from __future__ import annotations

import hashlib
import json
import os
import secrets
from collections.abc import Mapping
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np
import safetensors.numpy as st
from numpy.typing import NDArray

MAGIC = b"RISEckpt"
SCHEMA = 1
_PACKAGES = ("gymnasium", "numpy", "torch", "stable-baselines3", "panda-gym")


class CheckpointError(Exception):
    """A checkpoint that cannot be used: names the path, the reason and the remedy."""

    def __init__(self, path: str | os.PathLike[str], reason: str, remedy: str) -> None:
        super().__init__(f"{path}: {reason}; {remedy}")
        self.path, self.reason, self.remedy = Path(path), reason, remedy


def replace_file(path: str | os.PathLike[str], content: bytes) -> None:
    """Write ``content`` to ``path`` so that a reader finds the old file or the new one, never a part."""
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    # Not tempfile: its files are private to the user, and results are there to be shared.
    temporary = path.with_name(f".{path.name}.{secrets.token_hex(8)}.tmp")
    try:
        with temporary.open("xb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        temporary.replace(path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise


def versions() -> dict[str, str]:
    """Versions of the libraries that results depend on."""
    return {name: metadata.version(name) for name in _PACKAGES}


def save(path: str | os.PathLike[str], arrays: Mapping[str, NDArray], description: Mapping[str, Any]) -> None:
    """Store named ``arrays`` and a JSON-able ``description`` (at least ``agent``, ``env``, ``config``)."""
    header = {"schema": SCHEMA, "versions": versions(), **description}
    contiguous = {name: np.ascontiguousarray(array) for name, array in arrays.items()}
    body = st.save(contiguous, metadata={"rise": json.dumps(header, sort_keys=True)})
    replace_file(path, MAGIC + hashlib.sha256(body).digest() + body)


def load(path: str | os.PathLike[str]) -> tuple[dict[str, NDArray], dict[str, Any]]:
    """The arrays and the description that :func:`save` stored.

    Raises:
        CheckpointError: missing, damaged, foreign, or of another schema.
    """
    again = "train the agent again or copy the file once more"
    try:
        content = Path(path).read_bytes()
    except OSError as error:
        raise CheckpointError(path, f"cannot be read ({error.strerror})", "check the path") from None
    body = content[len(MAGIC) + 32 :]
    if not content.startswith(MAGIC):
        raise CheckpointError(path, "is no RISE checkpoint", "give a file written by agent.save()")
    if hashlib.sha256(body).digest() != content[len(MAGIC) : len(MAGIC) + 32]:
        raise CheckpointError(path, "is damaged (its SHA-256 does not match)", again)
    try:
        arrays = st.load(body)
        size = int.from_bytes(body[:8], "little")
        description = json.loads(json.loads(body[8 : 8 + size])["__metadata__"]["rise"])
        schema = description["schema"]
    except Exception as error:  # a digest that fits does not make a foreign archive one of ours
        raise CheckpointError(path, f"holds no RISE agent ({error})", again) from None
    if schema != SCHEMA:
        raise CheckpointError(path, f"has schema {schema}, this version reads {SCHEMA}", again)
    return arrays, description

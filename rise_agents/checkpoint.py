"""The only place that writes or reads a trained agent, or one that is still being trained.

The file is an archive of :mod:`rise_agents.archive` whose description names the agent, the environment with a
digest of its spaces, the config, the seed and the library versions. Whatever is wrong with it ends in a
:class:`CheckpointError`.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Mapping
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from rise_agents import archive
from rise_agents.files import StrPath

KIND = "agent"
_PACKAGES = ("rise-suite", "gymnasium", "numpy", "torch", "stable-baselines3", "panda-gym")
TRAINING = "training"
_REMEDIES = {
    KIND: "give a whole file that agent.save() wrote, or train the agent again",
    TRAINING: "remove it to begin anew",
}


class CheckpointError(Exception):
    """A checkpoint that cannot be used: names the path, the reason and the remedy."""

    def __init__(self, path: str | os.PathLike[str], reason: str, remedy: str) -> None:
        super().__init__(f"{path}: {reason}; {remedy}")
        self.path, self.reason, self.remedy = Path(path), reason, remedy


def versions() -> dict[str, str]:
    """Versions of the libraries that results depend on."""
    return {name: metadata.version(name) for name in _PACKAGES}


@cache
def spaces_digest(env_id: str) -> str:
    """A digest of the observation and action space of a registered environment: names, shapes, bounds, types."""
    env = gym.make(env_id)
    described = repr([_described(env.observation_space), _described(env.action_space)])
    env.close()
    return hashlib.sha256(described.encode()).hexdigest()[:16]


def _described(space: spaces.Space) -> Any:
    if isinstance(space, spaces.Dict):
        return [(key, _described(part)) for key, part in sorted(space.spaces.items())]
    if isinstance(space, spaces.Box):
        return "Box", space.shape, str(space.dtype), space.low.tobytes().hex(), space.high.tobytes().hex()
    return repr(space)


def save(
    path: StrPath, arrays: Mapping[str, NDArray], description: Mapping[str, Any], kind: str = KIND
) -> None:
    """Store named ``arrays`` and a JSON-able ``description`` (at least ``agent``, ``env``, ``config``).

    Raises:
        ValueError: a number that is not finite.
        OSError: the file cannot be written; an earlier one is intact.
    """
    for name, array in arrays.items():
        if not np.isfinite(array).all():
            raise ValueError(f"{name} holds a number that is not finite: the training has diverged")
    digest = spaces_digest(description["env"])
    archive.write(path, kind, arrays, {"versions": versions(), "spaces": digest, **description})


def load(path: StrPath, kind: str = KIND) -> tuple[dict[str, NDArray], dict[str, Any]]:
    """The arrays and the description that :func:`save` stored.

    Raises:
        CheckpointError: missing, damaged, foreign, of another schema, or of an environment that is not
            registered here or has other spaces here.
    """
    try:
        arrays, description = archive.read(path, kind)
    except archive.ArchiveError as error:
        raise CheckpointError(path, error.reason, _REMEDIES[kind]) from None
    _check_env(path, description)
    for name, array in arrays.items():
        if not np.isfinite(array).all():
            raise CheckpointError(path, f"{name} holds a number that is not finite", _REMEDIES[kind])
    return arrays, description


def _check_env(path: StrPath, description: dict[str, Any]) -> None:
    import rise_envs  # noqa: F401  registers the environments

    env = description.get("env")
    # Looked up, not handed to Gymnasium, which would import the module that an id "module:name" names.
    if not isinstance(env, str) or env not in gym.registry:
        remedy = "import the module that registers it first (--import)"
        raise CheckpointError(path, f"was trained on {env!r}, which is not registered", remedy)
    stored, here = description.get("spaces"), spaces_digest(env)
    if stored != here:
        reason = f"was trained on {env} with spaces {stored}, here they are {here}"
        raise CheckpointError(path, reason, "train it again")


def expect(arrays: Mapping[str, NDArray], shapes: Mapping[str, tuple[int, ...]]) -> None:
    """Raise ``ValueError`` unless ``arrays`` are floats of exactly the names and shapes of ``shapes``."""
    for name, shape in shapes.items():
        if name not in arrays:
            raise ValueError(f"array {name!r} is missing")
        if arrays[name].shape != tuple(shape) or arrays[name].dtype.kind != "f":
            found = f"{arrays[name].dtype}{arrays[name].shape}"
            raise ValueError(f"array {name!r} is {found}, not float{tuple(shape)}")
    for name in arrays:
        if name not in shapes:
            raise ValueError(f"array {name!r} belongs to no part of the agent")

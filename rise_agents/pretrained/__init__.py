"""Trained agents that come with the package: ``load_agent("rise", env="RISE-SafePanda-v0")``.

They lie beside this file as ``AGENT-ENVIRONMENT.rise``, ordinary checkpoints, with a ``card.json`` that says of each
where it comes from. ``python -m rise_agents.pretrained RUN_DIR`` puts those of a benchmark run there.
"""

from __future__ import annotations

import hashlib
import re
from pathlib import Path

from rise_envs import ENVS

FOLDER = Path(__file__).parent
CARD = "card.json"
_NAME = re.compile(r"[A-Za-z0-9][\w.-]*")


def available() -> list[tuple[str, str]]:
    """(agent, environment) of all weights that are there, in alphabetical order."""
    found = []
    for path in sorted(FOLDER.glob("*.rise")):
        for env in ENVS:
            agent = path.stem.removesuffix(f"-{env}")
            if agent != path.stem:
                found.append((agent, env))
    return found


def file_of(agent: str, env: str, folder: Path | None = None) -> Path:
    """Where the weights of an agent in an environment lie, or would lie, in ``folder`` (by default the package's)."""
    return (FOLDER if folder is None else folder) / f"{agent}-{env}.rise"


def find(agent: str, env: str | None) -> Path:
    """The file with the weights of an agent in an environment.

    Raises:
        ValueError: there is none (those that there are, are named), or ``env`` is missing.
    """
    there = ", ".join(f"{name} for {task}" for name, task in available()) or "none in this package"
    if env is None:
        raise ValueError(
            f"weights of {agent!r} are for an environment: name that, too (env=, --env); there are: {there}"
        )
    if (agent, env) not in available():
        raise ValueError(f"no weights of {agent!r} for {env!r} come with this package; there are: {there}")
    return file_of(agent, env)


def is_name(text: str) -> bool:
    """Whether a text can be the name of an agent or of a variant of one; a path in a folder cannot."""
    return _NAME.fullmatch(text) is not None


def sha256(path: Path) -> str:
    """Digest of a file's content."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()

"""Training that goes on where it was interrupted, to the same weights bit for bit."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

from numpy.typing import NDArray

from rise_agents import checkpoint
from rise_agents.agent import Progress, config_to_dict
from rise_agents.checkpoint import CheckpointError
from rise_agents.files import StrPath

KIND = checkpoint.TRAINING
T = TypeVar("T")


class Resume:
    """The file in which a training keeps its state, and from which it goes on if the file is there.

    Args:
        path: of the file; None keeps nothing.
        every: seconds between two writes. What is learned does not depend on it.

    Attributes:
        curve: the figures of progress, those from before an interruption included.
        seconds: that the training has taken, before an interruption included.
    """

    def __init__(self, path: StrPath | None = None, every: float = 15.0) -> None:
        self.path = None if path is None else Path(path)
        if not (isinstance(every, int | float) and not isinstance(every, bool) and every >= 0):
            raise ValueError(f"every must be a number of seconds, not negative, got {every!r}")
        self.every = every
        self.curve: list[dict[str, float]] = []
        self.seconds = 0.0
        self._facts: dict[str, Any] = {}
        self._before = 0.0  # seconds of earlier processes
        self._started = self._written = time.monotonic()

    @classmethod
    def of(cls, resume: Resume | StrPath | None) -> Resume:
        """What ``learn`` was given, as a ``Resume``."""
        return resume if isinstance(resume, Resume) else cls(resume)

    def open(self, agent: Any, source: str) -> tuple[dict[str, NDArray], dict[str, Any]]:
        """The state of the training of ``agent`` that the file holds; empty at the start of a training.

        Args:
            agent: who learns.
            source: names what it learns from.

        Raises:
            CheckpointError: the file is damaged, or of another training or version.
        """
        self._started = self._written = time.monotonic()
        self.curve, self._before = [], 0.0
        if self.path is None:
            return {}, {}
        self._facts = {
            "agent": agent.name,
            "env": agent.env_id,
            "seed": agent.seed,
            "config": config_to_dict(agent.config),
            "device": str(agent.device),
            "source": source,
        }
        if not self.path.exists():
            return {}, {}
        arrays, description = checkpoint.load(self.path, KIND)
        for name, value in {**self._facts, "versions": checkpoint.versions()}.items():
            if description.get(name) != value:
                theirs, ours = _differing(description.get(name), value)
                reason = f"holds a training with {name} {theirs}, this one has {ours}"
                raise CheckpointError(self.path, reason, "remove it to begin anew, or name another file")
        curve, seconds, notes = (description.get(name) for name in ("curve", "seconds", "notes"))
        if not (_is_curve(curve) and type(seconds) is float and seconds >= 0 and isinstance(notes, dict)):
            raise CheckpointError(self.path, "lacks a part of the training", "remove it to begin anew")
        self.curve, self._before = list(curve or ()), seconds
        self._clock()
        return arrays, notes

    def read(self, how: Callable[[], T]) -> T:
        """``how()``, which makes use of what the file holds; whatever is wrong with that is a ``CheckpointError``."""
        if self.path is None:
            return how()
        try:
            return how()
        except (LookupError, TypeError, ValueError, ArithmeticError, RuntimeError, AttributeError) as error:
            first = (str(error).strip() or type(error).__name__).splitlines()[0]
            reason = f"lacks a part of the training ({first})"
            raise CheckpointError(self.path, reason, "remove it to begin anew") from None

    def noting(self, progress: Progress) -> Progress:
        """``progress`` whose figures also go to ``curve``."""

        def tell(share: float, figures: dict[str, float]) -> None:
            self.curve.append({"share": share, **figures})
            progress(share, figures)

        return tell

    def due(self) -> bool:
        """Whether it is time to write."""
        return self.path is not None and time.monotonic() - self._written >= self.every

    def save(self, arrays: dict[str, NDArray], notes: dict[str, Any]) -> None:
        """Write the state of the training."""
        self._clock()
        if self.path is None:
            return
        described = {**self._facts, "notes": notes, "curve": self.curve, "seconds": self.seconds}
        checkpoint.save(self.path, arrays, described, KIND)
        self._written = time.monotonic()

    def _clock(self) -> None:
        self.seconds = self._before + time.monotonic() - self._started


def _differing(theirs: Any, ours: Any) -> tuple[Any, Any]:
    """Of two dicts the entries that differ; anything else as it is."""
    if not (isinstance(theirs, dict) and isinstance(ours, dict)):
        return theirs, ours
    keys = [key for key in {**theirs, **ours} if theirs.get(key) != ours.get(key)]
    return {key: theirs.get(key) for key in keys}, {key: ours.get(key) for key in keys}


def _is_curve(curve: Any) -> bool:
    """Whether these are figures of progress, by name."""
    return isinstance(curve, list) and all(
        isinstance(point, dict) and all(isinstance(value, int | float) for value in point.values())
        for point in curve
    )

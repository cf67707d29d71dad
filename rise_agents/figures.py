"""Training figures as event files, which TensorBoard draws: all that an agent tells its ``progress``.

They are written through the logger of stable-baselines3. A training that goes on after an interruption writes its
folder anew, from the figures that it has stored: what was lost with the interruption, and is learned again, is there
once.
"""

from __future__ import annotations

import importlib.util
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from rise_agents.agent import Progress
from rise_agents.resume import Resume

if TYPE_CHECKING:
    from stable_baselines3.common.logger import Logger

_SHARES = 1_000  # what stands for the steps of a training that counts none


def check_installed() -> None:
    """Raise ``ValueError`` if what writes event files is not there."""
    if importlib.util.find_spec("tensorboard") is None:
        raise ValueError("event files need one more package: pip install 'rise-suite[tensorboard]'")


@contextmanager
def written(folder: str | os.PathLike[str] | None, resume: Resume, progress: Progress) -> Iterator[Progress]:
    """``progress`` for the time of a training, whose figures also go to event files.

    Steps are those that the agent counts (``steps`` among its figures), else thousandths of the training.

    Args:
        folder: of this training alone; what an earlier attempt left there is removed. None: nothing is written.
        resume: of the training, whose curve has the figures from before an interruption.
        progress: told as ever.

    Raises:
        ValueError: a package is missing.
    """
    if folder is None:
        yield progress
        return
    check_installed()
    events = _Events(Path(folder), resume)

    def tell(share: float, figures: dict[str, float]) -> None:
        events.note(share, figures)
        progress(share, figures)

    try:
        yield tell
    finally:
        events.close()


class _Events:
    def __init__(self, folder: Path, resume: Resume) -> None:
        self.folder, self.resume = folder, resume
        self.logger: Logger | None = None
        self.noted = 0  # points of the curve

    def note(self, share: float, figures: dict[str, float]) -> None:
        if self.logger is None:
            self.logger = _logger(self.folder)
        # An agent that keeps no curve has only what it tells now.
        points = self.resume.curve[self.noted :] or [{"share": share, **figures}]
        self.noted = len(self.resume.curve)
        for point in points:
            for name, value in point.items():
                if name not in ("share", "steps"):
                    self.logger.record(f"training/{name}", value)
            self.logger.dump(round(point.get("steps", _SHARES * point["share"])))

    def close(self) -> None:
        if self.logger is not None:
            self.logger.close()


def _logger(folder: Path) -> Logger:
    """A logger into an empty folder."""
    from stable_baselines3.common.logger import Logger, TensorBoardOutputFormat

    for old in folder.glob("events.out.tfevents.*"):
        old.unlink()
    folder.mkdir(parents=True, exist_ok=True)
    return Logger(str(folder), [TensorBoardOutputFormat(str(folder))])

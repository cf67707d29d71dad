"""Where readings come from.

Shapes: C reading channels, D dimensions of a goal.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from numbers import Real
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from numpy.typing import NDArray

from rise_envs.noise import make_noise
from rise_envs.noise_wrappers import NoiseRows
from rise_envs.task import Task

if TYPE_CHECKING:
    from rise_agents.runtime.robots import EnvRobot

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Reading:
    """One measurement of the obstacles.

    Attributes:
        obstacle: c, (C,), SI units.
        stamp: when it was taken (s), on the loop's clock.
        number: grows with every new reading.
        goal: g, (D,), where the stream says it, too.
        begins: whether an episode begins with it: noise starts anew.
    """

    obstacle: Array
    stamp: float
    number: int
    goal: Array | None = None
    begins: bool = False


def require_returned(call: str, value: Any, kind: type, *arrays: str) -> None:
    """Raise a ``TypeError`` that says what a driver returned, if it is no ``kind`` with these arrays of numbers."""
    if not isinstance(value, kind):
        raise TypeError(f"{call} must return {kind.__name__}, got {type(value).__name__}")
    for name in arrays:
        part = getattr(value, name)
        if not (isinstance(part, np.ndarray) and part.dtype.kind in "fiu"):
            got = part.dtype if isinstance(part, np.ndarray) else type(part).__name__
            raise TypeError(
                f"{call} must return {kind.__name__} whose {name} is an array of numbers, got {got}"
            )


def checked(reading: Reading | None) -> Reading | None:
    """What a stream returned; raises a ``TypeError`` if its kind is wrong. Its values are the watchdog's matter."""
    if reading is not None:
        require_returned("latest()", reading, Reading, "obstacle")
        if reading.goal is not None:
            require_returned("latest()", reading, Reading, "goal")
        if not isinstance(reading.stamp, Real):
            raise TypeError(f"latest() must return Reading whose stamp is a number, got {reading.stamp!r}")
    return reading


class ReadingStream(Protocol):
    """The latest reading, without waiting for one."""

    def latest(self) -> Reading | None:
        """The newest one, the same again if there is none newer; None before the first."""


class RobotReadings:
    """What a simulated robot's own environment reads, taken as its step ends."""

    def __init__(self, robot: EnvRobot) -> None:
        self.robot = robot

    def latest(self) -> Reading | None:
        """Of the last ``observe()``."""
        return self.robot.reading


class NoisyStream:
    """Another stream, read with noise: fresh for every new reading.

    Args:
        stream: the true readings.
        task: gives scale and groups of the noise.
        noise: a model's text, see :mod:`rise_envs.noise`.
        level: multiplies it.
        seed: of the draws.
    """

    def __init__(self, stream: ReadingStream, task: Task, noise: str, level: float, seed: int) -> None:
        model = make_noise(noise, level, task.noise_channels)
        self.stream, self._rows = stream, NoiseRows(model, np.array(task.noise_scale), 1, ahead=64)
        self._rows.start(np.zeros((1, len(task.noise_scale))), np.ones(1, bool))  # slow the first time only
        self._rows.seed(np.ones(1, bool), [seed])
        self._last: Reading | None = None  # with noise

    def latest(self) -> Reading | None:
        """The stream's, with noise."""
        true = self.stream.latest()
        if true is None or (self._last is not None and true.number == self._last.number):
            return self._last
        row: Any = true.obstacle[None]
        if self._last is None or true.begins:
            noisy = self._rows.start(row, np.ones(1, bool))
        else:
            noisy = self._rows.advance(row)
        self._last = replace(true, obstacle=noisy[0].copy())
        return self._last

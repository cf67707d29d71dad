"""When to stop, when to go on, and how far an action may go.

Shapes: A actions.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rise_agents.runtime.streams import Reading
from rise_envs.settings import finite, whole

# Reasons that may pass by themselves; what an error of the policy or the robot means, a person must judge.
PASSING = frozenset({"stale", "reading", "overrun"})
WAITING = "waiting"


@dataclass(frozen=True)
class Rules:
    """What makes the loop stop, and go on.

    Attributes:
        stale_after: periods after which a reading is too old to act on. The loop looks between periods too, so the
            robot is told to stop so long after the last reading: by default within two periods.
        overruns: periods in a row that end late before the robot is stopped.
        resume_after: seconds of good readings after which a stop for bad ones, or for overruns, ends by itself; None:
            only :meth:`rise_agents.runtime.ControlLoop.restart` ends it.
    """

    stale_after: float = 1.9
    overruns: int = 3
    resume_after: float | None = None

    def __post_init__(self) -> None:
        finite("stale_after", self.stale_after, 0.0)
        if self.stale_after <= 1:
            raise ValueError(f"stale_after must be above 1 period, got {self.stale_after!r}")
        whole("overruns", self.overruns, 1)
        if self.resume_after is not None:
            finite("resume_after", self.resume_after, 0.0)


@dataclass(frozen=True)
class Stop:
    """Why the robot stands.

    Attributes:
        kind: ``waiting``, ``stale``, ``reading``, ``overrun``, ``state``, ``policy``, ``action`` or ``robot``.
        words: what happened.
    """

    kind: str
    words: str

    def __str__(self) -> str:
        return f"{self.kind}: {self.words}"


_NO_READING = Stop(WAITING, "no reading yet")


class Watchdog:
    """The state of a run: going, or stopped for a reason.

    Args:
        rules: see there.
        period: of the loop (s).
        channels: C, numbers of a reading.
    """

    def __init__(self, rules: Rules, period: float, channels: int) -> None:
        self.rules, self.period, self.channels = rules, period, channels
        self.stopped: Stop | None = _NO_READING
        self._late = 0  # periods in a row
        self._good_since: float | None = None
        self._restart = False

    def stale_at(self, reading: Reading) -> float:
        """When a reading is too old (s)."""
        return reading.stamp + self.rules.stale_after * self.period

    def judge(self, reading: Reading | None, now: float) -> Stop | None:
        """What is wrong with the latest reading."""
        if reading is None:
            return _NO_READING
        if not reading.stamp <= now + self.period:  # NaN is no time either
            return Stop("reading", f"is stamped {reading.stamp}, now it is {now}")
        if now >= self.stale_at(reading):
            return Stop("stale", f"the last reading is {(now - reading.stamp) / self.period:.2f} periods old")
        parts = (reading.obstacle,) if reading.goal is None else (reading.obstacle, reading.goal)
        if reading.obstacle.shape != (self.channels,):
            return Stop("reading", f"has shape {reading.obstacle.shape}, not ({self.channels},)")
        if not all(np.isfinite(part).all() for part in parts):
            return Stop("reading", "is not finite")
        return None

    def ended(self, late: bool) -> Stop | None:
        """Note whether a period's work ended late."""
        self._late = self._late + 1 if late else 0
        if self._late >= self.rules.overruns:
            return Stop("overrun", f"{self._late} periods in a row took too long")
        return None

    def stop(self, why: Stop) -> bool:
        """Stop; whether there is a reason to tell. The first one stays, but for a robot that fails.

        A run waits for its first good reading. The first bad one before it is a reason, but does not end the waiting.
        """
        went = self.stopped is None
        bad = self.stopped == _NO_READING and why.kind in {"reading", "stale"}
        if bad:
            why = Stop(WAITING, f"no good reading yet ({why})")
        if went and why.kind == WAITING:  # there was one
            why = Stop("stale", "no reading any more")
        if went:
            self._restart = False  # who said so before knew nothing of this
        if went or bad or why.kind == "robot":
            self.stopped = why
        self._good_since = None
        return went or bad

    def restart(self) -> None:
        """Go on with the next good reading, whatever the reason was; one that goes is not changed."""
        self._restart = True

    def resumes(self, now: float) -> bool:
        """Whether a stopped run goes on, now that the reading is good."""
        if self.stopped is None:
            return False
        if self._good_since is None:
            self._good_since = now
        rest = self.rules.resume_after
        rested = rest is not None and self.stopped.kind in PASSING and now - self._good_since >= rest
        if not (self._restart or rested or self.stopped.kind == WAITING):
            return False
        self.stopped, self._good_since, self._restart, self._late = None, None, False, 0
        return True


@dataclass(frozen=True)
class Limits:
    """What an action is held to, last of all.

    Attributes:
        low: least actions, (A,).
        high: greatest actions, (A,).
        rate: greatest change of each action in a second, (A,); None: any.
    """

    low: NDArray
    high: NDArray
    rate: NDArray | None = None

    def __post_init__(self) -> None:
        shape = np.shape(self.low)
        if len(shape) != 1 or np.shape(self.high) != shape or not (self.low < self.high).all():
            raise ValueError(
                f"limits must be low < high, one of each per action, got {self.low}, {self.high}"
            )
        if self.rate is not None and (np.shape(self.rate) != shape or not (np.asarray(self.rate) > 0).all()):
            raise ValueError(f"rate must hold {shape[0]} numbers above 0, got {self.rate!r}")

    def check(self, wanted: Any) -> Stop | None:
        """What is wrong with what a policy wants."""
        array = np.asarray(wanted)
        if array.dtype.kind not in "fiu" or array.shape != np.shape(self.low):
            return Stop("action", f"must be {np.shape(self.low)[0]} numbers, got {array.dtype}{array.shape}")
        return None if np.isfinite(array).all() else Stop("action", "is not finite")

    def __call__(self, wanted: NDArray, last: NDArray, dt: float) -> NDArray[np.float32]:
        """The action that is applied: within the bounds, and near the last one; nobody can write to it.

        Args:
            wanted: by the policy, (A,), finite.
            last: applied before, (A,), within the bounds.
            dt: time since then (s).
        """
        low, high = self.low, self.high
        if self.rate is not None:
            low, high = np.maximum(low, last - dt * self.rate), np.minimum(high, last + dt * self.rate)
        held = np.clip(np.asarray(wanted, np.float64), low, high).astype(np.float32)
        # Rounding to float32 may have led out of the bounds.
        action = np.clip(held, self.low.astype(np.float32), self.high.astype(np.float32))
        action.flags.writeable = False
        return action

    def rest(self) -> NDArray[np.float32]:
        """The action nearest to none."""
        return np.clip(np.zeros(len(self.low)), self.low, self.high).astype(np.float32)

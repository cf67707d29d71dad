"""The loop: observe, read, decide, limit, apply, at a fixed rate that does not drift.

Period k begins at start + k · period on a monotonic clock, however long the ones before it took. One that ends
late makes the next begin at once, and leaves out those that have passed by altogether.

Shapes: A actions.
"""

from __future__ import annotations

import gc
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from rise_agents.agent import initial_state
from rise_agents.rollout import policy_keys
from rise_agents.runtime.log import Recorder, Times
from rise_agents.runtime.robots import Observed, Robot
from rise_agents.runtime.streams import Reading, ReadingStream, checked, require_returned
from rise_agents.runtime.watchdog import Limits, Rules, Stop, Watchdog
from rise_envs.task import Task


class Clock(Protocol):
    """A clock that never goes back."""

    def now(self) -> float:
        """Time (s)."""

    def wait(self, until: float) -> None:
        """Return at ``until``, or at once if it has passed."""


class Monotonic:
    """The system's monotonic clock.

    Args:
        spin: how long before the end of a wait (s) it stops sleeping and looks at the clock all the time, since
            the system wakes sleepers late.
    """

    def __init__(self, spin: float = 5e-4) -> None:
        self.spin, self.now = spin, time.monotonic

    def wait(self, until: float) -> None:
        """Sleep, then spin."""
        rest = until - self.now() - self.spin
        if rest > 0:
            time.sleep(rest)
        while self.now() < until:
            pass


class Mind:
    """A policy with what it remembers of the episode.

    What counts is what was acted on: a decision that nobody acts on leaves no trace, so that what comes after it can be
    decided again from a log, which does not hold it. A belief loses no reading by that: whoever discards a decision
    stops, and a policy that goes on after a stop begins anew.

    Args:
        policy: an agent, an expert, an exported agent.
        seed: of what it draws.
        deterministic: handed to ``predict``; None: as the policy is judged.
    """

    def __init__(self, policy: Any, seed: int = 0, deterministic: bool | None = None) -> None:
        self.policy, self.seed = policy, seed
        judged = bool(getattr(policy, "evaluate_deterministic", True))
        self.deterministic = judged if deterministic is None else deterministic
        self._state: Any = initial_state(policy, policy_keys([seed]))
        self._before = self._state

    def decide(self, observation: dict[str, NDArray], begins: bool) -> Any:
        """What the policy wants, (A,)."""
        self._before = self._state
        wanted, self._state = self.policy.predict(
            observation, self._state, np.array([begins]), self.deterministic
        )
        return wanted

    def discard(self) -> None:
        """Be as before the last decision."""
        self._state = self._before


class ControlLoop:
    """A policy in control of a robot.

    Args:
        mind: decides.
        robot: acts.
        stream: reads.
        task: of the environment that the policy was trained in.
        limits: of the actions.
        period: (s).
        rules: of stopping.
        clock: to keep time by.
        recorder: is told everything; None: one whose log can be summed up and, if the policy is an
            agent or an exported one, decided again.
    """

    def __init__(
        self,
        mind: Mind,
        robot: Robot,
        stream: ReadingStream,
        task: Task,
        limits: Limits,
        period: float,
        rules: Rules | None = None,
        clock: Clock | None = None,
        recorder: Recorder | None = None,
    ) -> None:
        self.mind, self.robot, self.stream, self.limits = mind, robot, stream, limits
        self.period, self.clock = period, Monotonic() if clock is None else clock
        self.recorder = (
            Recorder(task, len(limits.low), _about(mind, period)) if recorder is None else recorder
        )
        self.watchdog = Watchdog(Rules() if rules is None else rules, period, task.widths["obstacle"])
        self._last, self._fresh = limits.rest(), True
        self._fatal = False

    def restart(self) -> None:
        """Let a stopped robot go on with the next good reading; another thread may call this."""
        self.watchdog.restart()

    def run(self, seconds: float) -> None:
        """Control for so long, or until the robot fails. However it ends, the robot is told to stop, and the log how.

        Raises:
            KeyboardInterrupt: as it came, after the robot has been stopped.
        """
        periods, how = max(1, round(seconds / self.period)), "interrupted"
        with _steady():
            start, k = self.clock.now(), 0
            try:
                while k < periods and not self._fatal:
                    deadline = start + k * self.period
                    self._rest_until(deadline)
                    self._period(k, start, deadline)
                    passed = int((self.clock.now() - start) / self.period)
                    k = max(k + 1, passed)
                if not self._fatal:
                    self._rest_until(start + periods * self.period)
                how = "end"
            finally:
                self._halt()
                self.recorder.amend(how)

    def _rest_until(self, deadline: float) -> None:
        """Wait for the next period; stop the robot at the moment that its last reading becomes stale."""
        while self.watchdog.stopped is None and not self._fatal:
            reading = self._read()
            why = self.watchdog.judge(reading, self.clock.now())
            if why is not None:
                self._note_stop(why)
            elif reading is not None and self.watchdog.stale_at(reading) < deadline:
                self.clock.wait(self.watchdog.stale_at(reading))
            else:
                break
        self.clock.wait(deadline)

    def _period(self, k: int, start: float, deadline: float) -> None:
        """One period, from observing to commanding."""
        begun, events = self.clock.now(), []
        try:
            observed = self.robot.observe()
            require_returned("observe()", observed, Observed, "state", "goal")
        except Exception as error:  # whatever a driver raises: there is nothing to act on
            self._fatal = True
            self._note_stop(Stop("robot", _line(error)))
            return
        reading, now = self._read(), self.clock.now()
        self._fresh |= bool(observed.begins)
        wanted = None
        why = self.watchdog.judge(reading, now)
        if why is None and self.watchdog.resumes(now):
            events.append("go")
            self._fresh = True  # what it remembered is of another time
        fresh = self._fresh
        if why is None and reading is not None and self.watchdog.stopped is None:
            wanted, why = self._decide(observed, reading)
        if why is not None and self._stop(why):
            events.append(f"stop: {self.watchdog.stopped}")
        action = self._command(wanted, events)
        ended = self.clock.now()
        late = ended > deadline + self.period
        why = self.watchdog.ended(late)
        if late:
            events.append("overrun")
        if why is not None and self._stop(why):
            events.append(f"stop: {self.watchdog.stopped}")
        times = Times(k, begun - start, deadline - start, ended - begun, now)
        fresh = fresh and wanted is not None
        self.recorder.add(times, observed, reading, wanted, action, fresh, events)

    def _read(self) -> Reading | None:
        try:
            return checked(self.stream.latest())
        except Exception as error:  # whatever a sensor's driver raises: it is as good as no reading
            self._note_stop(Stop("reading", _line(error)))
            return None

    def _decide(self, observed: Observed, reading: Reading) -> tuple[NDArray | None, Stop | None]:
        """What the policy wants, or what is wrong with it."""
        if not np.isfinite(observed.state).all():
            return None, Stop("state", "the robot's state is not finite")
        goal = observed.goal if reading.goal is None else reading.goal
        seen = {"observation": observed.state, "desired_goal": goal, "obstacle": reading.obstacle}
        try:
            wanted = self.mind.decide(seen, self._fresh)
        except Exception as error:  # whatever a policy raises: the robot must stand
            return None, Stop("policy", _line(error))
        self._fresh = False
        # What took long was decided on a reading that may be too old by now.
        why = self.limits.check(wanted) or self.watchdog.judge(reading, self.clock.now())
        if why is not None:
            self.mind.discard()
            return None, why
        return wanted, None

    def _command(self, wanted: NDArray | None, events: list[str]) -> NDArray[np.float32]:
        """Tell the robot what to do; the action that stands."""
        if self.watchdog.stopped is not None or wanted is None:
            self._halt()
            return self._last
        action = self.limits(wanted, self._last, self.period)
        try:
            self.robot.apply(action)
        except Exception as error:  # whatever a driver raises
            self._fatal, why = True, Stop("robot", _line(error))
            events.append(f"stop: {why}")
            self._stop(why)
            return self._last
        self._last = action
        return action

    def _stop(self, why: Stop) -> bool:
        """Stop the robot; whether there is a reason to tell."""
        told = self.watchdog.stop(why)
        self._halt()
        return told

    def _halt(self) -> None:
        self._last = self.limits.rest()
        try:
            self.robot.stop()
        except Exception as error:  # whatever a driver raises: told again when the run ends
            self._fatal = True
            self.watchdog.stop(Stop("robot", _line(error)))

    def _note_stop(self, why: Stop) -> None:
        """Stop between periods."""
        if self._stop(why) or self._fatal:
            self.recorder.amend(f"stop: {self.watchdog.stopped}")


@contextmanager
def _steady() -> Iterator[None]:
    """No garbage collection meanwhile: it would come in some period and take milliseconds."""
    was = gc.isenabled()
    gc.collect()
    gc.disable()
    try:
        yield
    finally:
        if was:
            gc.enable()


def _about(mind: Mind, period: float) -> dict[str, Any]:
    """What is known of a run, as numbers and texts that JSON has."""
    about = {"period": float(period), "seed": int(mind.seed), "deterministic": bool(mind.deterministic)}
    env_id = getattr(mind.policy, "env_id", None)  # of agents, exported or not
    return about if env_id is None else about | {"env": str(env_id)}


def _line(error: Exception) -> str:
    text = str(error).strip().splitlines()
    return f"{type(error).__name__}: {text[0]}" if text else type(error).__name__

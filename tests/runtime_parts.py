"""A clock that is told, and robots, readings and policies made by hand, shared by the tests of the runtime."""

from __future__ import annotations

import numpy as np

from rise_agents.runtime import ControlLoop, Limits, Observed, Reading, Rules
from rise_agents.runtime.loop import Mind
from rise_envs.task import task_of

VEHICLE, PANDA = "RISE-GroundVehicle-v0", "RISE-SafePanda-v0"
TASK = task_of(VEHICLE)
T = 0.125  # s: a power of two, so that multiples of it are exact
LIMITS = Limits(np.array([0.0, -1.5]), np.array([2.5, 1.5]))
C = np.array([3.0, 1.0, 0.1, -0.1, 1.0])


class Clock:
    """Time passes only when somebody waits or works; ``late`` says how much later each wait ends."""

    def __init__(self, late=()):
        self.time, self.late = 64.0, iter(late)
        self.at = []  # what is to happen: (time, function), in order

    def now(self):
        return self.time

    def wait(self, until):
        self.pass_to(max(self.time, until) + next(self.late, 0.0))

    def work(self, seconds):
        self.pass_to(self.time + seconds)

    def pass_to(self, time):
        while self.at and self.at[0][0] <= time:
            self.time, happens = max(self.time, self.at[0][0]), self.at.pop(0)[1]
            happens()
        self.time = time


class Robot:
    """Notes what it is told and when."""

    def __init__(self, clock, fails=""):
        self.clock, self.fails = clock, fails
        self.told = []  # (time, "apply" or "stop", action)
        self.state = np.zeros(3)

    def observe(self):
        if self.fails == "observe":
            raise OSError("no answer")
        return Observed(self.state.copy(), np.array([9.0, 0.0]))

    def apply(self, action):
        if self.fails == "apply":
            raise OSError("no answer")
        if self.fails == "write":
            action[0] = 99.0
        self.told.append((self.clock.now(), "apply", np.array(action)))

    def stop(self):
        self.told.append((self.clock.now(), "stop", None))

    def times(self, what):
        return [time for time, told, _ in self.told if told == what]

    @property
    def stopped_at(self):
        """When it was stopped after it last moved."""
        last = max(i for i, (_, told, _) in enumerate(self.told) if told == "apply")
        return self.told[last + 1][0]


class Readings:
    """Readings that arrive at given times, each taken ``delay`` before; after the last one there is none."""

    def __init__(self, clock, times, delay=0.0, obstacle=C):
        self.clock, self.times, self.delay = clock, np.asarray(times, np.float64), delay
        self.obstacle = obstacle if callable(obstacle) else lambda number: obstacle

    def latest(self):
        number = int(np.searchsorted(self.times, self.clock.now(), side="right"))
        if number == 0:
            return None
        return Reading(np.asarray(self.obstacle(number)), self.times[number - 1] - self.delay, number)


class Policy:
    """Wants what it is given, call by call, then the last again; a function is called for it."""

    def __init__(self, *wants):
        self.wants, self.calls, self.starts, self.seen = wants or ((1.0, 0.5),), 0, [], []

    def predict(self, observation, state=None, episode_start=None, deterministic=False):
        want = self.wants[min(self.calls, len(self.wants) - 1)]
        self.calls += 1
        self.starts.append(bool(episode_start[0]))
        self.seen.append(observation)
        want = want() if callable(want) else want
        return np.asarray(want), state


def regular(clock, count=1_000, every=T, phase=0.0):
    """Times of readings, the first at the start."""
    return clock.time + phase + every * np.arange(count)


def make(clock, policy=None, robot=None, readings=None, rules=None, limits=LIMITS):
    robot = Robot(clock) if robot is None else robot
    readings = Readings(clock, regular(clock)) if readings is None else readings
    policy = Policy() if policy is None else policy
    return ControlLoop(Mind(policy), robot, readings, TASK, limits, T, rules or Rules(), clock)

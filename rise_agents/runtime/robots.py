"""What a robot is to the loop, and the environments as robots.

Shapes: S state, D dimensions, A actions, C reading channels.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from rise_agents.runtime.streams import Reading, ReadingStream
from rise_envs import ENVS
from rise_envs.task import env_class, task_of


@dataclass(frozen=True)
class Observed:
    """What a robot knows of itself.

    Attributes:
        state: s, (S,).
        goal: g, (D,).
        clearance: least distance to the obstacles since the last call (m), if it can tell; < 0: collision.
        reached: whether it is at the goal.
        begins: whether an episode begins: a policy's memory is void.
    """

    state: NDArray[np.float64]
    goal: NDArray[np.float64]
    clearance: float = math.nan
    reached: bool = False
    begins: bool = False


class Robot(Protocol):
    """Called once each in a period: ``observe``, then ``apply`` or ``stop``; ``stop`` perhaps again.

    A driver should stop by itself when no command came for two periods: a loop that hangs cannot tell it to.
    """

    def observe(self) -> Observed:
        """State and goal, now."""

    def apply(self, action: NDArray[np.float32]) -> None:
        """Carry out an action, (A,), until the next command; the array cannot be written to."""

    def stop(self) -> None:
        """Stand still, safely; may be called again and again."""


class EnvRobot:
    """An environment as a robot in real time: its step of a period is simulated as the next one begins.

    So the command that stands at the end of a period is the one that was carried out in it.

    Args:
        env_id: a RISE environment.
        clock: that stamps its readings.
        seed: of the first episode, which others follow.
        follow: goal and obstacles are those of this stream, and no episode ends; None: they are the environment's, and
            episodes follow each other.

    Attributes:
        reading: the true one of the last ``observe()``.

    Raises:
        ValueError: ``follow`` with an environment that cannot have its obstacles placed.
    """

    def __init__(self, env_id: str, clock: Any, seed: int = 0, follow: ReadingStream | None = None) -> None:
        self.task, self._clock, self._follow = task_of(env_id), clock, follow
        self._env: Any = env_class(env_id)()
        if follow is not None and not hasattr(self._env, "place"):
            raise ValueError(f"obstacles of {env_id} cannot be placed: leave out --udp, or name another task")
        self._length = ENVS[env_id][2]
        space = self._env.action_space
        self._rest = np.clip(np.zeros(space.shape), space.low, space.high).astype(np.float32)
        self._env.reset(seed=seed)
        self._env.step(self._rest)  # what is compiled or loaded in a first step, is now
        self.reading: Reading | None = None
        self._command, self._number, self._steps = self._rest, 0, -1
        self._observation: dict[str, Any] = {}
        self._info: dict[str, Any] = {}
        self._begin(seed)

    def _begin(self, seed: int | None = None) -> None:
        self._observation, self._info = self._env.reset(seed=seed)
        self._steps, self._ended = -1, False

    def observe(self) -> Observed:
        """Simulate the step that has passed, or begin the next episode."""
        if self._ended:
            self._begin()
        external = None if self._follow is None else self._follow.latest()
        if external is not None:
            obstacles = external.obstacle.reshape(-1, 2 * self.task.dim + 1).copy()
            # Read with noise, as a recorded run was, a radius may be below zero: hardly anything is there.
            obstacles[:, -1] = np.maximum(obstacles[:, -1], 1e-9)
            self._env.place(external.goal, obstacles.ravel())
        if self._steps >= 0:
            self._observation, _, terminated, _, self._info = self._env.step(self._command)
            self._ended = self._follow is None and (terminated or self._steps + 1 >= self._length)
        self._steps += 1
        begins = self._steps == 0
        self._number += 1
        seen = self._observation
        self.reading = Reading(seen["obstacle"], self._clock.now(), self._number, begins=begins)
        clearance, reached = float(self._info["clearance"]), bool(self._info["is_success"])
        return Observed(seen["observation"], seen["desired_goal"], clearance, reached, begins)

    def apply(self, action: NDArray[np.float32]) -> None:
        """Command of this period."""
        self._command = action

    def stop(self) -> None:
        """No motion from here on; goal and obstacles go on."""
        self._command = self._rest

    def close(self) -> None:
        """Free the engine."""
        self._env.close()

"""Control-barrier-function expert for the Panda.

Every step solves a small quadratic program with one row per capsule of the arm; see
:mod:`rise_agents.experts.panda_steering`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from rise_agents.experts.panda_model import DT, Scene, look, make_arm
from rise_agents.experts.panda_steering import Steering, choose_side, make_program, steer
from rise_agents.readings import checked_batch
from rise_envs.settings import check_fields
from rise_envs.task import Task

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Config:
    """Settings: those of the barrier QP and of the choice of a side."""

    steering: Steering = Steering()  # noqa: RUF009 - immutable

    def __post_init__(self) -> None:
        check_steering(self.steering)


def check_steering(steering: Steering) -> None:
    """Raise ``ValueError`` for settings that make no sense."""
    check_fields(Steering, steering._asdict())
    if not 0.0 < steering.decay <= 1.0:
        raise ValueError(f"Steering.decay must be in (0, 1], got {steering.decay!r}")
    if not steering.turn_near < steering.turn_far:
        raise ValueError(f"Steering.turn_near must be below turn_far, got {steering!r}")
    for name in ("slow_down", "price", "horizon"):
        if not getattr(steering, name) > 0:
            raise ValueError(f"Steering.{name} must be positive, got {getattr(steering, name)!r}")


@njit(cache=True)
def _act(state: Array, goal: Array, reading: Array, t: Steering, action: Array) -> None:
    """Write actions (B, 3) for states (B, 13), goals (B, 3) and readings (B, 7)."""
    arm, program, actions, side = make_arm(), make_program(), np.empty((t.horizon, 3)), np.empty(3)
    for b in range(len(state)):
        q, velocity = state[b, 6:].copy(), state[b, 3:6].copy()
        scene = Scene(goal[b].copy(), reading[b, :3].copy(), DT * reading[b, 3:6], reading[b, 6])
        choose_side(q, velocity, scene, side, t, arm, program, actions)
        look(q, scene.center, arm)
        steer(velocity, scene, side, t, arm, program, action[b])


class PandaCBF:
    """The expert: memoryless, deterministic, reads the observation only.

    Args:
        task: description of the Panda task.
        seed: ignored (nothing is random); there so that all experts are made alike.
        config: settings.
    """

    def __init__(self, task: Task, seed: int = 0, config: Config = Config()) -> None:
        self.task, self.config = task, config

    def predict(
        self,
        observation: Mapping[str, Array],
        state: Any = None,
        episode_start: NDArray[np.bool_] | None = None,
        deterministic: bool = True,
    ) -> tuple[Array, None]:
        """Actions, (3,) or (B, 3), and None: the expert keeps no state."""
        rows, single = checked_batch(self.task, observation)
        own, goal, reading = packed(rows)
        action = np.empty((len(goal), 3))
        _act(own, goal, reading, self.config.steering, action)
        return (action[0] if single else action), None


def packed(rows: Mapping[str, Array]) -> tuple[Array, Array, Array]:
    """States (B, 13), goals (B, 3) and readings (B, 7) of a batch of observations, contiguous."""
    own, goal, reading = (np.ascontiguousarray(rows[k]) for k in ("observation", "desired_goal", "obstacle"))
    return own, goal, reading

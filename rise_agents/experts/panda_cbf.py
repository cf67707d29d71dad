"""Control-barrier-function expert for the Panda.

Every step solves a small quadratic program with one row per capsule of the arm; see
:mod:`rise_agents.experts.panda_steering`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from rise_agents.experts.batch import as_batch
from rise_agents.experts.panda_model import DT, Scene, look, make_arm
from rise_agents.experts.panda_steering import Steering, choose_side, make_program, steer
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
    if not 0.0 < steering.decay <= 1.0:
        raise ValueError(f"Steering.decay must be in (0, 1], got {steering.decay!r}")
    if not steering.turn_near < steering.turn_far:
        raise ValueError(f"Steering.turn_near must be below turn_far, got {steering!r}")
    for name in ("slow_down", "penalty", "horizon"):
        if not getattr(steering, name) > 0:
            raise ValueError(f"Steering.{name} must be positive, got {getattr(steering, name)!r}")


@njit(cache=True)
def _act(state: Array, goal: Array, reading: Array, side: Array, t: Steering, action: Array) -> None:
    """Write actions (B, 3) for states (B, 13), goals (B, 3), readings (B, 7); update the sides (B, 3)."""
    arm, program, actions = make_arm(), make_program(), np.empty((t.horizon, 3))
    for b in range(len(state)):
        q, velocity = state[b, 6:].copy(), state[b, 3:6].copy()
        scene = Scene(goal[b].copy(), reading[b, :3].copy(), DT * reading[b, 3:6], reading[b, 6])
        choose_side(q, velocity, scene, side[b], t, arm, program, actions)
        look(q, scene.center, arm)
        steer(velocity, scene, side[b], t, arm, program, action[b])


class PandaCBF:
    """The expert. It is deterministic and reads the observation only.

    Args:
        task: description of the Panda task.
        seed: ignored (nothing is random); there so that all experts are made alike.
        config: settings.
    """

    def __init__(self, task: Task, seed: int = 0, config: Config = Config()) -> None:
        self.task, self.config = task, config

    def initial_state(self, keys: NDArray[np.uint64]) -> tuple[Array, ...]:
        """The state at the start of the episodes with the given keys (B,): no side taken yet, (B, 3)."""
        return (np.zeros((len(keys), 3)),)

    def predict(
        self,
        observation: Mapping[str, Array],
        state: tuple[Array, ...] | None = None,
        episode_start: NDArray[np.bool_] | None = None,
        deterministic: bool = True,
    ) -> tuple[Array, tuple[Array, ...]]:
        """Actions, (3,) or (B, 3), and the passing sides (B, 3), to be handed in again at the next step."""
        rows, single = as_batch(observation)
        goal = np.ascontiguousarray(rows["desired_goal"])
        side = fresh_rows(state, 0, (len(goal), 3), episode_start)
        action = np.empty((len(goal), 3))
        reading = np.ascontiguousarray(rows["obstacle"])
        _act(np.ascontiguousarray(rows["observation"]), goal, reading, side, self.config.steering, action)
        return (action[0] if single else action), (side,)


def fresh_rows(
    state: tuple[Array, ...] | None, which: int, shape: tuple[int, ...], start: NDArray[np.bool_] | None
) -> Array:
    """A copy of array number ``which`` of the state, or zeros, with zeros in the rows that ``start`` (B,)."""
    array = np.zeros(shape) if state is None else np.array(state[which], dtype=np.float64)
    if start is not None:
        array[np.asarray(start, dtype=bool).reshape(-1)] = 0.0
    return array

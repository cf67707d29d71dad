"""``mixture`` expert: each episode is driven by one of several experts, drawn by the episode's key.

Shapes: B batch.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from rise_agents.agent import State, initial_state, merge_states
from rise_agents.readings import checked_batch
from rise_envs import streams
from rise_envs.task import Task

Array = NDArray[np.float64]
Keys = NDArray[np.uint64]

_CHOICE, _NEXT, _MEMBER = 0, 1, 2  # purposes that a key is split for


class Mixture:
    """One expert per episode.

    The state is ``(choice, key, steps, *states of the experts)``, each with the batch first: which expert
    drives the row (an index into ``names``), the episode's key, and how many steps it has taken. A row's choice
    is a function of its key only. Keys come from :meth:`initial_state`; a row that ``episode_start`` marks after
    its first step goes on with the key that follows from its last one.

    Args:
        task: description of the task.
        experts: the experts to draw from, one for each of ``names``.
        seed: of the keys of episodes that begin without a state.
    """

    names: ClassVar[tuple[str, ...]] = ("cbf", "mpc")

    def __init__(self, task: Task, experts: Sequence[Any], seed: int = 0) -> None:
        if len(experts) != len(self.names):
            raise ValueError(f"Mixture needs one expert for each of {self.names}, got {len(experts)}")
        self.task, self.experts, self.seed = task, tuple(experts), seed

    def choose(self, keys: Keys) -> NDArray[np.int64]:
        """Which expert drives each of the episodes with the given keys (B,): indices into ``names``."""
        draw = streams.uniform(streams.split(keys, _CHOICE), 0)
        return (draw * len(self.experts)).astype(np.int64)

    def initial_state(self, keys: Keys) -> tuple[NDArray, ...]:
        """The state at the start of the episodes with the given keys, (B,) uint64."""
        keys = np.array(keys, dtype=np.uint64)
        state: list[NDArray] = [self.choose(keys), keys, np.zeros(len(keys), np.int64)]
        for index, expert in enumerate(self.experts):
            state += initial_state(expert, streams.split(keys, _MEMBER + index)) or ()
        return tuple(state)

    def predict(
        self,
        observation: Mapping[str, Array],
        state: State = None,
        episode_start: NDArray[np.bool_] | None = None,
        deterministic: bool = True,
    ) -> tuple[Array, State]:
        """Actions of the experts that drive the rows, (A,) or (B, A), and the state for the next step.

        Raises:
            ValueError: an expert returns a state but has no ``initial_state`` that says how it begins.
        """
        rows, single = checked_batch(self.task, observation)
        batch = len(rows["desired_goal"])
        state, starts = self._begin(state, episode_start, batch)
        choice, keys, steps, *memory = state
        action: Array | None = None
        position = 0
        for index, expert in enumerate(self.experts):
            width = len(initial_state(expert, keys[:0]) or ())
            mine, own = np.flatnonzero(choice == index), memory[position : position + width]
            if mine.size:
                picked = {name: value[mine] for name, value in rows.items()}
                before = tuple(array[mine] for array in own) or None
                part, after = expert.predict(picked, before, starts[mine], deterministic)
                if len(after or ()) != width:
                    raise ValueError(
                        f"expert {self.names[index]!r} keeps a state: give it initial_state(keys)"
                    )
                memory[position : position + width] = [
                    _put(a, mine, b) for a, b in zip(own, after or (), strict=True)
                ]
                action = np.zeros((batch, part.shape[1])) if action is None else action
                action[mine] = part
            position += width
        if action is None:
            raise ValueError("predict() was given an empty batch")
        return (action[0] if single else action), (choice, keys, steps + 1, *memory)

    def _begin(
        self, state: State, episode_start: NDArray[np.bool_] | None, batch: int
    ) -> tuple[tuple[NDArray, ...], NDArray[np.bool_]]:
        """The state with new episodes begun, and the rows that are at their first step."""
        if state is None:
            state = self.initial_state(streams.bits(streams.key_from_seed(self.seed), np.arange(batch)))
        elif episode_start is not None:
            # A state fresh from initial_state() has its key; one that has driven moves on to the next.
            again = np.asarray(episode_start, bool).reshape(batch) & (state[2] > 0)
            if again.any():
                state = merge_states(state, self.initial_state(streams.split(state[1], _NEXT)), again) or ()
        return state, state[2] == 0


def _put(array: NDArray, rows: NDArray[np.int64], values: NDArray) -> NDArray:
    changed = array.copy()
    changed[rows] = values
    return changed

"""What every agent is: something that learns, predicts, and can be stored.

``predict`` has the signature of stable-baselines3, batched and single alike, so its tools (``evaluate_policy``)
accept every agent and every expert. ``state`` is None or a tuple of arrays with the batch first; a rollout can
therefore exchange single rows. An agent that draws random numbers keeps one key and one counter per row in its
state, so that what it does in an episode depends on the episode's key only, not on its neighbours.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from dataclasses import asdict
from typing import Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from rise_envs import STAND_INS, streams
from rise_envs.settings import as_settings
from rise_envs.settings import nearest as nearest

State = tuple[NDArray, ...] | None
# Reports training progress: (share done in [0, 1], named figures of this moment).
Progress = Callable[[float, dict[str, float]], None]


def silent(share: float, figures: dict[str, float]) -> None:
    """Progress that nobody watches."""


@runtime_checkable
class Policy(Protocol):
    """Anything that acts: agents and experts."""

    def predict(
        self,
        observation: Any,
        state: State = None,
        episode_start: NDArray[np.bool_] | None = None,
        deterministic: bool = False,
    ) -> tuple[NDArray, State]:
        """Actions for one observation or a batch, and the state to hand in with the next one."""


class Agent(Policy, Protocol):
    """A policy that learns and can be stored.

    Attributes:
        learns_from: ``"demonstrations"`` or ``"environment"``, what :meth:`learn` is given.
        evaluate_deterministic: how the agent is meant to act when it is judged.
        Config: the frozen dataclass of its settings.
        PRESETS: per environment id, settings that serve better there than the defaults.
        BRIEF: settings with which it trains in a second or two, to see that all works; of no use otherwise.

    Settings that change how it acts and nothing that it learns are named by a class attribute
    ``ACTING: frozenset[str]``, if it has any: what is trained once then acts with any of them.
    """

    Config: type
    PRESETS: dict[str, dict[str, Any]]
    BRIEF: dict[str, Any]
    learns_from: str
    evaluate_deterministic: bool

    def learn(self, source: Any, progress: Progress = silent, resume: Any = None) -> Agent:
        """Train on demonstrations, or in the environment whose id is given.

        Args:
            source: what it learns from.
            progress: told now and then.
            resume: a :class:`rise_agents.resume.Resume`, or a path for one: where the state of the training is kept,
                and from where an interrupted one goes on, to the same weights bit for bit (on the CPU).

        Raises:
            ValueError: a source that it cannot learn from.
            rise_agents.checkpoint.CheckpointError: the file to go on from is damaged or of another training.
        """

    def save(self, path: str | os.PathLike[str]) -> None:
        """Store everything that :func:`rise_agents.load_agent` needs."""


def initial_state(policy: Any, keys: NDArray[np.uint64]) -> State:
    """The state of ``policy`` at the start of the episodes with the given keys (B,); None if it keeps none."""
    start = getattr(policy, "initial_state", None)
    return start(keys) if start else None


def merge_states(old: State, new: State, rows: NDArray[np.bool_]) -> State:
    """``old`` with the given ``rows`` (B,) bool taken from ``new``; if one of them is None, the other one.

    A policy that names no initial state begins rows anew itself, where ``episode_start`` says so.
    """
    if old is None or new is None:
        return new if old is None else old
    return tuple(
        np.where(rows.reshape((-1,) + (1,) * (a.ndim - 1)), b, a) for a, b in zip(old, new, strict=True)
    )


def config_from_dict(kind: type, values: Mapping[str, Any]) -> Any:
    """A validated config dataclass from a plain dict.

    Raises:
        ValueError: an unknown key (the nearest known one is named), or a value of another kind than the field.
    """
    return as_settings(kind, values, "config")


def make_config(kind: Any, env_id: str, values: dict[str, Any]) -> Any:
    """The complete settings of an agent class for an environment: its defaults there, with ``values`` over them.

    What stands in for an environment has that environment's defaults.
    """
    preset = kind.PRESETS.get(STAND_INS.get(env_id, env_id), {})
    if not isinstance(values, Mapping):
        raise ValueError(f"config must be a dict of the agent's settings, got {values!r}")
    return config_from_dict(kind.Config, {**preset, **values})


def config_to_dict(config: Any) -> dict[str, Any]:
    """The inverse of :func:`config_from_dict`, fit for JSON."""
    return {key: list(value) if isinstance(value, tuple) else value for key, value in asdict(config).items()}


def acting_settings(kind: Any) -> frozenset[str]:
    """The settings of an agent class that matter only when it acts; most have none."""
    return getattr(kind, "ACTING", frozenset())


def require(condition: bool, what: str, value: Any) -> None:
    """Raise ``ValueError`` that says what a setting must be and what it was."""
    if not condition:
        raise ValueError(f"{what}, got {value!r}")


def fresh_state(keys: NDArray[np.uint64]) -> tuple[NDArray, ...]:
    """The state of a policy that draws: a key and a counter for each row."""
    return np.asarray(keys, np.uint64), np.zeros(len(keys), np.uint64)


def draw_state(
    state: State, episode_start: NDArray[np.bool_] | None, rows: int, rng: np.random.Generator
) -> tuple[NDArray[np.uint64], NDArray[np.uint64]]:
    """Keys and counters (B,) to draw with: new ones without a state, a derived key where an episode starts.

    A row whose counter is zero has not drawn yet, so the start of its first episode changes nothing.
    """
    if state is None:
        state = fresh_state(rng.integers(0, 2**64, rows, dtype=np.uint64))
    keys, counter = state
    starts = np.zeros(rows, bool) if episode_start is None else np.atleast_1d(episode_start) & (counter > 0)
    if starts.any():
        keys = np.where(starts, streams.bits(keys, counter), keys)
        counter = np.where(starts, np.uint64(0), counter)
    return keys, counter


def require_widths(name: str, widths: tuple[Any, ...]) -> None:
    """Raise ``ValueError`` unless a setting holds the widths of at least one layer."""
    fits = len(widths) > 0 and all(type(width) is int and width >= 1 for width in widths)
    require(fits, f"{name} must hold whole numbers of at least 1, one for each layer", widths)

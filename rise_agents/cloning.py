"""What cloned policies share: data in a frame, units of actions, the imitation loss, storage.

Shapes: B batch, M samples, T transitions, R robot inputs, C reading inputs, A actions.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from rise_agents import checkpoint, readings
from rise_agents.agent import Progress, config_to_dict, require, require_widths
from rise_agents.demonstrations import Demonstrations
from rise_agents.files import StrPath
from rise_agents.forward import Layer, rescaled
from rise_agents.readings import Standardiser
from rise_agents.resume import Resume
from rise_agents.search import Choice, LogRange
from rise_agents.workers import keep_freed_memory
from rise_envs.task import Task, env_class, task_of

if TYPE_CHECKING:  # who only acts need not spend the second that importing torch takes
    import torch
    from torch import Tensor

    from rise_agents.stages import Stages

LOSSES = ("mse", "nll")
# What is searched of every cloned policy, see :mod:`rise_agents.search`.
SEARCH: dict[str, Choice | LogRange] = {
    "frame": Choice(readings.FRAMES),
    "hidden": Choice(((128, 128), (256, 256))),
    "loss": Choice(LOSSES),
    "updates": Choice((10_000, 20_000, 40_000)),
    "learning_rate": LogRange(3e-4, 3e-3),
}


@dataclass(frozen=True)
class CloningConfig:
    """Settings of every cloned policy.

    Attributes:
        frame: how observations are seen: ``world``, ``body`` or ``features`` (see :mod:`rise_agents.readings`).
        hidden: widths of the policy's hidden layers.
        loss: ``mse``, or ``nll`` for a Gaussian policy with a learned deviation (it acts with its mean).
        updates: gradient steps of the policy.
        batch_size: transitions per step.
        learning_rate: of Adam, decayed to zero by a cosine.
        transitions: learn from whole episodes with at most so many transitions, another, disjoint part of the
            demonstrations for each training seed: seed k takes the k-th such block, and where the set has fewer
            blocks, it begins again with the first. 0: every seed learns from all of them.
    """

    frame: str = "body"
    hidden: tuple[int, ...] = (128, 128)
    loss: str = "mse"
    updates: int = 20_000
    batch_size: int = 256
    learning_rate: float = 1e-3
    transitions: int = 0

    def __post_init__(self) -> None:
        require(self.frame in readings.FRAMES, f"frame must be one of {readings.FRAMES}", self.frame)
        require(self.loss in LOSSES, f"loss must be one of {LOSSES}", self.loss)
        require_widths("hidden", self.hidden)
        for name in ("updates", "batch_size"):
            require(getattr(self, name) >= 1, f"{name} must be at least 1", getattr(self, name))
        require(
            0 < self.learning_rate < np.inf, "learning_rate must be positive and finite", self.learning_rate
        )
        require(self.transitions >= 0, "transitions must not be negative", self.transitions)


@dataclass(frozen=True)
class ActionUnits:
    """Actions between their bounds and [−1, 1]."""

    low: NDArray[np.float64]
    high: NDArray[np.float64]

    @classmethod
    def of(cls, env_id: str) -> ActionUnits:
        """The bounds of a registered environment's actions."""
        env = env_class(env_id)()
        space = env.action_space
        env.close()
        return cls(space.low.astype(np.float64), space.high.astype(np.float64))

    def to_unit(self, action: NDArray) -> NDArray[np.float64]:
        """Actions in their own units to [−1, 1]."""
        return 2 * (action - self.low) / (self.high - self.low) - 1

    def to_action(self, unit: NDArray) -> NDArray[np.float32]:
        """Actions in [−1, 1] to their own units."""
        return self.clip((self.low + (unit + 1.0) * 0.5 * (self.high - self.low)).astype(np.float32))

    def answering(self, layer: Layer) -> Layer:
        """A network's last ``layer``, of actions in [−1, 1] (and deviations), such that it gives actions."""
        half = 0.5 * (self.high - self.low)
        return rescaled(layer, half, self.low + half)

    def clip(self, action: NDArray[np.float32]) -> NDArray[np.float32]:
        """Actions inside the bounds (``np.clip`` takes twice as long for a single one)."""
        low, high = self._bounds
        return np.minimum(np.maximum(action, low), high)

    @property
    def size(self) -> int:
        """A, the number of actions."""
        return len(self.low)

    @cached_property
    def _bounds(self) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        return self.low.astype(np.float32), self.high.astype(np.float32)


@dataclass(frozen=True)
class CloningData:
    """Demonstrations as tensors on the training device, in standard units."""

    robot: Tensor  # (T, R)
    reading: Tensor  # (T, C)
    action: Tensor  # (T, A), in [−1, 1]


@dataclass(frozen=True)
class Eyes:
    """How a cloned policy sees observations: the frame, and the units fitted to its demonstrations."""

    task: Task
    frame: str
    robot: Standardiser
    reading: Standardiser

    @classmethod
    def fit(cls, task: Task, frame: str, demonstrations: Demonstrations) -> Eyes:
        """Units in which the demonstrations have zero mean and unit variance."""
        robot, reading = readings.inputs(task, frame, demonstrations.observations)
        return cls(task, frame, Standardiser.fit(robot), Standardiser.fit(reading))

    def inputs(self, observation: dict[str, NDArray]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Batched observations to robot inputs (B, R) and reading inputs (B, C), in their own units."""
        return readings.inputs(self.task, self.frame, observation)

    def __call__(self, observation: dict[str, NDArray]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """The same in standard units."""
        robot, reading = self.inputs(observation)
        return self.robot(robot), self.reading(reading)

    def arrays(self) -> dict[str, NDArray]:
        """The numbers to store."""
        return {**self.robot.arrays("eyes.robot"), **self.reading.arrays("eyes.reading")}

    @classmethod
    def from_arrays(cls, task: Task, frame: str, arrays: dict[str, NDArray]) -> Eyes:
        """The inverse of :meth:`arrays`."""
        robot, reading = (Standardiser.from_arrays(arrays, f"eyes.{part}") for part in ("robot", "reading"))
        return cls(task, frame, robot, reading)


@dataclass(frozen=True)
class Lesson:
    """What every cloned agent begins to learn with.

    Attributes:
        demonstrations: checked, and cut as the config says.
        eyes: how they are seen.
        data: the same as tensors on the training device, all at once.
        generator: of all that is random; see :func:`seeded`.
        stages: the fits that this training consists of, some of which an earlier process may have done.
        progress: to tell of the training.
    """

    demonstrations: Demonstrations
    eyes: Eyes
    data: CloningData
    generator: torch.Generator
    stages: Stages
    progress: Progress

    def normal(self, *shape: int) -> Tensor:
        """Standard normal draws on the training device."""
        return self.data.reading.new_empty(shape).normal_(generator=self.generator)


def begin(agent: Any, source: Any, progress: Progress, resume: Resume | StrPath | None) -> Lesson:
    """The arguments of ``agent.learn``, checked and prepared."""
    import torch  # here and not above: see there

    from rise_agents.stages import Stages

    c = agent.config
    demonstrations = check_source(source, agent)
    kept = Resume.of(resume)
    stages = Stages(kept, *kept.open(agent, demonstrations.digest() if kept.path else ""))
    generator = seeded(agent.seed, agent.device)
    eyes = Eyes.fit(agent.task, c.frame, demonstrations)
    action = agent.units.to_unit(demonstrations.actions).astype(np.float32)
    parts = (*eyes(demonstrations.observations), action)
    data = CloningData(*(torch.tensor(part, device=agent.device) for part in parts))
    return Lesson(demonstrations, eyes, data, generator, stages, kept.noting(progress))


def imitation_loss(output: Tensor, action: Tensor, kind: str) -> Tensor:
    """ℓ(â, a), averaged over everything but the last axis, which is summed.

    Args:
        output: (…, B, A) actions, or (…, B, 2A) means and log deviations for ``nll``.
        action: the expert's actions, (B, A).
        kind: ``mse`` or ``nll``.
    """
    if kind == "mse":
        return ((output - action) ** 2).sum(-1).mean()
    mean, log_std = output.chunk(2, -1)
    log_std = log_std.clamp(-5.0, 2.0)
    return (0.5 * ((action - mean) / log_std.exp()) ** 2 + log_std).sum(-1).mean()


def output_size(actions: int, kind: str) -> int:
    """Width of the policy's last layer."""
    return actions if kind == "mse" else 2 * actions


def seeded(seed: int, device: str) -> torch.Generator:
    """A generator on the training device; also seeds the initial weights of modules made from here on."""
    import torch

    keep_freed_memory()
    torch.manual_seed(seed)
    return torch.Generator(device=device).manual_seed(seed)


def check_source(source: Any, agent: Any) -> Demonstrations:
    """``source`` as demonstrations of the agent's own environment, cut to what its config and its seed say.

    Raises:
        ValueError: something else, or demonstrations of another environment.
    """
    if not isinstance(source, Demonstrations):
        raise ValueError(f"{agent.name} learns from Demonstrations, got {type(source).__name__}")
    if source.env_id != agent.env_id:
        raise ValueError(f"{agent.name} for {agent.env_id!r} was given demonstrations of {source.env_id!r}")
    transitions = agent.config.transitions
    return source.within(transitions, block=agent.seed) if transitions else source


def save(path: str | os.PathLike[str], agent: Any, arrays: dict[str, NDArray]) -> None:
    """Store a cloned agent; raises ``RuntimeError`` if it has learned nothing yet."""
    if not arrays:
        raise untrained(agent.name)
    description = {
        "agent": agent.name,
        "env": agent.env_id,
        "seed": agent.seed,
        "config": config_to_dict(agent.config),
    }
    checkpoint.save(path, arrays, description)


def input_widths(agent: Any) -> tuple[int, int]:
    """R and C: how many inputs a cloned agent makes of the robot and of the reading."""
    space = env_class(agent.env_id)().observation_space
    blank = {key: np.zeros((1, *part.shape)) for key, part in space.spaces.items()}
    robot, reading = readings.inputs(agent.task, agent.config.frame, blank)
    return robot.shape[1], reading.shape[1]


def check_arrays(agent: Any, arrays: dict[str, NDArray], shapes: Mapping[str, tuple[int, ...]]) -> None:
    """Raise ``ValueError`` unless ``arrays`` are those of a cloned agent.

    Args:
        agent: with its config.
        arrays: as they were stored.
        shapes: of what it stores beside its eyes, by name.
    """
    expected = dict(shapes)
    for part, width in zip(("robot", "reading"), input_widths(agent), strict=True):
        expected |= {f"eyes.{part}.{what}": (width,) for what in ("mean", "scale")}
    checkpoint.expect(arrays, expected)
    for name in ("eyes.robot.scale", "eyes.reading.scale"):
        require(bool((arrays[name] > 0).all()), f"{name} must be positive", arrays[name])


def untrained(name: str) -> RuntimeError:
    """The error of an agent that acts before it has learned."""
    return RuntimeError(f"this {name} has no weights yet: call learn(demonstrations) or load a checkpoint")


def make_task(env_id: str) -> Task:
    """The task of an environment (importing :mod:`rise_envs` first, so that its ids are known)."""
    import rise_envs  # noqa: F401

    return task_of(env_id)

"""A policy conditioned on the reading itself, a = π(s, g, c): how it is trained, and how it acts.

Shapes: B batch, M noisy copies, T transitions, R robot inputs, C reading inputs, A actions.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from rise_agents import cloning
from rise_agents.agent import Progress
from rise_agents.cloning import ActionUnits, CloningConfig, Eyes, Lesson
from rise_agents.forward import Forward, layers_of, standardised
from rise_envs.task import Task

if TYPE_CHECKING:
    from torch import Tensor, nn


class Clone:
    """A trained policy as it acts, in plain NumPy.

    Args:
        task: of its environment.
        frame: that it sees observations in.
        units: of its actions.
        arrays: its weights (``policy``) and the units of its inputs (``eyes``).
    """

    def __init__(self, task: Task, frame: str, units: ActionUnits, arrays: dict[str, NDArray]) -> None:
        self.units, self.eyes = units, Eyes.from_arrays(task, frame, arrays)
        first, *rest = layers_of(arrays, "policy")
        mean, scale = (
            np.concatenate([getattr(part, name) for part in (self.eyes.robot, self.eyes.reading)])
            for name in ("mean", "scale")
        )
        # It acts in the units of inputs and actions, which saves their conversion at every step.
        self._policy = Forward([standardised(first, mean, scale), *rest[:-1], units.answering(rest[-1])])

    def __call__(self, rows: dict[str, NDArray]) -> NDArray[np.float32]:
        """Actions (B, A) for a checked batch of observations."""
        return self.units.clip(self._policy(*self.eyes.inputs(rows)))


def sizes(config: CloningConfig, inputs: int, actions: int) -> tuple[int, tuple[int, ...], int]:
    """Inputs, hidden widths and outputs of π(s, g, c)."""
    return inputs, config.hidden, cloning.output_size(actions, config.loss)


def train(
    lesson: Lesson, config: CloningConfig, progress: Progress, train_noise: float = 0.0, n_samples: int = 1
) -> dict[str, NDArray]:
    """Clone the lesson's demonstrations; the weights and the units of their inputs, as :class:`Clone` takes them.

    Args:
        lesson: see :func:`rise_agents.cloning.begin`.
        config: of the clone.
        progress: told of the training.
        train_noise: level of fresh noise on the readings, in units of the task's noise scale.
        n_samples: M, noisy copies of each transition in an update.
    """
    import torch  # here and not above: it takes a second, which who only acts need not spend

    from rise_agents.networks import mlp
    from rise_agents.stages import to_arrays
    from rise_agents.training import fit

    data = lesson.data
    inputs: tuple[Tensor, ...] = (torch.cat((data.robot, data.reading), -1),)
    policy = mlp(*sizes(config, inputs[0].shape[1], data.action.shape[1])).to(data.action.device)
    noisy = NoisyReadings(lesson, train_noise, n_samples) if train_noise else None
    if noisy:
        inputs = noisy.raw()

    def loss(*rows: Tensor) -> dict[str, Tensor]:
        seen = noisy(*rows[:-1]) if noisy else rows[0]
        return policy_loss(policy, seen, rows[-1], config.loss)

    fit(
        lesson.stages["policy"],
        policy,
        loss,
        (*inputs, data.action),
        updates=config.updates,
        batch_size=config.batch_size,
        learning_rate=config.learning_rate,
        generator=lesson.generator,
        progress=progress,
    )
    return {**lesson.eyes.arrays(), **to_arrays(policy, "policy")}


class NoisyReadings:
    """What a policy sees of demonstrations whose readings carry fresh noise, drawn anew in every update.

    The noise enters the reading itself, in the world, and the frame is computed from what was read: as in the
    environment, whatever the frame makes of it.

    Args:
        lesson: the demonstrations, how they are seen, and the generator to draw from.
        level: of the noise, in units of the task's ``noise_scale``.
        copies: how many: M.
    """

    KEYS = ("observation", "desired_goal", "obstacle")

    def __init__(self, lesson: Lesson, level: float, copies: int) -> None:
        self.lesson, self.copies = lesson, copies
        self.deviation = level * np.asarray(lesson.eyes.task.noise_scale)

    def raw(self) -> tuple[Tensor, ...]:
        """States, goals and true readings of all transitions, (T, ·) each, float64, on the training device."""
        import torch

        device, parts = self.lesson.data.action.device, self.lesson.demonstrations.observations
        return tuple(torch.tensor(parts[key], device=device) for key in self.KEYS)

    def __call__(self, *rows: Tensor) -> Tensor:
        """Robot and reading inputs in standard units, (M, B, R + C), of M noisy copies of raw rows (B, ·)."""
        import torch

        draws = self.lesson.normal(self.copies, *rows[2].shape).cpu().numpy()
        repeated = (np.tile(row.cpu().numpy(), (self.copies, 1)) for row in rows)
        observation = dict(zip(self.KEYS, repeated, strict=True))
        observation["obstacle"] += self.deviation * draws.reshape(observation["obstacle"].shape)
        seen = np.concatenate(self.lesson.eyes(observation), -1).reshape(self.copies, len(rows[0]), -1)
        return torch.from_numpy(seen).to(rows[0].device)


def policy_loss(policy: nn.Module, seen: Tensor, action: Tensor, kind: str) -> dict[str, Tensor]:
    """The imitation loss of actions (B, A) at robot and reading inputs (…, B, R + C)."""
    return {"loss": cloning.imitation_loss(policy(seen), action, kind)}

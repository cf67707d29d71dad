"""PC-BC: behaviour cloning conditioned on the reading itself (Ding et al., 2020; the paper's first baseline).

The same inputs, data, network, loss and budget as RISE, without the encoder: a = π(s, g, c).

As a control it can learn on readings with noise of its own, as many noisy copies of each as RISE draws samples of
its latent: what is left between both is then what the encoder adds to training on noise.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from rise_agents import cloning, shapes
from rise_agents.agent import Progress, State, make_config, require, silent
from rise_agents.cloning import ActionUnits, CloningConfig, Eyes, Lesson
from rise_agents.files import StrPath
from rise_agents.forward import Forward, layers_of, standardised
from rise_agents.readings import checked_batch
from rise_agents.resume import Resume
from rise_agents.search import EVERYWHERE, Space

if TYPE_CHECKING:
    from torch import Tensor, nn


@dataclass(frozen=True)
class Config(CloningConfig):
    """Settings of PC-BC, beside those of every cloned policy.

    Attributes:
        train_noise: level of the fresh Gaussian noise on the readings that it learns from, in units of the task's
            ``noise_scale``; 0: the true readings.
        n_samples: M, noisy copies of each transition in an update; of true readings one says it all.
    """

    train_noise: float = 0.0
    n_samples: int = 1

    def __post_init__(self) -> None:
        super().__post_init__()
        require(0 <= self.train_noise < np.inf, "train_noise must not be negative", self.train_noise)
        require(self.n_samples >= 1, "n_samples must be at least 1", self.n_samples)


class PCBC:
    """Parameter-conditioned behaviour cloning.

    Args:
        env_id: a registered environment with a task description.
        config: settings that differ from :class:`Config`.
        seed: of the weights and the order of the data.
        device: where it trains (it acts in NumPy).
    """

    name = "pcbc"
    Config = Config
    PRESETS: ClassVar[dict[str, dict[str, Any]]] = {}
    SEARCH: ClassVar[dict[str, Space]] = {EVERYWHERE: cloning.SEARCH}
    learns_from = "demonstrations"
    evaluate_deterministic = True

    def __init__(self, env_id: str, config: dict[str, Any], seed: int = 0, device: str = "cpu") -> None:
        self.env_id, self.seed, self.device = env_id, seed, device
        self.config = make_config(type(self), env_id, config)
        self.task, self.units = cloning.make_task(env_id), ActionUnits.of(env_id)
        self._arrays: dict[str, NDArray] = {}

    def learn(self, source: Any, progress: Progress = silent, resume: Resume | StrPath | None = None) -> PCBC:
        """Clone :class:`rise_agents.demonstrations.Demonstrations`; see :class:`rise_agents.agent.Agent`."""
        import torch  # here and not above: it takes a second, which who only acts need not spend

        from rise_agents.networks import mlp
        from rise_agents.stages import to_arrays
        from rise_agents.training import fit

        c = self.config
        lesson = cloning.begin(self, source, progress, resume)
        data = lesson.data
        inputs: tuple[Tensor, ...] = (torch.cat((data.robot, data.reading), -1),)
        policy = mlp(*self._sizes(inputs[0].shape[1])).to(self.device)
        noisy = NoisyReadings(lesson, c.train_noise, c.n_samples) if c.train_noise else None
        if noisy:
            inputs = noisy.raw()

        def loss(*rows: Tensor) -> dict[str, Tensor]:
            seen = noisy(*rows[:-1]) if noisy else rows[0]
            return policy_loss(policy, seen, rows[-1], c.loss)

        fit(
            lesson.stages["policy"],
            policy,
            loss,
            (*inputs, data.action),
            updates=c.updates,
            batch_size=c.batch_size,
            learning_rate=c.learning_rate,
            generator=lesson.generator,
            progress=lesson.progress,
        )
        return self._use({**lesson.eyes.arrays(), **to_arrays(policy, "policy")})

    def _sizes(self, inputs: int) -> tuple[int, tuple[int, ...], int]:
        """Inputs, hidden widths and outputs of π(s, g, c)."""
        return inputs, self.config.hidden, cloning.output_size(self.units.size, self.config.loss)

    def _use(self, arrays: dict[str, NDArray]) -> PCBC:
        self._arrays = arrays
        self._eyes = eyes = Eyes.from_arrays(self.task, self.config.frame, arrays)
        first, *rest = layers_of(arrays, "policy")
        mean, scale = (
            np.concatenate([getattr(part, name) for part in (eyes.robot, eyes.reading)])
            for name in ("mean", "scale")
        )
        # It acts in the units of inputs and actions, which saves their conversion at every step.
        self._policy = Forward([standardised(first, mean, scale), *rest[:-1], self.units.answering(rest[-1])])
        return self

    def predict(
        self,
        observation: dict[str, NDArray],
        state: State = None,
        episode_start: NDArray[np.bool_] | None = None,
        deterministic: bool = False,
    ) -> tuple[NDArray[np.float32], State]:
        """Actions (B, A) for a batch of observations, or (A,) for one; nothing is drawn."""
        if not self._arrays:
            raise cloning.untrained(self.name)
        rows, single = checked_batch(self.task, observation)
        action = self.units.clip(self._policy(*self._eyes.inputs(rows)))
        return (action[0] if single else action), None

    def save(self, path: str | os.PathLike[str]) -> None:
        """Store the agent; :func:`rise_agents.load_agent` reads it."""
        cloning.save(path, self, self._arrays)

    @classmethod
    def from_checkpoint(cls, arrays: dict[str, NDArray], description: dict[str, Any], device: str) -> PCBC:
        """The agent that :meth:`save` stored; ``ValueError`` if the arrays are not those of its config."""
        agent = cls(description["env"], description["config"], description["seed"], device)
        sizes = agent._sizes(sum(cloning.input_widths(agent)))
        cloning.check_arrays(agent, arrays, shapes.mlp("policy", *sizes))
        return agent._use(arrays)


class NoisyReadings:
    """What a policy sees of demonstrations whose readings carry fresh noise, drawn anew in every update.

    The noise enters the reading itself, in the world, and the frame is computed from what was read: as in the
    environment, whatever the frame makes of it.

    Args:
        lesson: the demonstrations, how they are seen, and the generator to draw from.
        level: of the noise, in units of the task's ``noise_scale``.
        copies: M.
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

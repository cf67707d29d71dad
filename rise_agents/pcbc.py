"""PC-BC: behaviour cloning conditioned on the reading itself (Ding et al., 2020; the paper's first baseline).

By default the same inputs, data, network, loss and updates of the policy as RISE, without the encoder: a = π(s, g, c).
The settings that a search finds for both can differ; row ``pcbc-as-rise`` of the benchmark has those of RISE.

As a control it can learn on readings with noise of its own, as many noisy copies of each as RISE draws samples of
its latent: what is left between both is then what the encoder adds to training on noise.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from rise_agents import clone, cloning, shapes
from rise_agents.agent import Progress, State, make_config, require, silent
from rise_agents.clone import Clone
from rise_agents.cloning import ActionUnits, CloningConfig
from rise_agents.files import StrPath
from rise_agents.readings import checked_batch
from rise_agents.resume import Resume
from rise_agents.search import EVERYWHERE, Space
from rise_agents.workers import one_thread


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
    BRIEF: ClassVar[dict[str, Any]] = {"updates": 300, "batch_size": 64}
    SEARCH: ClassVar[dict[str, Space]] = {EVERYWHERE: cloning.SEARCH}
    learns_from = "demonstrations"
    evaluate_deterministic = True

    def __init__(self, env_id: str, config: dict[str, Any], seed: int = 0, device: str = "cpu") -> None:
        self.env_id, self.seed, self.device = env_id, seed, device
        self.config = make_config(type(self), env_id, config)
        self.task, self.units = cloning.make_task(env_id), ActionUnits.of(env_id)
        self._arrays: dict[str, NDArray] = {}

    @one_thread()
    def learn(self, source: Any, progress: Progress = silent, resume: Resume | StrPath | None = None) -> PCBC:
        """Clone :class:`rise_agents.demonstrations.Demonstrations`; see :class:`rise_agents.agent.Agent`."""
        c = self.config
        lesson = cloning.begin(self, source, progress, resume)
        return self._use(clone.train(lesson, c, lesson.progress, c.train_noise, c.n_samples))

    def _use(self, arrays: dict[str, NDArray]) -> PCBC:
        self._arrays = arrays
        self._clone = Clone(self.task, self.config.frame, self.units, arrays)
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
        action = self._clone(rows)
        return (action[0] if single else action), None

    def save(self, path: str | os.PathLike[str]) -> None:
        """Store the agent; :func:`rise_agents.load_agent` reads it."""
        cloning.save(path, self, self._arrays)

    @classmethod
    def from_checkpoint(cls, arrays: dict[str, NDArray], description: dict[str, Any], device: str) -> PCBC:
        """The agent that :meth:`save` stored; ``ValueError`` if the arrays are not those of its config."""
        agent = cls(description["env"], description["config"], description["seed"], device)
        sizes = clone.sizes(agent.config, sum(cloning.input_widths(agent)), agent.units.size)
        cloning.check_arrays(agent, arrays, shapes.mlp("policy", *sizes))
        return agent._use(arrays)

"""PC-BC: behaviour cloning conditioned on the reading itself (Ding et al., 2020; the paper's first baseline).

The same inputs, data, network, loss and budget as RISE, without the encoder: a = π(s, g, c).
"""

from __future__ import annotations

import os
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from rise_agents import cloning, shapes
from rise_agents.agent import Progress, State, make_config, silent
from rise_agents.cloning import ActionUnits, CloningConfig, Eyes
from rise_agents.files import StrPath
from rise_agents.forward import Forward, layers_of, standardised
from rise_agents.readings import checked_batch
from rise_agents.resume import Resume
from rise_agents.search import EVERYWHERE, Space

if TYPE_CHECKING:
    from torch import Tensor, nn

Config = CloningConfig


class PCBC:
    """Parameter-conditioned behaviour cloning.

    Args:
        env_id: a registered environment with a task description.
        config: settings that differ from :class:`rise_agents.cloning.CloningConfig`.
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
        seen = torch.cat((data.robot, data.reading), -1)
        policy = mlp(*self._sizes(seen.shape[1])).to(self.device)
        fit(
            lesson.stages["policy"],
            policy,
            lambda seen, action: policy_loss(policy, seen, action, c.loss),
            (seen, data.action),
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


def policy_loss(policy: nn.Module, seen: Tensor, action: Tensor, kind: str) -> dict[str, Tensor]:
    """The imitation loss of actions (B, A) at robot and reading inputs (B, R + C)."""
    return {"loss": cloning.imitation_loss(policy(seen), action, kind)}

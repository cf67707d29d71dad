"""A noise model of your own: errors that fade as slowly as you say (a Gauss-Markov process).

python -m benchmarks.run --import docs/examples/coloured.py --noise-model step coloured:0.95 --agents rise pcbc
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from rise_envs import NoiseModel, register_noise, streams
from rise_envs.noise_models import require


@dataclass(frozen=True)
class Coloured(NoiseModel):
    """Gaussian errors of constant size, each correlated with the one before.

    Attributes:
        memory: correlation of two errors that follow each other, in [0, 1).
        deviation: of every error, in units of the channel's scale.
    """

    memory: float = 0.9
    deviation: float = 1.0

    def __post_init__(self) -> None:
        require("coloured: memory", self.memory, 0.0, 1.0)
        require("coloured: deviation", self.deviation)

    def at(self, level: float) -> NoiseModel:
        """The deviation times ``level``; at level 0 it must be the identity."""
        return replace(self, deviation=self.deviation * level)

    def reset(self, keys: Any, channels: int, ahead: int = 1) -> Any:
        """The key of each of B episodes, and its first errors (B, C)."""
        return keys, streams.normal(keys[:, None], np.arange(channels))

    def __call__(self, reading: Any, scale: Any, step: Any, state: Any) -> tuple[Any, Any]:
        """Noisy readings (B, C), and the state for the next step. Draws are functions of key and step."""
        keys, error = state
        channels = error.shape[1]
        fresh = streams.normal(keys[:, None], step[:, None] * channels + np.arange(channels))
        moved = self.memory * error + np.sqrt(1 - self.memory**2) * fresh
        error = np.where(step[:, None] == 0, error, moved)
        return reading + self.deviation * scale * error, (keys, error)


register_noise("coloured", Coloured)

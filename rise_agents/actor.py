"""A trained stable-baselines3 policy in plain NumPy: what acting needs, and nothing else, per call.

Shapes: B batch, K network inputs, A action dimensions or number of discrete actions.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rise_agents.readings import Standardiser
from rise_agents.vec_env import rescale
from rise_envs import streams


class Actor:
    """A policy of SB3: tanh layers, then mean actions in [−1, 1] with one σ each, or logits.

    Computed in float64: whatever batch a row is part of, it comes out the same but for the last digits.

    Args:
        arrays: the policy's weights by SB3's names after ``policy.``, the units of the inputs (``units``),
            and for boxes the bounds of the actions (``action.low``, ``action.high``).
    """

    def __init__(self, arrays: dict[str, NDArray]) -> None:
        self.units = Standardiser.from_arrays(arrays, "units")
        depth = sum(name.startswith("policy.mlp_extractor.policy_net.") for name in arrays) // 2
        names = [f"policy.mlp_extractor.policy_net.{2 * i}" for i in range(depth)] + ["policy.action_net"]
        self.layers = [
            (arrays[f"{name}.weight"].T.astype(np.float64), arrays[f"{name}.bias"].astype(np.float64))
            for name in names
        ]
        self.discrete = "action.low" not in arrays
        if not self.discrete:
            self.bounds = arrays["action.low"], arrays["action.high"]
            self.sigma = np.exp(arrays["policy.log_std"].astype(np.float64))

    def output(self, inputs: NDArray[np.float64]) -> NDArray[np.float64]:
        """Mean actions in units of the bounds, or logits, (B, A), for inputs (B, K).

        Raises:
            ValueError: inputs of another width than those of training.
        """
        if inputs.shape[-1] != len(self.units.mean):
            raise ValueError(
                f"the policy reads {len(self.units.mean)} numbers, got {inputs.shape[-1]} an observation"
            )
        x: NDArray = self.units(inputs).astype(np.float64)
        for weight, bias in self.layers[:-1]:
            x = np.tanh(x @ weight + bias)
        weight, bias = self.layers[-1]
        return x @ weight + bias

    def explore(
        self, output: NDArray[np.float64], keys: NDArray[np.uint64], counter: NDArray[np.uint64]
    ) -> NDArray[np.float64]:
        """``output`` (B, A) with draw number ``counter`` (B,) of the streams ``keys`` (B,) added.

        Gaussian noise for boxes; Gumbel noise for logits, whose largest sum is a draw from their softmax.
        """
        size = output.shape[-1]
        place = counter[:, None] * np.uint64(size) + np.arange(size, dtype=np.uint64)
        if self.discrete:
            return output - np.log(-np.log1p(-streams.uniform(keys[:, None], place)))
        return output + self.sigma * streams.normal(keys[:, None], place)

    def action(self, output: NDArray[np.float64]) -> NDArray:
        """Actions (B, …) that the environment takes."""
        return output.argmax(-1) if self.discrete else rescale(output, *self.bounds)

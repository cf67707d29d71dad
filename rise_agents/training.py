"""The one training loop, and the NumPy form in which a trained network acts."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

# Maps a batch, (B, …) each, to named terms, of which ``loss`` is minimised.
Loss = Callable[..., dict[str, Tensor]]


def fit(
    parameters: Iterable[nn.Parameter],
    loss: Loss,
    data: Sequence[Tensor],
    *,
    updates: int,
    batch_size: int,
    learning_rate: float,
    generator: torch.Generator,
    progress: Callable[[float, dict[str, float]], None],
) -> None:
    """Adam with a cosine schedule to zero over shuffled passes through the data.

    Args:
        parameters: what is trained.
        loss: called as ``loss(*rows)`` with a batch of each of ``data``.
        data: tensors (T, …) of the same length, on the device of ``generator``.
        updates: gradient steps.
        batch_size: B (at most T).
        learning_rate: at the start.
        generator: draws the order of the rows.
        progress: told the share done and the terms, about a hundred times.
    """
    optimiser = torch.optim.Adam(parameters, lr=learning_rate, fused=True)
    total = len(data[0])
    batch_size = min(batch_size, total)
    per_pass = total // batch_size
    every = max(1, updates // 100)
    for update in range(updates):
        start = (update % per_pass) * batch_size
        if start == 0:  # rows are gathered once a pass, so that batches are views
            order = torch.randperm(total, generator=generator, device=generator.device)
            shuffled = [part[order] for part in data]
        for group in optimiser.param_groups:
            group["lr"] = 0.5 * learning_rate * (1 + math.cos(math.pi * update / updates))
        terms = loss(*(part[start : start + batch_size] for part in shuffled))
        optimiser.zero_grad(set_to_none=True)
        terms["loss"].backward()
        optimiser.step()
        if (update + 1) % every == 0 or update + 1 == updates:
            progress((update + 1) / updates, {name: float(term.detach()) for name, term in terms.items()})


def to_arrays(module: nn.Module, name: str) -> dict[str, NDArray[np.float32]]:
    """The weights of ``module`` as arrays, under ``name``."""
    return {
        f"{name}.{key}": value.detach().cpu().numpy().copy() for key, value in module.state_dict().items()
    }


class Forward:
    """A trained multilayer perceptron in plain NumPy: no graph, no module, a few microseconds a call."""

    def __init__(self, arrays: dict[str, NDArray], name: str) -> None:
        layers = sorted(
            {
                int(key.split(".")[-2])
                for key in arrays
                if key.startswith(f"{name}.") and key.endswith("weight")
            }
        )
        # Transposed once, in the layout that a row vector times a matrix reads in order.
        self.layers = [
            (np.ascontiguousarray(arrays[f"{name}.{i}.weight"].T), arrays[f"{name}.{i}.bias"]) for i in layers
        ]

    def __call__(self, x: NDArray[np.float32]) -> NDArray[np.float32]:
        """(B, inputs) to (B, outputs), ReLU between the layers."""
        last = len(self.layers) - 1
        for depth, (weight, bias) in enumerate(self.layers):
            x = np.dot(x, weight)
            x += bias
            if depth < last:
                np.maximum(x, 0.0, out=x)
        return x

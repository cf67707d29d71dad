"""The one training loop, and the NumPy form in which a trained network acts."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from rise_agents.stages import Stage

# Maps a batch, (B, …) each, to named terms, of which ``loss`` is minimised.
Loss = Callable[..., dict[str, Tensor]]
_ZERO = np.float32(0)


def fit(
    stage: Stage,
    module: nn.Module,
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
        stage: where this training may have been interrupted, and keeps its state.
        module: what is trained.
        loss: called as ``loss(*rows)`` with a batch of each of ``data``.
        data: tensors (T, …) of the same length, on the device of ``generator``.
        updates: gradient steps.
        batch_size: B (at most T).
        learning_rate: at the start.
        generator: draws the order of the rows.
        progress: told the share done and the terms, about a hundred times.
    """
    optimiser = torch.optim.Adam(module.parameters(), lr=learning_rate, fused=True)
    total = len(data[0])
    batch_size = min(batch_size, total)
    per_pass = total // batch_size
    every = max(1, updates // 100)
    begun, epoch = stage.restore(module, optimiser, generator, updates)
    for update in range(begun, updates):
        start = (update % per_pass) * batch_size
        if start == 0 or update == begun:  # rows are gathered once a pass, so that batches are views
            epoch = generator.get_state() if start == 0 else epoch
            order = _order(total, generator if start == 0 else _at(epoch, generator))
            shuffled = [part.index_select(0, order) for part in data]
        for group in optimiser.param_groups:
            group["lr"] = 0.5 * learning_rate * (1 + math.cos(math.pi * update / updates))
        terms = loss(*(part[start : start + batch_size] for part in shuffled))
        optimiser.zero_grad(set_to_none=True)
        terms["loss"].backward()
        optimiser.step()
        if (update + 1) % every == 0 or update + 1 == updates:
            progress((update + 1) / updates, {name: float(term.detach()) for name, term in terms.items()})
        if stage.due() and update + 1 < updates:
            stage.keep(update + 1, module, optimiser, generator, epoch)
    if begun < updates:
        stage.keep(updates, module, None, generator, epoch)


def _order(rows: int, generator: torch.Generator) -> Tensor:
    return torch.randperm(rows, generator=generator, device=generator.device)


def _at(state: Tensor, like: torch.Generator) -> torch.Generator:
    generator = torch.Generator(device=like.device)
    generator.set_state(state)
    return generator


Layer = tuple[NDArray[np.float64], NDArray[np.float64]]  # weights (inputs, outputs) and bias (outputs,)


def layers_of(arrays: dict[str, NDArray], name: str) -> list[Layer]:
    """The fully connected layers that :func:`rise_agents.stages.to_arrays` stored under ``name``, first to last."""
    own = [key.removeprefix(f"{name}.") for key in arrays if key.startswith(f"{name}.")]
    numbers = sorted({int(key.split(".")[0]) for key in own if re.fullmatch(r"\d+\.weight", key)})
    stored = [(arrays[f"{name}.{i}.weight"].T, arrays[f"{name}.{i}.bias"]) for i in numbers]
    return [(weight.astype(np.float64), bias.astype(np.float64)) for weight, bias in stored]


def standardised(layer: Layer, mean: NDArray, scale: NDArray) -> Layer:
    """``layer`` such that it takes x instead of (x − mean) / scale."""
    weight, bias = layer
    weight = weight / scale[:, None]
    return weight, bias - mean @ weight


def rescaled(layer: Layer, scale: NDArray, shift: NDArray) -> Layer:
    """``layer`` such that it gives scale · y + shift instead of y; of outputs beyond those of ``scale``, none."""
    weight, bias = (part[..., : len(scale)] * scale for part in layer)
    return weight, bias + shift


class Forward:
    """A trained multilayer perceptron in plain NumPy: no graph, no module, a few microseconds a call.

    A bias is a row of its layer's matrix that meets a constant 1. Hidden layers hand this 1 on (ReLU leaves it as
    it is), so that a layer costs two calls: on a single observation it is calls that take the time.
    """

    def __init__(self, layers: Sequence[Layer]) -> None:
        matrices = [np.vstack(layer).astype(np.float32) for layer in layers]
        for depth, matrix in enumerate(matrices[:-1]):
            one = np.zeros((len(matrix), 1), np.float32)
            one[-1] = 1.0
            matrices[depth] = np.hstack((matrix, one))
        self.hidden, self.last = matrices[:-1], matrices[-1]

    def __call__(self, *parts: NDArray) -> NDArray[np.float32]:
        """The parts of the inputs, (B, ·) each, to outputs (B, ·); ReLU between the layers."""
        x = np.concatenate((*parts, np.ones((len(parts[0]), 1))), -1, dtype=np.float32, casting="same_kind")
        for matrix in self.hidden:
            x = np.dot(x, matrix)
            np.maximum(x, _ZERO, out=x)
        return np.dot(x, self.last)

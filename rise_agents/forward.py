"""The NumPy form in which a trained network acts: a process that only acts never pays for importing torch."""

from __future__ import annotations

import re
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

# σ stays in [e⁻⁷, e³]: wide enough for any unit, finite in float32 whatever the reading.
LOG_SIGMA_RANGE = (-7.0, 3.0)
_ZERO = np.float32(0)

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

    def layers(self) -> list[tuple[NDArray[np.float32], NDArray[np.float32]]]:
        """Weights (inputs, outputs) and bias (outputs,) of each layer, as it acts."""
        plain = [*(matrix[:, :-1] for matrix in self.hidden), self.last]
        return [(matrix[:-1], matrix[-1]) for matrix in plain]

    def __call__(self, *parts: NDArray) -> NDArray[np.float32]:
        """The parts of the inputs, (B, ·) each, to outputs (B, ·); ReLU between the layers."""
        x = np.concatenate((*parts, np.ones((len(parts[0]), 1))), -1, dtype=np.float32, casting="same_kind")
        for matrix in self.hidden:
            x = np.dot(x, matrix)
            np.maximum(x, _ZERO, out=x)
        return np.dot(x, self.last)

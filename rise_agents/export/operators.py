"""What NumPy's functions are in ONNX, for arrays that are traced: see :mod:`.trace`.

Angles are computed in float32, since runtimes know ``Atan`` in no other type; its argument is computed in full before,
such that nothing is lost where an arcsin is vertical or an arctan2 changes sign.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from rise_agents.export.trace import Graph, NotExportable, Traced


def _operands(graph: Graph, kind: Any, inputs: Sequence[Any]) -> list[str]:
    """Names of arrays and numbers, all in one kind of number."""
    return [x.astype(kind).name if isinstance(x, Traced) else graph.constant(x, kind) for x in inputs]


def _values(inputs: Sequence[Any]) -> list[Any]:
    return [x.value if isinstance(x, Traced) else x for x in inputs]


def _elementwise(kind: str, ufunc: Any, compares: bool = False) -> Callable[..., Traced]:
    def record(graph: Graph, *inputs: Any) -> Traced:
        values = _values(inputs)
        example = ufunc(*values)
        common = np.result_type(*values) if compares else example.dtype
        return graph.node(kind, _operands(graph, common, inputs), example)

    return record


def _matmul(graph: Graph, a: Any, b: Any) -> Traced:
    if isinstance(a, Traced) and not isinstance(b, Traced) and (b == np.eye(np.shape(b)[-1])).all():
        return a  # turned by nothing
    example = np.matmul(*_values((a, b)))
    return graph.node("MatMul", _operands(graph, example.dtype, (a, b)), example)


def _power(graph: Graph, base: Any, exponent: Any) -> Traced:
    if not isinstance(exponent, int) or exponent != 2:
        raise NotExportable(f"the power {exponent} has no form in ONNX here")
    return base * base


def _arctan(x: Any) -> Traced:
    """Runtimes know it in float32 only; its argument is computed before, in full."""
    narrow = x.astype(np.float32)
    return narrow.graph.node("Atan", [narrow.name], np.arctan(narrow.value)).astype(np.float64)


def _arctan2(graph: Graph, y: Any, x: Any) -> Any:
    length = np.hypot(x, y)
    return 2.0 * _arctan(np.where(x < 0, (length - x) / y, y / np.maximum(length + x, 1e-300)))


def _reduced(kind: str, function: Any) -> Callable[..., Traced]:
    def record(graph: Graph, x: Traced, axis: int, keepdims: bool = False) -> Traced:
        example = function(x.value, axis=axis, keepdims=keepdims)
        names = [x.name, graph.constant([axis], np.int64)]
        return graph.node(kind, names, example, keepdims=int(keepdims))

    return record


def _concatenate(graph: Graph, parts: Sequence[Any], axis: int = 0) -> Traced:
    example = np.concatenate(_values(parts), axis)
    return graph.node("Concat", _operands(graph, example.dtype, parts), example, axis=axis)


def _stack(graph: Graph, parts: Sequence[Traced], axis: int) -> Any:
    return np.concatenate([np.expand_dims(part, axis) for part in parts], axis)  # type: ignore[arg-type]


def _expand_dims(graph: Graph, x: Traced, axis: int) -> Traced:
    return graph.node("Unsqueeze", [x.name, graph.constant([axis], np.int64)], np.expand_dims(x.value, axis))


def _repeat(graph: Graph, x: Traced, repeats: int, axis: int | None = None) -> Traced:
    if repeats != 1:
        raise NotExportable("more obstacles than one have no form in ONNX here")
    return x


def _where(graph: Graph, condition: Traced, a: Any, b: Any) -> Traced:
    example = np.where(*_values((condition, a, b)))
    return graph.node("Where", [condition.name, *_operands(graph, example.dtype, (a, b))], example)


def _clip(graph: Graph, x: Traced, low: Any, high: Any) -> Any:
    return np.minimum(np.maximum(x, low), high)


def _norm(graph: Graph, x: Traced, axis: int, keepdims: bool = False) -> Traced:
    return _reduced("ReduceL2", np.linalg.norm)(graph, x, axis, keepdims)


UFUNCS: dict[Any, Callable[..., Traced]] = {
    **{
        getattr(np, name): _elementwise(kind, getattr(np, name))
        for name, kind in {
            **{"add": "Add", "subtract": "Sub", "multiply": "Mul", "divide": "Div", "negative": "Neg"},
            **{"absolute": "Abs", "sqrt": "Sqrt", "exp": "Exp", "log": "Log", "sin": "Sin", "cos": "Cos"},
            **{"maximum": "Max", "minimum": "Min", "sign": "Sign", "tanh": "Tanh"},
            "logical_or": "Or",
        }.items()
    },
    **{
        getattr(np, name): _elementwise(kind, getattr(np, name), compares=True)
        for name, kind in {"greater": "Greater", "less": "Less", "equal": "Equal"}.items()
    },
    np.matmul: _matmul,
    np.power: _power,
    np.log1p: lambda graph, x: np.log(1.0 + x),
    np.hypot: lambda graph, x, y: np.sqrt(x * x + y * y),
    np.arcsin: lambda graph, x: _arctan(x / np.sqrt((1.0 - x) * (1.0 + x))),
    np.arctan2: _arctan2,
}
FUNCTIONS: dict[Any, Callable[..., Any]] = {
    np.concatenate: _concatenate,
    np.stack: _stack,
    np.expand_dims: _expand_dims,
    np.repeat: _repeat,
    np.where: _where,
    np.clip: _clip,
    np.linalg.norm: _norm,
    np.sum: _reduced("ReduceSum", np.sum),
    np.max: _reduced("ReduceMax", np.max),
    np.mean: _reduced("ReduceMean", np.mean),
    np.ones_like: lambda graph, x: 0.0 * x + 1.0,
    np.zeros_like: lambda graph, x: 0.0 * x,
}

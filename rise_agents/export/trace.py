"""NumPy code recorded as an ONNX graph: what exports an agent is the code that it acts by, not a second form of it.

A :class:`Traced` array stands for a part of an observation, or for what was computed from one. It answers NumPy's
functions and operators by writing them down, and carries an example (a batch of ``BATCH`` rows) from which shapes and
types follow. Code that looks at values (``if (x > 0).any()``) or uses a function without a counterpart is refused.

Shapes: a dimension of ``BATCH`` rows, or a multiple, is the batch, of any size in the graph.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.lib.mixins import NDArrayOperatorsMixin
from numpy.typing import DTypeLike, NDArray

from rise_agents.forward import Layer

BATCH = 97  # a prime that is no width: it can be told from all other dimensions
OPSET, IR_VERSION = 18, 9  # of 2023: what older runtimes read, too


class NotExportable(ValueError):
    """Something that has no form in ONNX; the message says what."""


class Graph:
    """The nodes, constants, inputs and outputs recorded so far."""

    def __init__(self) -> None:
        self.nodes: list[Any] = []
        self.inputs: dict[str, NDArray] = {}  # an example of each
        self.outputs: dict[str, NDArray] = {}
        self._constants: dict[tuple[Any, ...], str] = {}
        self._initializers: list[Any] = []

    def input(self, name: str, shape: Sequence[int], dtype: DTypeLike = np.float64) -> Traced:
        """A new input, (batch, …) with the given shape."""
        self.inputs[name] = np.random.default_rng(0).uniform(0.1, 1.0, (BATCH, *shape)).astype(dtype)
        return Traced(self, name, self.inputs[name])

    def constant(self, value: Any, dtype: DTypeLike | None = None) -> str:
        """The name of a constant, each of which is stored once."""
        from onnx import numpy_helper

        array = np.array(value, dtype, order="C")
        key = array.dtype.str, array.shape, array.tobytes()
        if key not in self._constants:
            self._constants[key] = f"c{len(self._constants)}"
            self._initializers.append(numpy_helper.from_array(array, self._constants[key]))
        return self._constants[key]

    def node(self, kind: str, inputs: Sequence[str], example: NDArray, **attributes: Any) -> Traced:
        """Record an operator; ``example`` is what it gives for the examples of its inputs."""
        from onnx import helper

        name = f"v{len(self.nodes)}"
        self.nodes.append(helper.make_node(kind, list(inputs), [name], **attributes))
        return Traced(self, name, example)

    def output(self, name: str, array: Traced) -> None:
        """Make ``array`` an output."""
        self.node("Identity", [array.name], array.value)
        self.nodes[-1].output[0] = name
        self.outputs[name] = array.value

    def network(self, layers: Sequence[Layer], activation: str, *parts: Any) -> Traced:
        """Fully connected ``layers`` over the concatenated ``parts``, in the precision of the weights."""
        kind = layers[0][0].dtype
        inputs = [part.astype(kind) for part in parts]
        x: Any = np.concatenate(inputs, -1) if len(inputs) > 1 else inputs[0]
        for depth, (weight, bias) in enumerate(layers):
            example = np.zeros((len(x), len(bias)), kind)
            x = self.node("Gemm", [x.name, self.constant(weight), self.constant(bias)], example)
            if depth + 1 < len(layers):
                x = self.node(activation, [x.name], example)
        return x

    def serialised(self, metadata: dict[str, str], about: str) -> bytes:
        """The file: a checked ONNX model with texts attached."""
        import onnx
        from onnx import helper

        def declared(arrays: dict[str, NDArray]) -> list[Any]:
            return [
                helper.make_tensor_value_info(
                    name, helper.np_dtype_to_tensor_dtype(a.dtype), ["batch", *a.shape[1:]]
                )
                for name, a in arrays.items()
            ]

        graph = helper.make_graph(
            self.nodes, "agent", declared(self.inputs), declared(self.outputs), self._initializers
        )
        opsets = [helper.make_opsetid("", OPSET)]
        model = helper.make_model(
            graph, opset_imports=opsets, ir_version=IR_VERSION, producer_name="rise-suite", doc_string=about
        )
        helper.set_model_props(model, metadata)
        onnx.checker.check_model(model, full_check=True)
        return model.SerializeToString(deterministic=True)


class Traced(NDArrayOperatorsMixin):
    """An array of the graph: a name in it, and an example."""

    def __init__(self, graph: Graph, name: str, value: NDArray) -> None:
        self.graph, self.name, self.value = graph, name, value

    @property
    def shape(self) -> tuple[int, ...]:
        """Of the example."""
        return self.value.shape

    @property
    def ndim(self) -> int:
        """Number of dimensions."""
        return self.value.ndim

    @property
    def dtype(self) -> np.dtype:
        """Kind of number."""
        return self.value.dtype

    def __len__(self) -> int:
        return len(self.value)

    def __bool__(self) -> bool:
        raise NotExportable("code that decides by values has no form in ONNX")

    def __array__(self, *args: Any, **kwargs: Any) -> NDArray:
        raise NotExportable("code that writes into arrays of NumPy's has no form in ONNX")

    def __array_namespace__(self, **_: Any) -> Any:
        return np  # whose functions come back to this class

    def __array_ufunc__(self, ufunc: Any, method: str, *inputs: Any, out: Any = None, **kwargs: Any) -> Any:
        from rise_agents.export.operators import UFUNCS  # which knows this class

        recorded = UFUNCS.get(ufunc)
        if method != "__call__" or recorded is None or kwargs:
            raise NotExportable(f"np.{ufunc.__name__} has no form in ONNX here")
        with np.errstate(all="ignore"):
            result = recorded(self.graph, *inputs)
        if out is None:
            return result
        (target,) = out  # of x += y
        target.name, target.value = result.name, result.value
        return target

    def __array_function__(self, function: Any, types: Any, args: Any, kwargs: Any) -> Any:
        from rise_agents.export.operators import FUNCTIONS  # which knows this class

        if function not in FUNCTIONS:
            raise NotExportable(f"np.{function.__name__} has no form in ONNX here")
        return FUNCTIONS[function](self.graph, *args, **kwargs)

    def __getitem__(self, key: Any) -> Traced:
        cuts, columns, new = _parsed(key, self.ndim)
        x = self
        if cuts:
            starts, ends = ([cut[i] for cut in cuts.values()] for i in (0, 1))
            names = [self.graph.constant(v, np.int64) for v in (starts, ends, list(cuts))]
            example = x.value[tuple(slice(*cuts.get(i, (None, None))) for i in range(x.ndim))]
            x = self.graph.node("Slice", [x.name, *names], example)
        for axis, which in sorted(columns.items(), reverse=True):
            example = np.take(x.value, which, axis)
            x = self.graph.node("Gather", [x.name, self.graph.constant(which, np.int64)], example, axis=axis)
        if new:
            x = self.graph.node(
                "Unsqueeze", [x.name, self.graph.constant(new, np.int64)], np.expand_dims(x.value, new)
            )
        return Traced(self.graph, x.name, x.value)

    def __setitem__(self, key: Any, part: Any) -> None:
        """Let some columns be others: the array becomes another one, that is put together."""
        cuts, columns, _ = _parsed(key, self.ndim)
        if columns:
            ((axis, start),) = columns.items()
            part, stop = np.expand_dims(part, axis), start % self.shape[axis] + 1
        else:
            ((axis, (start, stop)),) = cuts.items()
        start, stop, _step = slice(start, stop).indices(self.shape[axis])
        before: list[Any] = [slice(None)] * self.ndim
        after = before.copy()
        before[axis], after[axis] = slice(0, start), slice(stop, self.shape[axis])
        pieces = [self[tuple(before)]] if start else []
        pieces += [part, *([self[tuple(after)]] if stop < self.shape[axis] else [])]
        whole: Any = np.concatenate(pieces, axis) if len(pieces) > 1 else part
        if whole.shape != self.shape:
            raise NotExportable(f"{self.shape} cannot become {whole.shape} in place")
        self.name, self.value = whole.name, whole.value

    def astype(self, dtype: DTypeLike, **_: Any) -> Traced:
        """In another kind of number."""
        from onnx import helper

        if self.dtype == np.dtype(dtype):
            return self
        kind = helper.np_dtype_to_tensor_dtype(np.dtype(dtype))
        return self.graph.node("Cast", [self.name], self.value.astype(dtype), to=kind)

    def reshape(self, *shape: Any) -> Traced:
        """In another shape."""
        example = self.value.reshape(*shape)
        sizes = [-1 if size % BATCH == 0 else size for size in example.shape]
        return self.graph.node("Reshape", [self.name, self.graph.constant(sizes, np.int64)], example)

    def swapaxes(self, first: int, second: int) -> Traced:
        """With two axes exchanged."""
        order = np.arange(self.ndim)
        order[[first, second]] = order[[second, first]]
        return self.graph.node(
            "Transpose", [self.name], self.value.swapaxes(first, second), perm=order.tolist()
        )

    def copy(self) -> Traced:
        """The same, to be changed on its own."""
        return Traced(self.graph, self.name, self.value)

    def sum(self, axis: int, keepdims: bool = False) -> Traced:
        """Sum over an axis."""
        return np.sum(self, axis=axis, keepdims=keepdims)  # type: ignore[call-overload]

    def mean(self, axis: int, keepdims: bool = False) -> Traced:
        """Mean over an axis."""
        return np.mean(self, axis=axis, keepdims=keepdims)  # type: ignore[call-overload]


def _parsed(key: Any, ndim: int) -> tuple[dict[int, Any], dict[int, Any], list[int]]:
    """An index as slices by axis, columns by axis, and places of new axes."""
    keys = list(key) if isinstance(key, tuple) else [key]
    given = sum(k is not None and k is not Ellipsis for k in keys)
    fill = [slice(None)] * (ndim - given)
    keys = [part for k in keys for part in (fill if k is Ellipsis else [k])]
    cuts: dict[int, Any] = {}
    columns: dict[int, Any] = {}
    new: list[int] = []
    axis = place = 0
    for k in keys:
        if k is None:
            new.append(place)
        elif isinstance(k, slice) and k.step is None:
            if k != slice(None):
                cuts[axis] = (k.start or 0, 2**31 if k.stop is None else k.stop)
        elif isinstance(k, int | list):
            columns[axis] = k
        else:
            raise NotExportable(f"the index {k!r} has no form in ONNX here")
        place += not isinstance(k, int)
        axis += k is not None
    return cuts, columns, new

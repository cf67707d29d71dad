"""Where the batched vehicles are computed, and whose arrays are handed out."""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from rise_envs.actions import finite_action

BACKENDS = ("numpy", "torch")


@dataclass(frozen=True)
class Backend:
    """A way to compute.

    Attributes:
        dynamics: the module whose ``advance`` and ``begin`` move the vehicles.
        own: makes the arrays that they run on out of NumPy's.
        give: makes what is handed out of the arrays that they run on.
        action: checks an action and makes an array to run on of it: (action, shape) -> (B, 2).
        chosen: what `choose` was asked for: a copy is chosen anew, as modules cannot be copied.
        threads: that share the work.
    """

    dynamics: Any
    own: Callable[[Any], Any]
    give: Callable[[Any], Any]
    action: Callable[[Any, tuple[int, ...]], Any]
    chosen: tuple[str, str, bool | None]
    threads: int = 1

    def __reduce__(self) -> Any:
        return choose, self.chosen


def choose(backend: str, device: str, compiled: bool | None) -> Backend:
    """The backend of these names; ``compiled`` is the default where it can be had, on the CPU.

    Raises:
        ValueError: an unknown backend or device, or compiled dynamics elsewhere than on the CPU.
    """
    if backend not in BACKENDS:
        raise ValueError(f"backend must be one of {BACKENDS}, got {backend!r}")
    on_cpu = str(device) == "cpu"
    if backend == "numpy" and not on_cpu:
        raise ValueError(f"backend 'numpy' runs on the CPU, not on device {device!r}: take backend='torch'")
    if compiled and not on_cpu:
        raise ValueError(f"compiled=True runs on the CPU, not on device {device!r}")
    compiled = on_cpu if compiled is None else compiled
    if compiled:
        from rise_envs import vehicle_compiled as dynamics  # numba is loaded by those who need it only
    else:
        from rise_envs import vehicle_arrays as dynamics  # type: ignore[no-redef]
    if backend == "numpy":
        return Backend(dynamics, _same, _same, finite_action, (backend, device, compiled))
    return _with_torch(dynamics, device, compiled)


def _same(array: Any) -> Any:
    return array


def _with_torch(dynamics: Any, device: str, compiled: bool) -> Backend:
    import torch

    try:
        place = torch.device(device)
        torch.zeros(1, device=place, dtype=torch.float64)
    except (
        RuntimeError,
        AssertionError,
        TypeError,
    ) as error:  # of an unknown one, without CUDA, without float64
        reason = str(error).splitlines()[0]
        raise ValueError(f"torch cannot use device {device!r}: {reason}") from None

    def on_host(values: Any, shape: tuple[int, ...]) -> Any:
        # NumPy's operations, as torch's wake all of its threads: on a busy machine these wait for each other.
        if isinstance(values, torch.Tensor):
            values = values.detach().cpu()
            values = (values.float() if values.dtype == torch.bfloat16 else values).numpy()
        return finite_action(values, shape)

    def on_device(values: Any, shape: tuple[int, ...]) -> Any:
        if not isinstance(values, torch.Tensor) or values.shape != shape or not _is_real(values):
            return torch.as_tensor(on_host(values, shape), device=place)
        if not bool(torch.isfinite(values).all()):
            where = torch.nonzero(~torch.isfinite(values))[0].tolist()
            raise ValueError(f"action must be finite, got {values[tuple(where)].item()} at index {where}")
        return values.detach().to(place, torch.float64)

    def _is_real(values: Any) -> bool:
        return not values.is_complex() and values.dtype != torch.bool

    chosen = "torch", device, compiled
    if compiled:  # tensors and arrays share their memory on the CPU
        return Backend(dynamics, _same, torch.from_numpy, on_host, chosen, torch.get_num_threads())
    return Backend(dynamics, functools.partial(torch.as_tensor, device=place), _same, on_device, chosen)

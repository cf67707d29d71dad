"""Which numbers of an observation are noised: from any Box or Dict observation to one flat row, and back."""

from __future__ import annotations

import copy
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from array_api_compat import array_namespace, is_torch_array
from gymnasium import spaces
from numpy.typing import ArrayLike

from rise_envs.noise_models import Array

Scale = float | ArrayLike | Mapping[str, float | ArrayLike]
Given = (
    Mapping[str, ArrayLike] | Mapping[str, Mapping[str, ArrayLike]]
)  # groups of channels, of a Dict by its keys

_FLOAT64 = np.dtype(np.float64)
_FLOATS = (np.float16, np.float32, np.float64)


@dataclass(frozen=True)
class Channels:
    """Which numbers of an observation are noised, and where they stand in one flat row of C channels.

    Attributes:
        keys: names in a Dict observation, in the order of the channels; ``None``: the observation is one Box.
        boxes: their spaces, in the same order.
        spans: the columns of each.
    """

    keys: tuple[str, ...] | None
    boxes: tuple[spaces.Box, ...]
    spans: tuple[slice, ...]

    @staticmethod
    def of(space: spaces.Space, keys: str | Sequence[str] | None) -> Channels:
        """The channels that ``keys`` name in ``space``.

        Raises:
            ValueError: no such key, no default, or not a Box of floats.
        """
        if isinstance(space, spaces.Dict):
            names = _names(space, keys)
            boxes = tuple(_float_box(space[name], f"observation {name!r}") for name in names)
        elif keys is None:
            names, boxes = None, (_float_box(space, "the observation space"),)
        else:
            raise ValueError(f"keys={keys!r} need a Dict observation space, this one is {space}")
        ends = np.cumsum([math.prod(box.shape) for box in boxes]).tolist()
        return Channels(names, boxes, tuple(map(slice, [0, *ends[:-1]], ends)))

    def noisy_space(self, space: spaces.Space) -> spaces.Space:
        """``space`` with the noised parts unbounded."""
        wide = [spaces.Box(-np.inf, np.inf, box.shape, box.dtype.type) for box in self.boxes]
        if self.keys is None or not isinstance(space, spaces.Dict):
            return wide[0]
        return spaces.Dict(list({**space.spaces, **dict(zip(self.keys, wide, strict=True))}.items()))

    def read(self, observation: Any, batch: tuple[int, ...] = ()) -> Array:
        """The channels of one observation or of a batch of shape ``batch``, (n, C), as an array of its own.

        Raises:
            ValueError: a noised part is missing, of another shape than its space, not of real numbers, or not
                finite: noise would hide it.
        """
        if not batch and self.keys is not None and len(self.keys) == 1 and isinstance(observation, dict):
            part = observation.get(self.keys[0])  # as most environments give it: a third of the time
            if type(part) is np.ndarray and part.dtype is _FLOAT64 and part.shape == self._shapes[0]:
                row = part.reshape(1, -1).copy()
                if np.vdot(row, row) < np.inf:
                    return row
        shapes = self._shapes if not batch else tuple(batch + shape for shape in self._shapes)
        parts, n = self._parts(observation, shapes), batch[0] if batch else 1
        if is_torch_array(parts[0]):
            xp = array_namespace(parts[0])
            rows = xp.concat([xp.astype(part, xp.float64).reshape(n, -1) for part in parts], axis=1)
            if not bool(xp.isfinite(rows).all()):
                self._name_what_is_not_finite(rows)
            return rows
        flat = [np.array(part, dtype=np.float64).reshape(n, -1) for part in parts]
        rows = flat[0] if len(flat) == 1 else np.concatenate(flat, axis=1)
        # A sum of squares is finite only if every number is, and takes a third of the time to find out.
        if not np.vdot(rows, rows) < np.inf and not np.isfinite(rows).all():
            self._name_what_is_not_finite(rows)
        return rows

    @cached_property
    def _shapes(self) -> tuple[tuple[int, ...], ...]:
        return tuple(box.shape for box in self.boxes)

    def _parts(self, observation: Any, shapes: tuple[tuple[int, ...], ...]) -> list[Any]:
        """The noised parts of an observation; raises ``ValueError`` unless they have these shapes and real numbers."""
        try:
            parts = [observation] if self.keys is None else [observation[key] for key in self.keys]
        except (KeyError, TypeError, IndexError):
            wanted = f"a dict with {list(self.keys or ())}"
            raise ValueError(f"an observation must be {wanted} to be noised, got {observation!r}") from None
        for i, (part, shape) in enumerate(zip(parts, shapes, strict=True)):
            if not _is_real(part):
                part = parts[i] = _array(part)
                if not _is_real(part):
                    raise ValueError(f"{self._name(i)} must be real numbers to be noised, got {part!r}")
            if part.shape != shape:
                raise ValueError(
                    f"{self._name(i)} must have shape {shape} to be noised, got {tuple(part.shape)}"
                )
        return parts

    def _name(self, i: int) -> str:
        return "the observation" if self.keys is None else f"observation {self.keys[i]!r}"

    def _name_what_is_not_finite(self, rows: Array) -> None:
        for i, span in enumerate(self.spans):
            part = np.asarray(rows[:, span].cpu() if is_torch_array(rows) else rows[:, span])
            if not np.isfinite(part).all():
                row, channel = np.argwhere(~np.isfinite(part))[0].tolist()
                raise ValueError(
                    f"{self._name(i)} must be finite to be noised, got {part[row, channel]} "
                    f"in row {row}, channel {channel}"
                )

    def write(self, observation: Any, noisy: Array, batch: tuple[int, ...] = ()) -> Any:
        """The observation (or the batch of them, of shape ``batch``) with its channels replaced."""
        xp = array_namespace(noisy)
        fresh = [
            xp.astype(noisy[:, span].reshape(batch + box.shape), getattr(xp, box.dtype.name))
            for box, span in zip(self.boxes, self.spans, strict=True)
        ]
        return fresh[0] if self.keys is None else {**observation, **dict(zip(self.keys, fresh, strict=True))}

    def scale(self, given: Scale | None, published: Any) -> Array:
        """``noise_scale`` per channel, (C,).

        Raises:
            ValueError: it does not fit the space, does not name the noised keys, is negative or not finite.
        """
        names = self.keys or ("observation",)
        per_key: Mapping[str, Any]
        if given is None:
            per_key = {name: 1.0 for name in names} | (
                dict(published) if isinstance(published, Mapping) else {}
            )
        elif isinstance(given, Mapping):
            if self.keys is None or set(given) != set(names):
                raise ValueError(f"noise_scale must have the noised keys {list(names)}, got {list(given)}")
            per_key = given
        else:
            per_key = {name: given for name in names}
        return np.concatenate([_scale(per_key[n], box, n) for n, box in zip(names, self.boxes, strict=True)])

    def groups(self, given: Given | None, published: Any) -> dict[str, tuple[int, ...]]:
        """The columns of each named group of channels, in the flat row.

        Args:
            given: ``noise_channels`` of the wrapper: by group the places of its numbers in the (flattened) Box, or a
                dict of these by key.
            published: the same by key, as the environment says; looked at if nothing was given.

        Raises:
            ValueError: it does not name noised keys, or a place is none.
        """
        names = self.keys or ("observation",)
        if given is None:
            by_key: Any = published if isinstance(published, Mapping) else {}
        elif self.keys is None:
            by_key = {names[0]: given}
        elif isinstance(given, Mapping) and set(given) <= set(names):
            by_key = given
        else:
            raise ValueError(f"noise_channels must have noised keys, of {list(names)}, got {given!r}")
        found: dict[str, tuple[int, ...]] = {}
        for name, box, span in zip(names, self.boxes, self.spans, strict=True):
            for group, places in _groups(by_key.get(name, {}), math.prod(box.shape), name).items():
                found[group] = (*found.get(group, ()), *(span.start + place for place in places))
        return found


def _groups(given: Any, size: int, name: str) -> dict[str, list[int]]:
    """The places of each group in a part of ``size`` numbers, checked."""
    try:
        found = {group: np.asarray(places) for group, places in given.items()}
        whole = all(places.ndim == 1 and places.dtype.kind in "iu" for places in found.values())
    except (AttributeError, ValueError):  # no dict; lists of different lengths
        whole = False
    if not whole or not all(((places >= 0) & (places < size)).all() for places in found.values()):
        wanted = f"lists of whole numbers from 0 to {size - 1} by group"
        raise ValueError(f"noise_channels of {name!r} must be {wanted}, got {given!r}")
    return {group: places.tolist() for group, places in found.items()}


def _array(part: Any) -> Array:
    """What is no array of real numbers as an array of NumPy, one of an object if it is none."""
    try:
        return np.asarray(part)
    except ValueError:  # rows of different lengths
        return np.asarray(None)


def _is_real(part: Any) -> bool:
    """Whether it is an array, of NumPy or torch, of real numbers (booleans are none)."""
    if isinstance(part, np.ndarray):
        return part.dtype.kind in "fiu"
    if not is_torch_array(part):
        return False
    return part.is_floating_point() or not (part.is_complex() or str(part.dtype) == "torch.bool")


def _names(space: spaces.Dict, keys: str | Sequence[str] | None) -> tuple[str, ...]:
    if keys is None and "obstacle" not in space.spaces:
        raise ValueError(f"keys must name what to noise, some of {list(space.spaces)}")
    keys = "obstacle" if keys is None else keys
    names = (keys,) if isinstance(keys, str) else tuple(dict.fromkeys(keys))
    if not names or not set(names) <= set(space.spaces):
        raise ValueError(f"keys must be some of {list(space.spaces)}, got {keys!r}")
    return names


def _float_box(space: spaces.Space, what: str) -> spaces.Box:
    if not isinstance(space, spaces.Box) or space.dtype not in _FLOATS:
        raise ValueError(f"noise needs a Box of floats (float16, 32 or 64), {what} is {space}")
    return space


def _scale(value: Any, box: spaces.Box, name: str) -> Array:
    try:
        scale = np.broadcast_to(np.asarray(value, dtype=np.float64), box.shape).ravel()
    except (TypeError, ValueError):
        raise ValueError(f"noise_scale of {name!r} must broadcast to {box.shape}, got {value!r}") from None
    if not (np.isfinite(scale) & (scale >= 0)).all():
        raise ValueError(f"noise_scale of {name!r} must be finite and ≥ 0, got {value!r}")
    return scale


def placed(array: Any, like: Any) -> Any:
    """An array of NumPy where ``like`` is, if that is a tensor of torch; keys (uint64) keep their bits."""
    if not is_torch_array(like) or is_torch_array(array):
        return array
    array = array.view(np.int64) if array.dtype == np.uint64 else array
    return array_namespace(like).asarray(array.copy(), device=like.device)


def own_copy(observation: Any) -> Any:
    """A copy that shares nothing with what the environment keeps."""
    if isinstance(observation, np.ndarray):
        return observation.copy()
    if is_torch_array(observation):
        return observation.clone()
    if isinstance(observation, dict):
        return {key: own_copy(value) for key, value in observation.items()}
    return copy.deepcopy(observation)

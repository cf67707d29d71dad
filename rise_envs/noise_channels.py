"""Which numbers of an observation are noised: from any Box or Dict observation to one flat row, and back."""

from __future__ import annotations

import copy
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from array_api_compat import array_namespace, is_torch_array
from gymnasium import spaces
from numpy.typing import ArrayLike

from rise_envs.noise_models import Array

Scale = float | ArrayLike | Mapping[str, float | ArrayLike]

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

    def read(self, observation: Any, n: int = 1) -> Array:
        """The channels of ``n`` observations, (n, C), as an array of its own."""
        parts = [observation] if self.keys is None else [observation[key] for key in self.keys]
        if is_torch_array(parts[0]):
            xp = array_namespace(parts[0])
            return xp.concat([xp.astype(part, xp.float64).reshape(n, -1) for part in parts], axis=1)
        rows = [np.array(part, dtype=np.float64).reshape(n, -1) for part in parts]
        return rows[0] if len(rows) == 1 else np.concatenate(rows, axis=1)

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

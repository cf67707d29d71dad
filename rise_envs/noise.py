"""How a reading is corrupted: composable noise models, drawn for a whole batch of episodes at once.

A noise model maps readings (B, C) to noisy readings (B, C), with C reading channels and B episodes side by
side. All draws come from ``rise_envs.streams``: they are a function of the episode's noise key and the step,
so an episode gets the same noise alone, in any batch and in any process. In text, a model is written
``name:parameter``, and several are joined by a plus sign: ``step+dropout:0.3+delay:2``. ``name:parameter@group``
keeps it in one group of channels, of those that the environment names: ``step@velocity+episode@position``.

========================= ================================================== =============================
name:parameter (default)  effect                                             parameter at noise level λ
========================= ================================================== =============================
``step:deviation`` (1)    adds N(0, (deviation·scale)²), fresh in each step  deviation · λ
``outlier:p`` (0.05)      as ``step``, but with probability p the errors of   deviation (1) · λ
                          the whole reading are 10 times larger
``episode:deviation`` (1) adds one draw of that law, kept for the episode    deviation · λ
``drift:rate`` (0.1)      adds a random walk, deviation rate·scale·√t at t   rate · λ
``dropout:p`` (0.2)       with probability p the whole reading is lost and   1 − (1 − p)^λ
                          the last one is held; never an episode's first
``delay:steps`` (1)       the reading of so many steps ago (the first one    steps · λ, rounded, halves up
                          until there is one so old)
``quantise:pitch`` (1)    rounds to the nearest multiple of pitch·scale      pitch · λ
========================= ================================================== =============================

``scale`` (C,) is the unit of each channel: its standard deviation at level 1. Level 0 is the identity for
every model, level 1 the model as written. ``a + b`` applies ``a``, then ``b`` to what ``a`` gave:
``step+dropout`` holds the last *noisy* reading, ``dropout+step`` adds fresh noise to a held one. Each part
has its own random stream.

A new model is one subclass of :class:`NoiseModel` and one line in :data:`NOISE_MODELS`. The wrappers that put
a model into an environment are in ``rise_envs.noise_wrappers``.
"""

from __future__ import annotations

import difflib
import re
from collections.abc import Callable
from dataclasses import astuple
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from rise_envs.noise_models import (
    Array,
    Compose,
    Delay,
    Drift,
    Dropout,
    EpisodeBias,
    Groups,
    Keys,
    NoiseModel,
    Only,
    Outlier,
    Quantise,
    StepNoise,
    require,
)
from rise_envs.registry import Entry, check_new, checked_entry, checked_name

#: name -> class. A new model is one file (or class) and one line here.
NOISE_MODELS: dict[str, Callable[..., NoiseModel]] = {
    "step": StepNoise,
    "outlier": Outlier,
    "episode": EpisodeBias,
    "drift": Drift,
    "dropout": Dropout,
    "delay": Delay,
    "quantise": Quantise,
}


def register_noise(name: str, entry: Entry) -> None:
    """Give a noise model a name in texts and on command lines.

    Args:
        name: as in ``name:parameter``.
        entry: its class (or ``"module:Class"``), made with the numbers that follow the colons.

    Raises:
        ValueError: a name that is malformed or taken, or no whole :class:`~rise_envs.noise_models.NoiseModel`.
    """
    kind = f"noise model {checked_name('a noise model', name)!r}"
    found, text = checked_entry(kind, entry, ("at", "reset", "__call__"))
    if not issubclass(found, NoiseModel):
        raise ValueError(f"{kind}: {text!r} is no rise_envs.NoiseModel")
    known: Any = NOISE_MODELS.get(name)
    check_new(kind, known and f"{known.__module__}:{known.__qualname__}", text)
    NOISE_MODELS[name] = found


class Part(NamedTuple):
    """A model as it is written.

    Attributes:
        name: what stands first.
        values: what follows each colon.
        group: what follows ``@``; empty: all channels.
    """

    name: str
    values: tuple[str, ...]
    group: str


def parts_of(text: str) -> list[Part]:
    """The parts of a text such as ``step+dropout:0.3@position``, whether or not there are such models.

    Raises:
        ValueError: nothing, or a second ``@``, follows an ``@``.
    """
    parts = []
    # A plus sign before a digit belongs to a number, as in 1e+3.
    for part in re.split(r"\+(?!\d)", text):
        model, at, group = (piece.strip() for piece in part.partition("@"))
        if at and (not group or "@" in group):
            raise ValueError(f"noise model {part.strip()!r}: after '@' stands one group of channels")
        name, *values = model.split(":")
        parts.append(Part(name, tuple(values), group))
    return parts


def make_noise(noise: str | NoiseModel, level: float = 1.0, groups: Groups | None = None) -> NoiseModel:
    """The model that a text such as ``step+dropout:0.3+delay:2`` (or a model) stands for, at a noise level.

    Args:
        noise: a model or its text.
        level: multiplies it.
        groups: the channels of each group that can stand after an ``@``; None: they are not known yet, and the model
            needs :meth:`~rise_envs.noise_models.NoiseModel.bound` before it is used.

    >>> make_noise("episode + delay:2", level=0.5)
    Compose(parts=(EpisodeBias(deviation=0.5), Delay(steps=1)))
    >>> make_noise("step@radius", groups={"position": [0, 1], "radius": [2]})
    Only(model=StepNoise(deviation=1.0), group='radius', channels=(2,))

    Raises:
        ValueError: an unknown name (the nearest known one is suggested) of a model or of a group, a parameter that is
            no number or out of range, a level that is negative or not finite.
    """
    require("noise_level", level)
    if isinstance(noise, str):
        models = [_make_part(part, noise) for part in parts_of(noise)]
        noise = models[0] if len(models) == 1 else Compose(tuple(models))
    if not isinstance(noise, NoiseModel):
        raise ValueError(f"noise must be a NoiseModel or a text such as 'step+dropout:0.3', got {noise!r}")
    if groups is not None:
        noise = noise.bound(groups)
    if level == 0:
        return Compose(())  # rather than a model of amplitude 0: this keeps even the sign of −0.0
    return noise if level == 1 else noise.at(level)


def _make_part(part: Part, whole: str) -> NoiseModel:
    name, values, group = part
    text = ":".join((name, *values))
    if name not in NOISE_MODELS:
        near = difflib.get_close_matches(name, NOISE_MODELS, n=1)
        hint = f"; did you mean {near[0]!r}?" if near else ""
        raise ValueError(f"unknown noise model {name!r} in {whole!r}, known: {', '.join(NOISE_MODELS)}{hint}")
    try:
        numbers = [float(value) for value in values]
    except ValueError:
        raise ValueError(f"noise model {text!r}: what follows a ':' must be a number") from None
    try:
        model = NOISE_MODELS[name](*(int(n) if n.is_integer() else n for n in numbers))
    except TypeError:
        raise ValueError(f"noise model {text!r}: too many parameters") from None
    return Only(model, group) if group else model


def text_of(model: NoiseModel) -> str | None:
    """The text of which :func:`make_noise` makes an equal model; None: there is none.

    >>> text_of(make_noise("episode@radius + delay:2"))
    'episode:1.0@radius+delay:2'
    """
    try:
        text = _written(model)
        return text if make_noise(text) == model else None
    except (LookupError, TypeError, ValueError):  # a class without a name, or with what is no number
        return None


def _written(model: NoiseModel) -> str:
    if isinstance(model, Compose):
        return "+".join(map(_written, model.parts))
    if isinstance(model, Only):
        return f"{_written(model.model)}@{model.group}"
    names: dict[Any, str] = {kind: name for name, kind in NOISE_MODELS.items()}
    values: Any = model  # a dataclass, or a TypeError
    return ":".join(map(str, (names[type(model)], *astuple(values))))


def corrupt(
    noise: str | NoiseModel, readings: Array, scale: ArrayLike, keys: Keys, groups: Groups | None = None
) -> Array:
    """Recorded readings (B, T, C) with noise, as the wrappers hand them out.

    Args:
        noise: a model or its text.
        readings: clean readings of B episodes in T steps, the first read at the reset.
        scale: unit of each channel, (C,) or a scalar.
        keys: of the episodes, (B,), whole numbers ≥ 0: each names the noise of one. Those of
            :func:`rise_envs.noise_wrappers.noise_keys` give the noise of a wrapper's ``options["noise_seed"]``.
        groups: the channels of each group that can stand after an ``@``, as in ``Task.noise_channels``.

    Returns:
        Noisy readings, (B, T, C).

    Raises:
        ValueError: arguments of other shapes, readings that are not finite, or a scale that is not finite and ≥ 0.
    """
    model, readings, numbers = make_noise(noise, groups=groups), np.asarray(readings), np.asarray(keys)
    if readings.ndim != 3 or not np.isfinite(readings).all():
        raise ValueError(
            f"readings must be finite, (episodes, steps, channels), got shape {readings.shape}, the least "
            f"{readings.min(initial=np.inf)}, the greatest {readings.max(initial=-np.inf)}"
        )
    n_episodes, n_steps, channels = readings.shape
    unit = np.asarray(scale, dtype=np.float64)
    if unit.shape not in ((), (channels,)) or not ((unit >= 0) & (unit < np.inf)).all():
        raise ValueError(f"scale must be a finite number ≥ 0, or {channels} of them, got {scale!r}")
    if numbers.shape != (n_episodes,) or numbers.dtype.kind not in "iu" or (numbers < 0).any():
        raise ValueError(f"keys must be {n_episodes} whole numbers ≥ 0, one for each episode, got {keys!r}")
    unit = np.broadcast_to(unit, channels)
    state = model.reset(numbers.astype(np.uint64), channels)
    noisy = np.empty(readings.shape)
    for t in range(n_steps):
        noisy[:, t], state = model(readings[:, t], unit, np.full(n_episodes, t), state)
    return noisy

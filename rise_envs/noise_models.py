"""The noise models themselves: frozen dataclasses, described in ``rise_envs.noise``."""

from __future__ import annotations

import difflib
import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from array_api_compat import array_namespace, device

from rise_envs import streams
from rise_envs.settings import finite

# Arrays of NumPy, or tensors on any device of torch; the arguments of a call are all of one library.
Array = Any  # float64
Keys = Any  # uint64, int64 with torch
Steps = Any  # int64
State = tuple[Any, ...]  # what a model carries: a (nested) tuple of arrays, each with the batch first
Noisy = tuple[Array, State]
Groups = Mapping[str, Sequence[int]]  # which of the C channels belong to a group, by its name

MAX_DELAY = 10_000  # steps; the readings on their way are kept in memory
OUTLIER = 10.0  # how many times larger than the others the errors of an outlier are


class NoiseModel(ABC):
    """What every noise model offers. Shapes: B episodes, C reading channels."""

    @abstractmethod
    def at(self, level: float) -> NoiseModel:
        """This model at noise level ``level`` (≥ 0); at level 0 it must be the identity."""

    @abstractmethod
    def reset(self, keys: Keys, channels: int, ahead: int = 1) -> State:
        """The state at the start of B episodes.

        Args:
            keys: noise key of each episode, (B,).
            channels: how many: C.
            ahead: how many steps to draw at once. Changes speed, not numbers: 64 suits one episode, 1 many.
        """

    @abstractmethod
    def __call__(self, reading: Array, scale: Array, step: Steps, state: State) -> Noisy:
        """Noisy readings (B, C) and the next state. No argument is changed.

        Args:
            reading: what would be read without this noise, (B, C).
            scale: unit of each channel, (C,).
            step: steps since each episode's reset, (B,): 0, 1, 2, … from call to call.
            state: from :meth:`reset`, or from the call before.
        """

    def bound(self, groups: Groups) -> NoiseModel:
        """This model, which groups of channels are named in it looked up in ``groups``; most name none."""
        return self

    def __add__(self, other: NoiseModel) -> Compose:
        return Compose((*_parts(self), *_parts(other)))


def _parts(model: NoiseModel) -> tuple[NoiseModel, ...]:
    return model.parts if isinstance(model, Compose) else (model,)


def require(name: str, value: Any, low: float = 0.0, high: float = math.inf) -> None:
    """Raise ``ValueError`` unless ``value`` is a finite number in [low, high]."""
    finite(name, value, low, high)


# Draws for the coming steps wait in the state as a block (B, ahead, C): an episode on its own then pays for
# the array operations of a draw only once in `ahead` steps.
def _draw_state(keys: Keys, channels: int, ahead: int) -> State:
    return keys, _zeros(keys, ahead, channels)


def _zeros(keys: Keys, *shape: int) -> Array:
    """Zeros, one of the given shape for each key, where the keys are."""
    xp = array_namespace(keys)
    return xp.zeros((len(keys), *shape), dtype=xp.float64, device=device(keys))


def _count(numbers: Array, n: int) -> Array:
    """0 to n − 1, where ``numbers`` are."""
    xp = array_namespace(numbers)
    return xp.arange(n, dtype=xp.int64, device=device(numbers))


def _draws(law: Callable[..., Array], step: Steps, state: State) -> Noisy:
    """Draws (B, C) of ``law`` (``streams.normal`` or ``streams.uniform``) for this step."""
    keys, block = state
    _, ahead, channels = block.shape
    if ahead == 1:
        return law(keys[:, None], step[:, None] * channels + _count(step, channels)), state
    phase = step % ahead
    due = phase == 0
    if due.any():
        counter = step[due, None] * channels + _count(step, ahead * channels)  # step · C + channel
        fresh = law(keys[due, None], counter).reshape(-1, ahead, channels)
        if len(fresh) < len(block):
            block = block.copy()
            block[due] = fresh
        else:
            block = fresh
    return block[np.arange(len(step)), phase], (keys, block)


@dataclass(frozen=True)
class StepNoise(NoiseModel):
    """Independent Gaussian noise in every step and channel.

    Attributes:
        deviation: standard deviation in units of ``scale``.
    """

    deviation: float = 1.0

    def __post_init__(self) -> None:
        require("step: deviation", self.deviation)

    def at(self, level: float) -> NoiseModel:
        """The deviation times ``level``."""
        return replace(self, deviation=self.deviation * level)

    def reset(self, keys: Keys, channels: int, ahead: int = 1) -> State:
        """The draws."""
        return _draw_state(keys, channels, ahead)

    def __call__(self, reading: Array, scale: Array, step: Steps, state: State) -> Noisy:
        """The reading with a fresh error."""
        draws, state = _draws(streams.normal, step, state)
        return reading + self.deviation * scale * draws, state


@dataclass(frozen=True)
class Outlier(NoiseModel):
    """Fresh Gaussian noise with heavy tails: a contaminated normal (Tukey, 1960).

    Attributes:
        probability: that the errors of a whole reading are :data:`OUTLIER` times larger, in every step.
        deviation: standard deviation of all other readings, in units of ``scale``.
    """

    probability: float = 0.05
    deviation: float = 1.0

    def __post_init__(self) -> None:
        require("outlier: probability", self.probability, 0.0, 1.0)
        require("outlier: deviation", self.deviation)

    def at(self, level: float) -> NoiseModel:
        """The deviation times ``level``; as many outliers."""
        return replace(self, deviation=self.deviation * level)

    def reset(self, keys: Keys, channels: int, ahead: int = 1) -> State:
        """The draws of errors, and those of outliers, one a step."""
        errors, chances = streams.split(keys, 0), streams.split(keys, 1)
        return _draw_state(errors, channels, ahead), _draw_state(chances, 1, ahead)

    def __call__(self, reading: Array, scale: Array, step: Steps, state: State) -> Noisy:
        """The reading with a fresh error, now and then a large one."""
        errors, chances = state
        draws, errors = _draws(streams.normal, step, errors)
        chance, chances = _draws(streams.uniform, step, chances)
        size = array_namespace(reading).where(chance < self.probability, OUTLIER, 1.0)
        return reading + self.deviation * scale * size * draws, (errors, chances)


@dataclass(frozen=True)
class EpisodeBias(NoiseModel):
    """One Gaussian error per channel, drawn at the start of the episode and kept.

    Attributes:
        deviation: standard deviation over episodes, in units of ``scale``.
    """

    deviation: float = 1.0

    def __post_init__(self) -> None:
        require("episode: deviation", self.deviation)

    def at(self, level: float) -> NoiseModel:
        """The deviation times ``level``."""
        return replace(self, deviation=self.deviation * level)

    def reset(self, keys: Keys, channels: int, ahead: int = 1) -> State:
        """The bias, (B, C), in units of its deviation."""
        return (streams.normal(keys[:, None], _count(keys, channels)),)

    def __call__(self, reading: Array, scale: Array, step: Steps, state: State) -> Noisy:
        """The reading with the episode's error."""
        return reading + self.deviation * scale * state[0], state


@dataclass(frozen=True)
class Drift(NoiseModel):
    """A Gaussian random walk in every channel that starts at 0.

    Attributes:
        rate: standard deviation of one step of the walk, in units of ``scale``.
    """

    rate: float = 0.1

    def __post_init__(self) -> None:
        require("drift: rate", self.rate)

    def at(self, level: float) -> NoiseModel:
        """The rate times ``level``."""
        return replace(self, rate=self.rate * level)

    def reset(self, keys: Keys, channels: int, ahead: int = 1) -> State:
        """The walk so far, (B, C), in units of its rate; the draws."""
        return _zeros(keys, channels), _draw_state(keys, channels, ahead)

    def __call__(self, reading: Array, scale: Array, step: Steps, state: State) -> Noisy:
        """The reading with the error that has grown so far."""
        walk, draw_state = state
        draws, draw_state = _draws(streams.normal, step, draw_state)
        walk = walk + (step > 0)[:, None] * draws
        return reading + self.rate * scale * walk, (walk, draw_state)


@dataclass(frozen=True)
class Dropout(NoiseModel):
    """Readings get lost as a whole; the last one that arrived is held.

    Attributes:
        probability: of losing a reading, in every step but an episode's first.
    """

    probability: float = 0.2

    def __post_init__(self) -> None:
        require("dropout: probability", self.probability, 0.0, 1.0)

    def at(self, level: float) -> NoiseModel:
        """Level 2 loses a reading as often as two independent chances of losing it do."""
        return replace(self, probability=1.0 - (1.0 - self.probability) ** level)

    def reset(self, keys: Keys, channels: int, ahead: int = 1) -> State:
        """The reading held, (B, C); the draws, one a step."""
        return _zeros(keys, channels), _draw_state(keys, 1, ahead)

    def __call__(self, reading: Array, scale: Array, step: Steps, state: State) -> Noisy:
        """The last reading that arrived."""
        held, draw_state = state
        chance, draw_state = _draws(streams.uniform, step, draw_state)
        lost = (chance < self.probability) & (step > 0)[:, None]
        held = array_namespace(reading).where(lost, held, reading)
        return held, (held, draw_state)


@dataclass(frozen=True)
class Delay(NoiseModel):
    """Readings arrive late.

    Attributes:
        steps: by how many steps.
    """

    steps: int = 1

    def __post_init__(self) -> None:
        require("delay: steps", self.steps, 0, MAX_DELAY)
        if self.steps != int(self.steps):
            raise ValueError(f"delay: steps must be a whole number, got {self.steps!r}")

    def at(self, level: float) -> NoiseModel:
        """The delay times ``level``, in whole steps."""
        require("delay: steps · noise_level", self.steps * level, 0, MAX_DELAY)
        return replace(self, steps=math.floor(self.steps * level + 0.5))

    def reset(self, keys: Keys, channels: int, ahead: int = 1) -> State:
        """The readings on their way, (B, steps, C), oldest first."""
        return (_zeros(keys, int(self.steps), channels),)

    def __call__(self, reading: Array, scale: Array, step: Steps, state: State) -> Noisy:
        """The oldest reading on its way."""
        xp = array_namespace(reading)
        late = xp.where((step == 0)[:, None, None], reading[:, None], state[0])
        late = xp.concat((late, reading[:, None]), axis=1)
        return late[:, 0], (late[:, 1:],)


@dataclass(frozen=True)
class Quantise(NoiseModel):
    """Readings on a grid through 0.

    Attributes:
        pitch: of the grid, in units of ``scale``; channels of ``scale`` 0 stay as they are.
    """

    pitch: float = 1.0

    def __post_init__(self) -> None:
        require("quantise: pitch", self.pitch)

    def at(self, level: float) -> NoiseModel:
        """The pitch times ``level``."""
        return replace(self, pitch=self.pitch * level)

    def reset(self, keys: Keys, channels: int, ahead: int = 1) -> State:
        """Nothing."""
        return ()

    def __call__(self, reading: Array, scale: Array, step: Steps, state: State) -> Noisy:
        """The nearest point of the grid."""
        xp, grid = array_namespace(reading), self.pitch * scale
        rounded = xp.round(reading / xp.where(grid > 0, grid, 1.0)) * grid
        return xp.where(grid > 0, rounded, reading), state


@dataclass(frozen=True)
class Compose(NoiseModel):
    """Models one after the other; without any it is the identity.

    Attributes:
        parts: in the order of their effect.
    """

    parts: tuple[NoiseModel, ...]

    def at(self, level: float) -> NoiseModel:
        """Every part at ``level``."""
        return replace(self, parts=tuple(part.at(level) for part in self.parts))

    def bound(self, groups: Groups) -> NoiseModel:
        """Every part with its groups looked up."""
        return replace(self, parts=tuple(part.bound(groups) for part in self.parts))

    def reset(self, keys: Keys, channels: int, ahead: int = 1) -> State:
        """The parts' states, each on its own stream."""
        return tuple(p.reset(streams.split(keys, i), channels, ahead) for i, p in enumerate(self.parts))

    def __call__(self, reading: Array, scale: Array, step: Steps, state: State) -> Noisy:
        """What the last part gives."""
        after = []
        for part, before in zip(self.parts, state, strict=True):
            reading, now = part(reading, scale, step, before)
            after.append(now)
        return reading, tuple(after)


@dataclass(frozen=True)
class Only(NoiseModel):
    """A model whose effect is kept in one group of channels; all others pass as they are.

    Its draws are those of the model in all channels, so what a channel gets does not depend on the group.

    Attributes:
        model: what happens there.
        group: name of the group.
        channels: which numbers of a reading belong to it; None: not known before :meth:`bound`.
    """

    model: NoiseModel
    group: str
    channels: tuple[int, ...] | None = None

    def at(self, level: float) -> NoiseModel:
        """The model at ``level``, in the same channels."""
        return replace(self, model=self.model.at(level))

    def bound(self, groups: Groups) -> NoiseModel:
        """This model with the channels of its group.

        Raises:
            ValueError: no group of this name.
        """
        if self.group not in groups:
            near = difflib.get_close_matches(self.group, groups, n=1)
            hint = f"; did you mean {near[0]!r}?" if near else ""
            there = (
                f"there are: {', '.join(groups)}"
                if groups
                else "the environment names none: pass noise_channels"
            )
            raise ValueError(f"no group {self.group!r} of reading channels, {there}{hint}")
        return replace(self, model=self.model.bound(groups), channels=tuple(groups[self.group]))

    def reset(self, keys: Keys, channels: int, ahead: int = 1) -> State:
        """Which channels are meant, (B, C); the state of the model.

        Raises:
            ValueError: which ones is not known, or some are not there.
        """
        if self.channels is None or not set(self.channels) <= set(range(channels)):
            told = "are not known" if self.channels is None else f"are {self.channels} of {channels}"
            raise ValueError(
                f"the channels of the group {self.group!r} {told}: make_noise(…, groups=…) names them"
            )
        hit = _zeros(keys, channels) > 0
        hit[:, list(self.channels)] = True
        return hit, self.model.reset(keys, channels, ahead)

    def __call__(self, reading: Array, scale: Array, step: Steps, state: State) -> Noisy:
        """What the model gives in its channels, and the reading in all others."""
        hit, inner = state
        noisy, inner = self.model(reading, scale, step, inner)
        return array_namespace(reading).where(hit, noisy, reading), (hit, inner)

"""Noisy observations for any Gymnasium environment: :class:`ObservationNoise` and its twin for batches.

Both follow the same rules.

- **What is noised.** ``keys`` of a Dict observation (default: ``obstacle``, where there is one), or the whole
  of a Box. Everything else, goals included, passes untouched. Noised parts get the space (−∞, ∞).
- **How much.** ``noise_level`` × ``noise_scale``, the latter per channel: an argument (a number, an array
  that broadcasts to the Box, or a dict of these), else the dict ``noise_scale`` that the environment or a wrapper
  around it publishes, else 1.
- **Where.** Groups that a noise text can name (``step@position``) are the argument ``noise_channels``, else what is
  published under this name, by key and group: see :meth:`rise_envs.noise_channels.Channels.groups`.
- **Reproducible, and apart from the environment.** ``reset(seed=s)`` seeds the noise's own stream, further
  resets go on with it, and ``reset(options={"noise_seed": n})`` names the noise of one episode whatever the
  seed. The environment's random numbers are not touched: it moves the same with and without noise.
- **Truth.** ``info["clean_observation"]`` is a copy of the whole observation without noise.
- **Noise upon noise.** A wrapper around another one draws from a stream of its own; a noise seed is that of the
  outermost, and the truth that of the innermost.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.utils import RecordConstructorArgs
from gymnasium.vector import AutoresetMode, VectorEnv, VectorWrapper
from gymnasium.vector.utils import batch_space

from rise_envs import streams
from rise_envs.episodes import check_options, check_reset, each_seed, reset_mask
from rise_envs.noise import make_noise, text_of
from rise_envs.noise_channels import Channels, Given, Scale, own_copy, placed
from rise_envs.noise_models import Array, Keys, NoiseModel, State, Steps

Rows = Any  # a mask (B,), of the library of the readings

# Tags of key streams: they keep apart the noise of reset(seed=n), that of the noise seed n, and the
# environment with seed n. Not 0: to NumPy the entropy (n, 0) is the same as n.
_STREAM, _EPISODE = 0x6E6F6973, 0x65706973


def noise_keys(noise_seeds: Sequence[int]) -> Keys:
    """The keys (B,) of the noise that the wrappers give to episodes with these ``options["noise_seed"]``.

    For :func:`rise_envs.noise.corrupt`: what is recorded gets the noise that it would have met.
    """
    return streams.seed_keys(noise_seeds, _EPISODE)


class NoiseRows:
    """The noise of B episodes that run side by side, each with its own key stream and clock.

    Args:
        model: of the noise.
        scale: unit of each channel, (C,).
        n: how many: B.
        ahead: how many steps are drawn at once.
        layer: how many other noise wrappers there are inside of this one.
    """

    def __init__(self, model: NoiseModel, scale: Array, n: int, ahead: int, layer: int = 0) -> None:
        self.model, self.scale, self._ahead, self._layer = model, scale, ahead, layer
        self._stream: Keys = np.random.SeedSequence().generate_state(n, np.uint64)
        self._episode: Keys = np.zeros(n, dtype=np.uint64)
        self._step: Steps = np.zeros(n, dtype=np.int64)
        self._state: State | None = None

    def seed(self, rows: Rows, seeds: Sequence[int]) -> None:
        """Let the streams of the given rows (B,) begin anew, as ``seeds`` (one for each) name them."""
        self._stream[rows] = placed(streams.seed_keys(seeds, _STREAM + self._layer), self._stream)
        self._episode[rows] = 0

    def start(self, reading: Array, rows: Rows, noise_seeds: Sequence[int] | None = None) -> Array:
        """Begin episodes in the given rows (B,): their first noisy readings, (rows.sum(), C).

        Args:
            reading: the first clean readings, (B, C); only the given rows are looked at.
            rows: which rows, (B,).
            noise_seeds: B seeds that name the noise of these episodes, instead of the rows' own streams.
        """
        everyone = bool(rows.all())
        if self._state is None:
            if not everyone:
                raise gym.error.ResetNeeded("the first reset() must start every environment")
            for name in ("scale", "_stream", "_episode", "_step"):  # where the readings are
                setattr(self, name, placed(getattr(self, name), reading))
        if noise_seeds is None:
            keys: Keys = streams.bits(self._stream[rows], self._episode[rows])
            self._episode[rows] += 1
        else:
            chosen = [noise_seeds[i] for i in np.flatnonzero(rows).tolist()]
            keys = placed(streams.seed_keys(chosen, _EPISODE + self._layer), reading)
        self._step[rows] = 0
        fresh = self.model.reset(keys, reading.shape[1], self._ahead)
        noisy, fresh = self.model(reading[rows], self.scale, self._step[rows], fresh)
        self._state = fresh if everyone else _put(self._state, fresh, rows)
        return noisy

    def advance(self, reading: Array) -> Array:
        """Noisy readings (B, C) of the step that led to ``reading`` (B, C)."""
        if self._state is None:
            raise gym.error.ResetNeeded("call reset() before step()")
        self._step = self._step + 1
        noisy, self._state = self.model(reading, self.scale, self._step, self._state)
        return noisy


def _put(state: Any, fresh: Any, rows: Rows) -> Any:
    """``state`` (B rows) with the given rows taken from ``fresh`` (those rows only)."""
    if isinstance(state, tuple):
        return tuple(_put(part, new, rows) for part, new in zip(state, fresh, strict=True))
    merged = own_copy(state)
    merged[rows] = fresh
    return merged


def _noise_seeds(options: dict[str, Any] | None, n: int) -> tuple[list[int] | None, dict[str, Any] | None]:
    """The noise seeds (``n`` of them) named in reset's options, and the options without them."""
    if not options or "noise_seed" not in options:
        return None, options
    rest = {key: value for key, value in options.items() if key != "noise_seed"}
    if options["noise_seed"] is None:
        return None, rest or None
    try:
        seeds = np.asarray(options["noise_seed"])
    except ValueError:  # rows of different lengths
        seeds = np.asarray(None)
    if seeds.shape not in ((), (n,)) or seeds.dtype.kind not in "iu" or (seeds < 0).any():
        raise ValueError(
            f"options['noise_seed'] must be a whole number ≥ 0 (or {n} of them, one for each environment), "
            f"got {options['noise_seed']!r}"
        )
    return np.broadcast_to(seeds, n).tolist(), rest or None


def _plain(argument: Any) -> Any:
    """Arrays as lists, and NumPy's numbers as Python's: what JSON knows."""
    if isinstance(argument, Mapping):
        return {key: _plain(value) for key, value in argument.items()}
    if isinstance(argument, list | tuple):
        return [_plain(value) for value in argument]
    return argument.tolist() if hasattr(argument, "tolist") else argument


class _Noisy(RecordConstructorArgs):
    """What both wrappers do with their arguments."""

    env: Any

    def _begin(
        self,
        space: spaces.Space,
        rows: tuple[int, int],
        noise: str | NoiseModel,
        keys: str | Sequence[str] | None,
        noise_level: float,
        noise_scale: Scale | None,
        noise_channels: Given | None,
    ) -> None:
        """Record and use them; ``rows`` are the arguments ``n`` and ``ahead`` of :class:`NoiseRows`."""
        text = text_of(noise) if isinstance(noise, NoiseModel) else None  # which JSON knows
        RecordConstructorArgs.__init__(
            self,
            noise=text or noise,
            keys=keys,
            noise_level=noise_level,
            noise_scale=_plain(noise_scale),
            noise_channels=_plain(noise_channels),
        )
        self.channels = Channels.of(space, keys)
        scale = self.channels.scale(noise_scale, _published(self.env, "noise_scale"))
        groups = self.channels.groups(noise_channels, _published(self.env, "noise_channels"))
        layer = _published(self.env, "noise_layers") or 0
        self._rows = NoiseRows(make_noise(noise, noise_level, groups), scale, *rows, layer)
        self.noise_layers = layer + 1  # this one included: a wrapper around this one asks for it


class ObservationNoise(gym.Wrapper, _Noisy):
    """Any environment, its observation read with noise. The rules are at the top of this module.

    An environment whose ``unwrapped.perceived`` exists (the RISE ones) finds its noisy ``obstacle`` reading
    there, to draw it.

    >>> env = ObservationNoise(gym.make("CartPole-v1"), "step+delay:2", noise_scale=[0.1, 0.2, 0.01, 0.2])
    >>> observation, info = env.reset(seed=0)
    >>> observation.dtype, sorted(info)
    (dtype('float32'), ['clean_observation'])

    Args:
        env: an environment with a Box observation of floats, or a Dict with such parts.
        noise: a model, or a text such as ``"episode"`` or ``"step+dropout:0.3"`` (see ``rise_envs.noise``).
        keys: which parts of a Dict observation are noised.
        noise_level: multiplies the noise; 0 is none.
        noise_scale: standard deviation of each channel at level 1.
        noise_channels: which numbers belong to the groups that ``noise`` names: a dict of lists, or a dict of such
            dicts by key.

    Raises:
        ValueError: arguments that do not fit each other, the environment or their ranges.
    """

    def __init__(
        self,
        env: gym.Env,
        noise: str | NoiseModel = "step",
        keys: str | Sequence[str] | None = None,
        noise_level: float = 1.0,
        noise_scale: Scale | None = None,
        noise_channels: Given | None = None,
    ) -> None:
        gym.Wrapper.__init__(self, env)
        self._begin(env.observation_space, (1, 64), noise, keys, noise_level, noise_scale, noise_channels)
        self.observation_space = self.channels.noisy_space(env.observation_space)
        named = dict(zip(self.channels.keys or (), self.channels.spans, strict=False))
        self._base: Any = env.unwrapped
        self._obstacle = named.get("obstacle") if hasattr(self._base, "perceived") else None

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Start an episode and its noise; ``options["noise_seed"]`` names the noise apart from ``seed``.

        Raises:
            ValueError: a seed or noise seed that is no whole number ≥ 0, or options that are no dict. Nothing has
                changed then; a reading that is no finite number in the shape of its space.
        """
        seed = check_reset(seed, options)
        noise_seeds, options = _noise_seeds(options, 1)
        observation, info = self.env.reset(seed=seed, options=options)
        if seed is not None:
            self._rows.seed(np.ones(1, dtype=bool), [seed])
        reading = self.channels.read(observation)
        noisy = self._rows.start(reading, np.ones(1, dtype=bool), noise_seeds)
        return self._hand_out(observation, noisy, info)

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Step the environment; its observation is read with noise, the last one of an episode too.

        Raises:
            ValueError: a reading that is no finite number in the shape of its space.
        """
        observation, reward, terminated, truncated, info = self.env.step(action)
        noisy = self._rows.advance(self.channels.read(observation))
        observation, info = self._hand_out(observation, noisy, info)
        return observation, reward, terminated, truncated, info

    def _hand_out(self, clean: Any, noisy: Array, info: dict[str, Any]) -> tuple[Any, dict[str, Any]]:
        if self._obstacle is not None:
            self._base.perceived = noisy[0, self._obstacle].copy()
        if self.noise_layers == 1:
            info = {**info, "clean_observation": own_copy(clean)}
        return self.channels.write(clean, noisy), info


class VectorObservationNoise(VectorWrapper, _Noisy):
    """Any vector environment, its observations read with noise: the twin of :class:`ObservationNoise`.

    It hands out what a ``SyncVectorEnv`` of environments wrapped one by one would, number for number, in all
    three autoreset modes: for one seed, a list of seeds, ``options["noise_seed"]`` (one for all, or B of
    them) and ``options["reset_mask"]``. With ``SAME_STEP``, ``infos["final_obs"]`` is noised as the last
    observation of its episode, and its clean form is in ``infos["final_info"]["clean_observation"]``.
    ``infos["clean_observation"]`` is the clean batch (an array, or a dict of arrays) with Gymnasium's masks.

    Args:
        env: any vector environment: sync, async or native.
        noise: as in :class:`ObservationNoise`, and so are the others.
        keys: see there.
        noise_level: see there.
        noise_scale: see there.
        noise_channels: see there.

    Raises:
        ValueError: as in :class:`ObservationNoise`, or no autoreset mode in the environment's metadata.
    """

    def __init__(
        self,
        env: VectorEnv,
        noise: str | NoiseModel = "step",
        keys: str | Sequence[str] | None = None,
        noise_level: float = 1.0,
        noise_scale: Scale | None = None,
        noise_channels: Given | None = None,
    ) -> None:
        VectorWrapper.__init__(self, env)
        try:
            self._mode = AutoresetMode(env.metadata["autoreset_mode"])
        except (KeyError, ValueError):
            raise ValueError(f"{env}: metadata['autoreset_mode'] must be a gymnasium AutoresetMode") from None
        space, rows = env.single_observation_space, (env.num_envs, 1)
        self._begin(space, rows, noise, keys, noise_level, noise_scale, noise_channels)
        self.single_observation_space = self.channels.noisy_space(space)
        self.observation_space = batch_space(self.single_observation_space, env.num_envs)
        self._noisy: Array | None = None  # as last handed out
        self._done = np.zeros(env.num_envs, dtype=bool)

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Start all episodes, or those of ``options["reset_mask"]``, and their noise.

        Raises:
            ValueError: seeds or noise seeds that are not whole numbers ≥ 0, or not B of them, no mask of B booleans,
                or options that are no dict. Nothing has changed then; a reading as in :class:`ObservationNoise`.
        """
        n = self.num_envs
        check_options(options)
        noise_seeds, options = _noise_seeds(options, n)
        rows = reset_mask(options, n, first=self._noisy is None).copy()
        seeds = each_seed(seed, n)
        named = rows & np.array([wanted is not None for wanted in seeds])
        # Checked before the environment moves, which may know no check of its own; a range needs but one.
        chosen = [seeds[i] for i in np.flatnonzero(named).tolist()]
        for one in chosen[:1] if isinstance(seeds, range) else chosen:
            streams.checked_seed(one)
        # The environment may pop the mask from its options: they get a dict of their own.
        clean, infos = self.env.reset(seed=seed, options=dict(options) if options else options)  # type: ignore[arg-type]
        if seed is not None:
            self._rows.seed(named, seeds if len(chosen) == n else chosen)  # type: ignore[arg-type]
        reading = self.channels.read(clean, (n,))
        noisy = reading if self._noisy is None else own_copy(self._noisy)
        noisy[rows] = self._rows.start(reading, rows, noise_seeds)
        self._done = self._done & ~placed(rows, self._done)
        self._noisy = noisy
        return self.channels.write(clean, noisy, (n,)), {**infos, **self._clean_info(clean, rows)}

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """Step all environments; rows that the environment resets begin a new episode of noise."""
        n = self.num_envs
        clean, rewards, terminated, truncated, infos = self.env.step(actions)
        reading = self.channels.read(clean, (n,))
        ended = terminated | truncated
        infos = {**infos, **self._clean_info(clean, np.ones(n, dtype=bool))}
        if self._mode == AutoresetMode.SAME_STEP and ended.any():
            noisy, infos = self._end_and_start(reading, ended, infos)
        else:
            noisy = self._rows.advance(reading)
            if self._mode == AutoresetMode.NEXT_STEP and self._done.any():
                noisy = own_copy(noisy)
                noisy[self._done] = self._rows.start(reading, self._done)
        self._done, self._noisy = ended, noisy
        return self.channels.write(clean, noisy, (n,)), rewards, terminated, truncated, infos

    def _end_and_start(
        self, reading: Array, ended: Rows, infos: dict[str, Any]
    ) -> tuple[Array, dict[str, Any]]:
        """A step in which ``ended`` rows give their last observation and the first of a new episode."""
        if "final_obs" not in infos:
            raise ValueError(f"{self.env} resets in the same step, but gives no infos['final_obs']")
        final_info = dict(infos.get("final_info", {}))
        if isinstance(infos["final_obs"], np.ndarray) and infos["final_obs"].dtype == object:
            finals = {i: infos["final_obs"][i] for i in np.flatnonzero(ended).tolist()}
            last = reading.copy()
            for i, observation in finals.items():
                last[i] = self.channels.read(observation)
            noisy = self._rows.advance(last).copy()
            final_obs = infos["final_obs"].copy()
            for i, observation in finals.items():
                final_obs[i] = self.channels.write(observation, noisy[i : i + 1])
                if self.noise_layers == 1:
                    final_info = self._add_info(final_info, {"clean_observation": own_copy(observation)}, i)
        else:  # one batch, right in the rows that ended
            noisy = own_copy(self._rows.advance(self.channels.read(infos["final_obs"], (self.num_envs,))))
            final_obs = self.channels.write(infos["final_obs"], noisy, (self.num_envs,))
            final_info |= self._clean_info(infos["final_obs"], ended)
        noisy[ended] = self._rows.start(reading, ended)
        infos = {**infos, "final_obs": final_obs, "final_info": final_info, "_final_info": own_copy(ended)}
        return noisy, infos

    def _clean_info(self, clean: Any, rows: Rows) -> dict[str, Any]:
        """The clean observations in the form that Gymnasium gives to infos, with masks of who has one.

        None, where a noise wrapper further inside has given them.
        """
        if self.noise_layers > 1:
            return {}
        values = own_copy(clean)
        rows = placed(rows, next(iter(clean.values())) if isinstance(clean, dict) else clean)
        if isinstance(values, dict):
            values |= {f"_{key}": own_copy(rows) for key in clean}
        return {"clean_observation": values, "_clean_observation": own_copy(rows)}


def _published(env: gym.Env | VectorEnv, name: str) -> Any:
    """An attribute as the environment, or the outermost wrapper that has it, publishes it, else ``None``.

    Of a vector environment without it: as its first sub-environment does.
    """
    if isinstance(env, gym.Env):
        return env.get_wrapper_attr(name) if env.has_wrapper_attr(name) else None
    while isinstance(env, VectorWrapper) and not hasattr(env, name):
        env = env.env
    if hasattr(env, name):
        return getattr(env, name)
    # Asking first: an attribute that is missing in a worker process would end that worker.
    if hasattr(env, "call") and all(env.call("has_wrapper_attr", name)):
        return env.call("get_wrapper_attr", name)[0]
    return None

"""What every agent keeps, as checks that anybody can run on an agent of their own.

>>> from rise_agents.testing import check_agent
>>> check_agent("pcbc", "RISE-GroundVehicle-v0")

An agent that imitates needs demonstrations: those of an expert of the environment are recorded, unless some are given.
"""

from __future__ import annotations

import functools
import json
import subprocess
import sys
import tempfile
from collections.abc import Callable
from dataclasses import fields
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

from rise_agents import agent_class, load_agent, make_agent, plugins
from rise_agents.agent import initial_state
from rise_agents.checkpoint import CheckpointError
from rise_envs.testing import ContractError, hold

ROWS = 64
# A checkpoint and a batch of observations to a file of actions; users' modules come last.
_ACTS = """
import json
import sys
import numpy as np
from rise_agents import load_agent, make_agent
from rise_agents.plugins import import_modules
name, env_id, config, checkpoint, batch, actions, *modules = sys.argv[1:]
import_modules(modules)
make_agent(name, env_id, json.loads(config))
agent = load_agent(checkpoint, env_id)
observation = dict(np.load(batch))
observation = observation.get("", observation)
for deterministic in (False, True):
    action, _ = agent.predict(observation, deterministic=deterministic)
np.save(actions, action)
print(*{"torch", "stable_baselines3"} & set(sys.modules))
"""


class Subject:
    """An agent under test: trained once, with the settings that its class calls ``BRIEF``.

    Args:
        name: of a registered agent.
        env_id: a registered environment.
        demonstrations: what it learns from, if it imitates; None: 40 episodes of the environment's first expert.
        config: settings beside ``BRIEF``.
    """

    def __init__(
        self, name: str, env_id: str, demonstrations: Any = None, config: dict[str, Any] | None = None
    ) -> None:
        self.name, self.env_id = name, env_id
        self.kind = agent_class(name)
        self.config = {**self.kind.BRIEF, **(config or {})}
        self._demonstrations = demonstrations

    @functools.cached_property
    def source(self) -> Any:
        """What it learns from."""
        if self.kind.learns_from == "environment":
            return self.env_id
        if self._demonstrations is not None:
            return self._demonstrations
        from rise_agents.demonstrations import generate
        from rise_agents.experts import expert_names

        return generate(self.env_id, expert_names(self.env_id)[0], 40)

    def fresh(self) -> Any:
        """The agent, untrained."""
        return make_agent(self.name, self.env_id, self.config, seed=3)

    @functools.cached_property
    def agent(self) -> Any:
        """The agent, trained."""
        return self.fresh().learn(self.source)

    @functools.cached_property
    def space(self) -> Any:
        """Of its actions."""
        env = gym.make(self.env_id)
        space = env.action_space
        env.close()
        return space

    @functools.cached_property
    def parts(self) -> dict[str, np.ndarray]:
        """Some observations of random episodes, read with noise, by key (a lone part has the key ``""``)."""
        env = gym.make(self.env_id)
        rows: list[dict[str, Any]] = []
        env.action_space.seed(0)
        rng, seed = np.random.default_rng(0), 0
        while len(rows) < ROWS:
            observation, over = env.reset(seed=seed)[0], False
            seed += 1
            while not over and len(rows) < ROWS:
                rows.append(observation if isinstance(observation, dict) else {"": observation})
                observation, _, terminated, truncated, _ = env.step(env.action_space.sample())
                over = terminated or truncated
        env.close()
        parts = {key: np.array([row[key] for row in rows]) for key in rows[0]}
        if "obstacle" in parts:
            parts["obstacle"] = parts["obstacle"] + rng.normal(size=parts["obstacle"].shape)
        return parts

    def observation(self, rows: Any = slice(None), parts: dict[str, np.ndarray] | None = None) -> Any:
        """Some of the observations, as the environment would hand them out."""
        chosen = {key: value[rows].copy() for key, value in (self.parts if parts is None else parts).items()}
        return chosen.get("", chosen)


def check_agent(
    name: str, env_id: str, demonstrations: Any = None, config: dict[str, Any] | None = None
) -> None:
    """Train a registered agent briefly, and check it.

    Args:
        name: registered with :func:`rise_agents.register_agent`.
        env_id: registered with :func:`rise_envs.register_env`.
        demonstrations: what it learns from, if it imitates; None: 40 episodes of the environment's first expert.
        config: settings beside those that its class calls ``BRIEF``.

    Raises:
        ContractError: what it does not keep.
        ValueError: no such agent, or no expert to learn from.
    """
    subject = Subject(name, env_id, demonstrations, config)
    _ = subject.source  # a lack of experts is no fault of the agent
    for title, check in CHECKS.items():
        try:
            check(subject)
        except Exception as error:  # whatever an agent of somebody else raises
            raise ContractError(f"{name} in {env_id}: {title}: {type(error).__name__}: {error}") from error


def _acts(s: Subject) -> None:
    """Actions of a batch and of one observation have the space's shape and lie inside, however wild readings are."""
    parts = dict(s.parts)
    if "obstacle" in parts:
        parts["obstacle"] = parts["obstacle"].copy()
        parts["obstacle"][:10] *= 1e5
    action, _ = s.agent.predict(s.observation(parts=parts))
    hold(action.shape == (ROWS, *s.space.shape), f"a batch of {ROWS} gives actions of shape {action.shape}")
    inside = all(s.space.contains(row.astype(s.space.dtype)) for row in action)
    hold(inside, f"actions leave {s.space}")
    single, _ = s.agent.predict(s.observation(0))
    hold(single.shape == s.space.shape, f"one observation gives an action of shape {single.shape}")


def _rows(s: Subject) -> None:
    """A row does not depend on its neighbours, nor on the size of the batch."""
    keys = np.arange(ROWS, dtype=np.uint64)
    for deterministic in (True, False):
        whole, _ = s.agent.predict(s.observation(), initial_state(s.agent, keys), None, deterministic)
        for row in (0, 17, ROWS - 1):
            one = slice(row, row + 1)
            alone, _ = s.agent.predict(
                s.observation(one), initial_state(s.agent, keys[one]), None, deterministic
            )
            np.testing.assert_allclose(alone[0], whole[row], atol=1e-5, err_msg=f"row {row}")


def _repeats(s: Subject) -> None:
    """The same seed learns the same."""
    again = s.fresh().learn(s.source)
    for one, other in zip(
        *(a.predict(s.observation(), deterministic=True)[:1] for a in (s.agent, again)), strict=True
    ):
        np.testing.assert_array_equal(one, other)


def _stores(s: Subject) -> None:
    """The agent that a fresh process loads acts as this one, bit for bit, and needs no torch to act."""
    with tempfile.TemporaryDirectory() as folder:
        checkpoint, batch, actions = (
            Path(folder) / name for name in ("agent.rise", "batch.npz", "action.npy")
        )
        s.agent.save(checkpoint)
        np.savez(batch, **s.parts)  # type: ignore[arg-type]  # NumPy has an option among the names
        files = map(str, (checkpoint, batch, actions))
        arguments = [s.name, s.env_id, json.dumps(s.config), *files, *plugins.imported()]
        command = [sys.executable, "-c", _ACTS, *arguments]
        done = subprocess.run(command, capture_output=True, text=True, check=False)  # noqa: S603  our own script
        hold(done.returncode == 0, f"a fresh process cannot load it: {done.stderr.strip().splitlines()[-1:]}")
        expected, _ = s.agent.predict(s.observation(), deterministic=True)
        np.testing.assert_array_equal(np.load(actions), expected)
        hold(not done.stdout.split(), f"acting imports {done.stdout.strip()}: import it where it learns")
        others = [env for env in ("RISE-GroundVehicle-v0", "RISE-SafePanda-v0") if env != s.env_id]
        try:
            load_agent(checkpoint, others[0])
        except CheckpointError as error:
            hold("trained on" in str(error), f"in another environment it says: {error}")
        else:
            raise ContractError("it is loaded for an environment that it was not trained on")


def _settings(s: Subject) -> None:
    """Unknown settings are refused with the nearest one."""
    known = fields(s.kind.Config)[0].name
    try:
        make_agent(s.name, s.env_id, {**s.config, f"{known}x": 1})
    except Exception as error:  # whatever an agent of somebody else raises
        wanted = f"a ValueError that names {known!r}, as of rise_agents.agent.make_config"
        fits = isinstance(error, ValueError) and repr(known) in str(error)
        hold(fits, f"a setting {known}x, which it has not, must be {wanted}, not {error!r}")
    else:
        raise ContractError(f"a setting {known}x, which it has not, is not refused")


def _untrained(s: Subject) -> None:
    """Acting and storing before learning is an error that says so."""
    agent = s.fresh()
    with tempfile.TemporaryDirectory() as folder:
        for what in (lambda: agent.predict(s.observation()), lambda: agent.save(Path(folder) / "agent.rise")):
            try:
                what()
            except RuntimeError as error:
                hold("learn" in str(error), f"before learning it says: {error}")
            else:
                raise ContractError("it acts, or stores itself, before it has learned")


def _finite(s: Subject) -> None:
    """Observations that are not finite are refused, with key and place."""
    key = "obstacle" if "obstacle" in s.parts else next(iter(s.parts))
    parts = {**s.parts, key: s.parts[key].astype(np.float64)}
    parts[key][5, 2] = np.nan
    try:
        s.agent.predict(s.observation(parts=parts))
    except ValueError as error:
        named = key in str(error) and "not finite at [5, 2]" in str(error)
        hold(named, f"a NaN at {key}[5, 2] is refused by {error}, which does not name it")
    else:
        raise ContractError("an observation with a NaN is not refused")


def _sources(s: Subject) -> None:
    """Who imitates refuses anything but demonstrations."""
    if s.kind.learns_from != "demonstrations":
        return
    try:
        s.fresh().learn(s.env_id)
    except ValueError as error:
        hold("Demonstrations" in str(error), f"an environment to learn from is refused by {error}")
    else:
        raise ContractError("it learns from something that is no demonstrations")


CHECKS: dict[str, Callable[[Subject], None]] = {
    "actions": _acts,
    "rows of a batch": _rows,
    "same seed, same agent": _repeats,
    "storing": _stores,
    "unknown settings": _settings,
    "before learning": _untrained,
    "finite observations": _finite,
    "sources": _sources,
}

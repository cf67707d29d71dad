"""C-PPO: proximal policy optimisation under a cost limit, trained in the environment.

PPO (Schulman et al. 2017) of stable-baselines3 with the PID-controlled Lagrange multiplier of Stooke, Achiam
and Abbeel (2020), see :mod:`rise_agents.lagrangian`. It is the baseline that learns by trial: from millions
of steps in the environment instead of demonstrations, with ``info["cost"]`` kept below a limit per episode.
Any Gymnasium environment with that cost will do (``frame="raw"``).

Shapes: B batch, K network inputs, A action dimensions.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, ClassVar

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.vector import VectorEnv
from numpy.typing import NDArray

from rise_agents import checkpoint, readings, shapes
from rise_agents.actor import Actor
from rise_agents.agent import (
    Progress,
    State,
    config_to_dict,
    draw_state,
    fresh_state,
    make_config,
    nearest,
    require,
    silent,
)
from rise_agents.cloning import make_task
from rise_agents.cppo_config import Config
from rise_agents.files import StrPath
from rise_agents.resume import Resume
from rise_agents.search import EVERYWHERE, Choice, LogRange, Space
from rise_agents.seeds import episode_seeds
from rise_agents.vec_env import action_bounds, as_vector_env, make_training_env, random_inputs
from rise_agents.workers import keep_freed_memory, one_thread
from rise_envs import ENVS
from rise_envs.task import Task

if TYPE_CHECKING:  # who only acts need not spend the second that importing torch and SB3 takes
    from rise_agents.bridge import Bridge
    from rise_agents.constrained_ppo import ConstrainedPPO

_STATISTICS_SAMPLES = 2048  # observations that the units of the inputs are taken from


class CPPO:
    """An agent that learns by constrained PPO; see the module's docstring.

    Args:
        env_id: a registered environment.
        config: settings that differ from the environment's preset, by the names of :class:`Config`.
        seed: of weights, exploration, batches and training episodes.
        device: a torch device for training; ``predict`` runs in NumPy.

    Raises:
        ValueError: an environment that is not registered, an unknown setting, one out of range, or a frame that the
            environment does not offer.
    """

    name = "cppo"
    Config = Config
    # Settings that serve an environment better than the defaults, found in the body frame on validation scenarios.
    # The Panda's learns on the batched model of the arm, where a million steps take a minute and a half (after
    # 600,000 some seeds still miss one goal in ten); it is judged in the engine like the others.
    PRESETS: ClassVar[dict[str, dict[str, Any]]] = {
        "RISE-GroundVehicle-v0": {
            **{"n_envs": 128, "n_steps": 64, "batch_size": 1024, "total_steps": 1_500_000},
            **{"learning_rate": 1e-3, "final_learning_rate": 5e-5},
        },
        "RISE-SafePanda-v0": {
            **{"train_env": "RISE-SafePandaKinematic-v0"},
            **{"n_envs": 64, "n_steps": 64, "batch_size": 512, "total_steps": 1_000_000},
            **{"learning_rate": 1e-3, "final_learning_rate": 5e-5},
            **{"gamma": 0.98, "cost_gamma": 0.98, "cost_limit": 0.02},
        },
    }
    BRIEF: ClassVar[dict[str, Any]] = {
        # In the environment itself: what compiles a batched arm takes longer than this training.
        **{"train_env": "", "total_steps": 2_048, "n_envs": 4, "n_steps": 32, "batch_size": 64},
        **{"restart_every": 3},
    }
    SEARCH: ClassVar[dict[str, Space]] = {
        EVERYWHERE: {
            "frame": Choice(("body", "features")),
            "total_steps": Choice((1_000_000, 2_000_000, 3_000_000)),
            "learning_rate": LogRange(3e-4, 3e-3),
            "gamma": Choice((0.97, 0.98, 0.99, 0.995)),
            "entropy_coef": Choice((0.0, 1e-3, 1e-2)),
            "cost_limit": LogRange(0.005, 0.2),
            "kp": LogRange(0.01, 1.0),
            "ki": LogRange(1e-3, 0.1),
        },
        "RISE-GroundVehicle-v0": {"total_steps": Choice((1_500_000, 2_500_000, 4_000_000))},
    }
    learns_from = "environment"
    evaluate_deterministic = True

    def __init__(
        self, env_id: str, config: dict[str, Any] | None = None, seed: int = 0, device: str = "cpu"
    ) -> None:
        self.env_id, self.seed, self.device = env_id, seed, device
        self.config = make_config(type(self), env_id, config or {})
        _check_known("env_id", env_id)
        if self.config.train_env:
            _check_known("train_env", self.config.train_env)
        self._task = self._describe()
        self._rng = np.random.default_rng(seed)
        self._arrays: dict[str, NDArray] = {}  # what training left behind, in the form that is stored
        self._notes: dict[str, Any] = {}
        self._actor: Actor | None = None

    def _describe(self) -> Task | None:
        if self.config.frame == "raw":
            return None
        try:
            return make_task(self.env_id)
        except ValueError as error:
            raise ValueError(f"{error}, or choose frame='raw'") from None

    def learn(
        self,
        source: str | gym.Env | VectorEnv | None = None,
        progress: Progress = silent,
        resume: Resume | StrPath | None = None,
    ) -> CPPO:
        """Train in ``source``: an environment id or a ready environment; see :class:`rise_agents.agent.Agent`.

        None and the agent's own id mean the environment that ``train_env`` names, if it names one.

        ``progress`` is told, after every update, ``steps``, ``lambda``, and of the last 100 episodes the mean
        ``return`` and ``cost``. To go on from ``resume`` to the same weights, an environment must be determined by the
        seed of its reset.

        Raises:
            ValueError: an environment without costs, with unbounded actions, with observations that the frame
                cannot read, or a vector environment in another autoreset mode than SAME_STEP.
            CheckpointError: the file to go on from is damaged or of another training.
        """
        kept = Resume.of(resume)
        if source is not None and not isinstance(source, str):
            venv = as_vector_env(source)
            name = f"{venv.num_envs} of {venv.spec.id if venv.spec else type(venv).__name__}, ready made"
            return self._learn(venv, progress, kept, name)
        if source in (None, self.env_id):
            source = self.config.train_env or self.env_id
        venv = make_training_env(str(source), self.config.n_envs)
        try:
            return self._learn(venv, progress, kept, str(source))
        finally:
            venv.close()

    @one_thread()
    def _learn(self, venv: VectorEnv, progress: Progress, kept: Resume, source: str) -> CPPO:
        from rise_agents.bridge import Bridge  # here and not above: see there

        keep_freed_memory()
        c, bounds = self.config, action_bounds(venv.single_action_space)
        ranks = self._ranks(venv.single_observation_space)
        c.check_batch(venv.num_envs)
        arrays, notes = kept.open(self, source)
        if arrays:
            kept.read(lambda: self._check_arrays(arrays))
        units = self._units(venv, arrays)
        bridge = Bridge(venv, lambda observation: units(self._inputs(observation)), len(units.mean))
        constants = units.arrays("units")
        if bounds is not None:
            constants |= {"action.low": bounds[0], "action.high": bounds[1]}
        ppo = self._trainer(bridge, kept.noting(progress))

        def store() -> None:
            weights, facts = ppo.snapshot()
            kept.save({**weights, **constants}, facts)

        ppo.at_restart = lambda: store() if kept.due() else None
        if arrays:
            kept.read(lambda: ppo.restore(arrays, notes, c.total_steps))
        if ppo.num_timesteps < c.total_steps:
            left = c.total_steps - ppo.num_timesteps
            # No logging: None is taken, whatever the annotation says.
            ppo.learn(left, log_interval=None, reset_num_timesteps=not arrays)  # type: ignore[arg-type]
            store()
        self._arrays, self._notes = ppo.snapshot()
        self._arrays |= constants
        self._notes["ranks"] = ranks
        self._actor = Actor(self._arrays)
        return self

    def _units(self, venv: VectorEnv, arrays: dict[str, NDArray]) -> readings.Standardiser:
        """Units of the network's inputs: those of an interrupted training, or of random episodes."""
        if arrays:
            return readings.Standardiser.from_arrays(arrays, "units")
        seeds = episode_seeds("train", self.seed, 0, venv.num_envs)
        return readings.Standardiser.fit(random_inputs(venv, self._inputs, seeds, _STATISTICS_SAMPLES))

    def _trainer(self, bridge: Bridge, progress: Progress) -> ConstrainedPPO:
        from stable_baselines3.common.logger import Logger

        from rise_agents.constrained_ppo import ConstrainedPPO

        c = self.config
        ppo = ConstrainedPPO(
            controller=c.controller(),
            cost_gamma=c.cost_gamma,
            cost_gae_lambda=c.cost_gae_lambda,
            cost_hidden=c.hidden,
            report=progress,
            restart_every=c.restart_every,
            env=bridge,
            learning_rate=_linear(c.learning_rate, c.final_learning_rate),
            n_steps=c.n_steps,
            batch_size=c.batch_size,
            n_epochs=c.n_epochs,
            gamma=c.gamma,
            gae_lambda=c.gae_lambda,
            clip_range=c.clip_range,
            ent_coef=c.entropy_coef,
            max_grad_norm=c.max_grad_norm,
            policy_kwargs={
                "net_arch": list(c.hidden),
                "log_std_init": c.log_std,
                "optimizer_kwargs": {"eps": 1e-5, "fused": True},  # SB3's ε; fused: one call, not dozens
            },
            seed=self.seed,
            device=self.device,
        )
        ppo.set_logger(Logger(folder=None, output_formats=[]))  # SB3's own makes a folder
        return ppo

    def _ranks(self, space: spaces.Space) -> dict[str, int]:
        """Number of dimensions of each part of one observation; refuses what the frame cannot read."""
        ranks = readings.observation_ranks(space)
        parts = space.spaces if isinstance(space, spaces.Dict) else {"": space}
        for key, width in self._task.widths.items() if self._task is not None else ():
            given = parts[key].shape if key in parts else None
            if given != (width,):
                hint = f"frame {self.config.frame!r} reads it, frame='raw' anything"
                raise ValueError(
                    f"observation {key!r} must be ({width},), the environment's is {given}: {hint}"
                )
        return ranks

    def _inputs(self, observation: Any) -> NDArray[np.float64]:
        """Network inputs (B, K) of a batched observation, in the environment's units."""
        if self._task is not None:
            return np.concatenate(readings.inputs(self._task, self.config.frame, observation), -1)
        parts = observation if isinstance(observation, dict) else {"": observation}
        flat = [np.asarray(parts[key], np.float64).reshape(len(parts[key]), -1) for key in sorted(parts)]
        return np.concatenate(flat, -1)

    def initial_state(self, keys: NDArray[np.uint64]) -> State:
        """Streams of exploration noise for episodes with the given keys (B,)."""
        return fresh_state(keys)

    def predict(
        self,
        observation: Any,
        state: State = None,
        episode_start: NDArray[np.bool_] | None = None,
        deterministic: bool = False,
    ) -> tuple[NDArray, State]:
        """Actions inside the bounds for one observation or a batch.

        Args:
            observation: the environment's, single or with a leading batch dimension.
            state: what the last call returned, or :meth:`initial_state`.
            episode_start: (B,), rows whose stream of noise starts anew.
            deterministic: the mean (or likeliest) action instead of a draw from the policy.

        Returns:
            Actions, float32 (int64 for discrete ones), and the state for the next call.

        Raises:
            RuntimeError: the agent has learned nothing yet.
            ValueError: a number that is not finite.
        """
        if self._actor is None:
            raise RuntimeError("this C-PPO agent is untrained: call learn() or load a checkpoint first")
        if self._task is not None:
            parts, single = readings.checked_batch(self._task, observation)
        else:
            parts, single = readings.checked_parts(observation, self._notes["ranks"])
        output = self._actor.output(self._inputs(parts))
        if not deterministic:
            keys, counter = draw_state(state, episode_start, len(output), self._rng)
            output = self._actor.explore(output, keys, counter)
            state = keys, counter + np.uint64(1)
        action = self._actor.action(output)
        return (action[0] if single else action), state

    def save(self, path: str | os.PathLike[str]) -> None:
        """Store all that acting and continued training need; :func:`rise_agents.load_agent` reads it.

        Raises:
            RuntimeError: the agent has learned nothing yet.
            ValueError: a number that is not finite.
        """
        if self._actor is None:
            raise RuntimeError("this C-PPO agent is untrained: call learn() before save()")
        description = {"agent": self.name, "env": self.env_id, "seed": self.seed, "notes": self._notes}
        checkpoint.save(path, self._arrays, {**description, "config": config_to_dict(self.config)})

    @classmethod
    def from_checkpoint(
        cls, arrays: dict[str, NDArray], description: dict[str, Any], device: str = "cpu"
    ) -> CPPO:
        """The agent that :meth:`save` stored; ``ValueError`` if the arrays are not those of its config."""
        agent = cls(description["env"], description["config"], description["seed"], device)
        agent._check_arrays(arrays)
        notes = description["notes"]
        if not all(type(rank) is int and type(key) is str for key, rank in notes["ranks"].items()):
            raise ValueError("ranks are not whole numbers by key")
        agent._arrays, agent._notes = arrays, notes
        agent._actor = Actor(arrays)
        return agent

    def _check_arrays(self, arrays: dict[str, NDArray]) -> None:
        arrays = {name: a for name, a in arrays.items() if not name.startswith("random.")}
        inputs, outputs = len(arrays["units.mean"]), len(arrays["policy.action_net.bias"])
        expected: shapes.Shapes = {"units.mean": (inputs,), "units.scale": (inputs,)}
        boxes = "action.low" in arrays
        if boxes:
            expected |= {"action.low": (outputs,), "action.high": (outputs,)}
        expected |= shapes.constrained_ppo(inputs, outputs, self.config.hidden, boxes)
        checkpoint.expect(arrays, expected)
        require(
            bool((arrays["units.scale"] > 0).all()), "units.scale must be positive", arrays["units.scale"]
        )
        if boxes:
            low, high = arrays["action.low"], arrays["action.high"]
            require(bool((low < high).all()), "action.low must lie below action.high", (low, high))


def _check_known(what: str, env_id: str) -> None:
    """Raise ``ValueError`` if an environment is not registered: no checkpoint could be stored, or loaded again.

    Looked up, not handed to Gymnasium, which would import the module that an id "module:name" names.
    """
    if env_id not in gym.registry:
        raise ValueError(
            f"{what}: no environment {env_id!r} is registered (gymnasium.register does so): {nearest(env_id, ENVS)}"
        )


def _linear(first: float, last: float) -> Callable[[float], float]:
    return lambda remaining: last + (first - last) * remaining

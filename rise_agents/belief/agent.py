"""``rise-belief``: RISE's idea carried through time, with a belief over the obstacle as its latent.

RISE encodes one reading as a distribution and acts on a sample of it. Here the distribution is over what the obstacle
truly is, it follows from all readings of the episode, and the policy acts with a margin that follows what is left of
the uncertainty:

1. A clone of the expert, a = π(s, g, c), is trained on true readings as they are (:mod:`rise_agents.clone`).
2. A belief q(c_t | readings up to t) = N(μ, diag σ²) is trained on the obstacles of the same demonstrations, read with
   errors of random size and kind (:mod:`.practice`), by the Gaussian likelihood, each term weighted by (σ + 0.01)^½
   (Seitzer et al., "On the pitfalls of heteroscedastic uncertainty estimation", ICLR 2022): without the weight, large
   errors are not learned from.
3. It acts on a = π(s, g, c̃), where c̃ is μ with a radius larger by ``margin`` · √(σ_p² + σ_r²), σ_p the root mean square
   deviation of a coordinate of the position. Nobody is nearer to an obstacle than any demonstration was: a
   belief that says so is moved off, since nothing can be cloned from where no expert has been.

With ``shield`` the action is held to what the robot's known kinematics say of the next step (:mod:`.shield`); without
it all is learned. The noise level is never told.

Shapes: B batch, N obstacles, D dimensions, C = 2D + 1 channels of an obstacle.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from rise_agents import clone, cloning, shapes
from rise_agents.agent import Progress, State, make_config, require, require_widths, silent
from rise_agents.belief import history, posterior
from rise_agents.belief.history import Readings
from rise_agents.belief.posterior import Frame
from rise_agents.belief.shield import Shield
from rise_agents.clone import Clone
from rise_agents.cloning import ActionUnits, CloningConfig, Lesson
from rise_agents.files import StrPath
from rise_agents.forward import Forward, layers_of, standardised
from rise_agents.readings import checked_batch
from rise_agents.resume import Resume
from rise_agents.search import EVERYWHERE, Choice, Space
from rise_agents.workers import one_thread

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Config(CloningConfig):
    """Settings of the agent, beside those of every cloned policy.

    Attributes:
        margin: deviations of the belief that the obstacle is taken to be larger by; 0: the belief's mean alone.
        shield: whether actions are held to what the known kinematics predict.
        memories: λ of each memory of readings: the weight of a reading falls by this factor in every step.
        belief_hidden: widths of the belief's hidden layers.
        belief_updates: gradient steps of the belief.
        belief_batch_size: noisy histories per step.
        belief_rows: noisy histories to learn from, made of the demonstrations.
    """

    frame: str = "features"
    margin: float = 1.0
    shield: bool = False
    memories: tuple[float, ...] = (1.0, 0.9, 0.7)
    belief_hidden: tuple[int, ...] = (128, 128)
    belief_updates: int = 6_000
    belief_batch_size: int = 2_048
    belief_rows: int = 400_000

    def __post_init__(self) -> None:
        super().__post_init__()
        require(0 <= self.margin < np.inf, "margin must not be negative, nor infinite", self.margin)
        fits = bool(self.memories) and all(0 < memory <= 1 for memory in self.memories)
        require(fits, "memories must be numbers above 0 and at most 1", self.memories)
        require_widths("belief_hidden", self.belief_hidden)
        for name in ("belief_updates", "belief_batch_size", "belief_rows"):
            require(getattr(self, name) >= 1, f"{name} must be at least 1", getattr(self, name))


class RiseBelief:
    """The agent; see the module's docstring.

    Args:
        env_id: a registered environment with a task description.
        config: settings that differ from the environment's preset, by the names of :class:`Config`.
        seed: of the weights, the order of the data and the noise that the belief learns from.
        device: where it trains (it acts in NumPy).
    """

    name = "rise-belief"
    Config = Config
    # Margins chosen on validation scenarios: where the way round an obstacle is short, as for the arm, less is needed.
    PRESETS: ClassVar[dict[str, dict[str, Any]]] = {
        "RISE-GroundVehicle-v0": {"margin": 2.0},
        "RISE-SafePanda-v0": {"margin": 0.5, "hidden": (256, 256), "frame": "body"},
    }
    BRIEF: ClassVar[dict[str, Any]] = {
        **{"updates": 300, "batch_size": 64},
        **{"belief_updates": 300, "belief_batch_size": 256, "belief_rows": 10_000},
    }
    SEARCH: ClassVar[dict[str, Space]] = {
        EVERYWHERE: {
            **cloning.SEARCH,
            "margin": Choice((0.25, 0.5, 1.0, 1.5, 2.0, 2.5)),
            "belief_updates": Choice((3_000, 6_000, 12_000)),
        }
    }
    ACTING: ClassVar[frozenset[str]] = frozenset({"margin", "shield"})
    learns_from = "demonstrations"
    evaluate_deterministic = True

    def __init__(self, env_id: str, config: dict[str, Any], seed: int = 0, device: str = "cpu") -> None:
        self.env_id, self.seed, self.device = env_id, seed, device
        self.config = make_config(type(self), env_id, config)
        self.task, self.units = cloning.make_task(env_id), ActionUnits.of(env_id)
        self.scale = np.asarray(self.task.noise_scale[: 2 * self.task.dim + 1])
        self._arrays: dict[str, NDArray] = {}

    @one_thread()
    def learn(
        self, source: Any, progress: Progress = silent, resume: Resume | StrPath | None = None
    ) -> RiseBelief:
        """Learn from :class:`rise_agents.demonstrations.Demonstrations`; see :class:`rise_agents.agent.Agent`."""
        c = self.config
        lesson = cloning.begin(self, source, progress, resume)
        share, tell = c.updates / (c.updates + c.belief_updates), lesson.progress
        weights = clone.train(lesson, c, lambda done, figures: tell(share * done, figures))
        weights |= self._train_belief(lesson, lambda done, figures: tell(share + (1 - share) * done, figures))
        d = lesson.demonstrations
        gaps = self._clearance(d.observations, d.observations["obstacle"].reshape(len(d.actions), -1))
        radius = self.task.split(d.observations["obstacle"])[2]
        nearest = {"nearest.clearance": np.array([gaps.min()]), "nearest.radius": np.array([radius.min()])}
        return self._use({**weights, **nearest, **Shield.fit(self.task, self.units, d)})

    def _train_belief(self, lesson: Lesson, progress: Progress) -> dict[str, NDArray]:
        import torch  # here and not above: it takes a second, which who only acts need not spend
        from torch import Tensor

        from rise_agents.belief.practice import practise
        from rise_agents.networks import mlp
        from rise_agents.readings import Standardiser
        from rise_agents.stages import to_arrays
        from rise_agents.training import fit

        c = self.config
        rows = practise(self.task, lesson.demonstrations, c.memories, c.belief_rows, self.seed)
        inputs = rows.inputs.astype(np.float64)
        units = Standardiser.fit(inputs)
        parts = (units(inputs), *rows.estimates, rows.truth)
        data = [torch.from_numpy(np.ascontiguousarray(part)).to(self.device) for part in parts]
        network = mlp(*self._sizes()).to(self.device)
        scale = torch.tensor(self.scale, dtype=torch.float32, device=self.device)

        def loss(seen: Tensor, *rest: Tensor) -> dict[str, Tensor]:
            offered, truth = posterior.Estimates(*rest[:-1]), rest[-1]
            mu, sigma = posterior.posterior(network(seen), offered, scale, len(c.memories))
            sigma = sigma / scale
            terms = 0.5 * ((truth - mu) / scale / sigma) ** 2 + sigma.log()
            weighted = terms * (sigma.detach() + 0.01).sqrt()
            return {"loss": weighted.sum(-1).mean(), "nll": terms.detach().sum(-1).mean()}

        fit(
            lesson.stages["belief"],
            network,
            loss,
            data,
            updates=c.belief_updates,
            batch_size=c.belief_batch_size,
            learning_rate=c.learning_rate,
            generator=lesson.generator,
            progress=progress,
        )
        return {**to_arrays(network, "belief"), **units.arrays("belief.units")}

    def _sizes(self) -> tuple[int, tuple[int, ...], int]:
        """Inputs, hidden widths and outputs of the belief's network."""
        d, memories = self.task.dim, len(self.config.memories)
        row = Readings(np.zeros((1, d)), np.zeros((1, d)), np.zeros(1))
        sums = history.remembered(history.nothing(1, memories, d), row, self.task.dt, self.config.memories)
        x = posterior.inputs(self.task, row, history.evidence(sums, d), np.ones(1), np.zeros((1, d)))
        return x.shape[1], self.config.belief_hidden, posterior.outputs(memories, d)

    def _use(self, arrays: dict[str, NDArray]) -> RiseBelief:
        self._arrays = arrays
        self._clone = Clone(self.task, self.config.frame, self.units, arrays)
        first, *rest = layers_of(arrays, "belief")
        mean, scale = arrays["belief.units.mean"], arrays["belief.units.scale"]
        self._network = Forward([standardised(first, mean, scale), *rest])
        self._shield = Shield(self.task, self.units, arrays)
        return self

    def initial_state(self, keys: NDArray[np.uint64]) -> tuple[NDArray, ...]:
        """Before the first reading of as many episodes as there are keys (B,): nothing is drawn from them.

        The frame that the episode begins in (origin (B, D), rotation (B, D, D)), the sums that are remembered
        (B, N, L, ·), and how many readings there were, (B,).
        """
        rows, d = len(keys), self.task.dim
        size = (rows, self.task.n_obstacles, len(self.config.memories), history.width(d))
        return np.zeros((rows, d)), np.zeros((rows, d, d)), np.zeros(size), np.zeros(rows)

    def believe(
        self, observation: dict[str, NDArray], state: State = None, episode_start: NDArray | None = None
    ) -> tuple[Array, Array, State]:
        """The belief after one more reading: μ and σ of each obstacle, (B, N, C) each, and the next state.

        μ is in the world, σ in the frame that the episode began in (x towards the goal).
        """
        rows, _ = checked_batch(self.task, observation)
        return self._believe(rows, state, episode_start)

    def _believe(
        self, rows: dict[str, Array], state: State, episode_start: NDArray | None
    ) -> tuple[Array, Array, tuple[NDArray, ...]]:
        return self._updated(rows, self._begun(rows, state, episode_start), self._network)

    def _updated(
        self, rows: dict[str, Array], begun: tuple[NDArray, ...], network: Callable[[Array], Any]
    ) -> tuple[Array, Array, tuple[NDArray, ...]]:
        """The belief after one more reading, from the state of episodes that have begun; see :meth:`believe`."""
        task, memories, batch = self.task, self.config.memories, len(rows["desired_goal"])
        origin, rotation, sums, steps = begun
        n, d = task.n_obstacles, task.dim
        frame = (
            Frame(np.repeat(origin, n, 0), np.repeat(rotation, n, 0)) if n > 1 else Frame(origin, rotation)
        )
        reading = frame.readings(task, rows["obstacle"].reshape(batch * n, -1))
        sums = history.remembered(sums.reshape(batch * n, *sums.shape[2:]), reading, task.dt, memories)
        steps = steps + 1.0
        seen = history.evidence(sums, d)
        goal = frame.point(np.repeat(rows["desired_goal"], n, 0))
        answer = network(posterior.inputs(task, reading, seen, np.repeat(steps, n), goal))
        offered = posterior.estimates(reading, seen)
        mu, sigma = posterior.posterior(answer, offered, self.scale, len(memories))
        mu, sigma = (part.reshape(batch, n, -1) for part in (frame.to_world(mu), sigma))
        return mu, sigma, (origin, rotation, sums.reshape(batch, n, *sums.shape[1:]), steps)

    def _begun(
        self, rows: dict[str, Array], state: State, episode_start: NDArray | None
    ) -> tuple[NDArray, ...]:
        """The state with the episodes begun that begin now."""
        batch = len(rows["desired_goal"])
        state = self.initial_state(np.zeros(batch, np.uint64)) if state is None else state
        steps = state[3]
        new = steps == 0 if episode_start is None else (steps == 0) | np.asarray(episode_start, bool)
        if not new.any():
            return state
        origin, rotation, sums, steps = (part.copy() for part in state)
        frame = Frame.of(self.task, rows["observation"][new], rows["desired_goal"][new])
        origin[new], rotation[new], sums[new], steps[new] = *frame, 0.0, 0.0
        return origin, rotation, sums, steps

    def predict(
        self,
        observation: dict[str, NDArray],
        state: State = None,
        episode_start: NDArray[np.bool_] | None = None,
        deterministic: bool = True,
    ) -> tuple[NDArray[np.float32], State]:
        """Actions (B, A) for a batch of observations, or (A,) for one; nothing is drawn.

        Args:
            observation: with the keys of the environment.
            state: what the last call returned, or :meth:`initial_state`; it holds what is remembered.
            episode_start: (B,), rows whose episode begins.
            deterministic: makes no difference.
        """
        if not self._arrays:
            raise cloning.untrained(self.name)
        rows, single = checked_batch(self.task, observation)
        mu, sigma, state = self._believe(rows, state, episode_start)
        careful = {**rows, "obstacle": self._careful(rows, mu, sigma)}
        action = self._clone(careful)
        if self.config.shield:
            action = self._shield(careful, action)
        return (action[0] if single else action), state

    def _careful(self, rows: dict[str, Array], mu: Array, sigma: Array) -> Array:
        """The readings (B, N·C) to act on: the belief with its margin, no nearer than any demonstration was."""
        c = self._widened(mu, sigma)
        lacking = self._lacking(rows, c)
        return (self._moved_off(rows, c, lacking) if (lacking > 0).any() else c).reshape(len(mu), -1)

    def _widened(self, mu: Array, sigma: Array) -> Array:
        """The belief's means (B, N, C), with radii larger by the margin."""
        d, c = self.task.dim, mu.copy()
        c[..., -1] += self.config.margin * np.sqrt((sigma[..., :d] ** 2).mean(-1) + sigma[..., -1] ** 2)
        return c

    def _lacking(self, rows: dict[str, Array], c: Array) -> Array:
        """How much nearer (m) obstacles (B, N, C) are than in any demonstration, (B, N)."""
        return self._arrays["nearest.clearance"][0] - self._clearance(rows, c.reshape(len(c), -1))

    def _moved_off(self, rows: dict[str, Array], c: Array, lacking: Array) -> Array:
        """Obstacles (B, N, C) made smaller and moved away until nothing is lacking; what was far enough stays."""
        d, c = self.task.dim, c.copy()
        lacking = np.maximum(lacking, 0.0)
        smaller = np.clip(c[..., -1] - self._arrays["nearest.radius"][0], 0.0, lacking)
        c[..., -1] -= smaller
        away = c[..., :d] - self.task.pose(rows["observation"])[0][:, None]
        distance = np.linalg.norm(away, axis=-1, keepdims=True)
        c[..., :d] += (lacking - smaller)[..., None] * away / np.maximum(distance, 1e-9)
        return c

    def _clearance(self, rows: dict[str, Array], reading: Array) -> Array:
        """Of the robot's reference ball from each obstacle (m), (B, N)."""
        position, _, radius = self.task.split(reading)
        origin, _ = self.task.pose(rows["observation"])
        return np.linalg.norm(position - origin[:, None], axis=-1) - radius - self.task.robot_radius

    def save(self, path: str | os.PathLike[str]) -> None:
        """Store the agent; :func:`rise_agents.load_agent` reads it."""
        cloning.save(path, self, self._arrays)

    @classmethod
    def from_checkpoint(
        cls, arrays: dict[str, NDArray], description: dict[str, Any], device: str
    ) -> RiseBelief:
        """The agent that :meth:`save` stored; ``ValueError`` if the arrays are not those of its config."""
        agent = cls(description["env"], description["config"], description["seed"], device)
        belief = agent._sizes()
        policy = clone.sizes(agent.config, sum(cloning.input_widths(agent)), agent.units.size)
        expected = {
            **shapes.mlp("policy", *policy),
            **shapes.mlp("belief", *belief),
            **dict.fromkeys(("belief.units.mean", "belief.units.scale"), (belief[0],)),
            **dict.fromkeys(("nearest.clearance", "nearest.radius"), (1,)),
            **Shield.shapes(),
        }
        cloning.check_arrays(agent, arrays, expected)
        require(bool((arrays["belief.units.scale"] > 0).all()), "belief.units.scale must be positive", "less")
        return agent._use(arrays)

"""RISE: Robust Imitation through Stochastic Encoding (Tayal, Tayal and Prakash), Algorithm 1.

Stage 1 trains a variational autoencoder on the readings c with the negative ELBO ::

    L = −log p_ψ(c | z) + β KL[q_φ(z | c) ‖ N(0, I)],   z = μ + σ ⊙ ε,   ε ~ N(0, I),

where p_ψ is a Gaussian whose deviation is the sensor's noise at level 1: reconstruction errors count in units
of the reading noise. Stage 2 freezes it and clones the expert's action a with a policy π_θ(s, g, z) ::

    L_π = 1/M Σ_m ℓ(π_θ(s, g, z⁽ᵐ⁾), a),   z⁽ᵐ⁾ = μ + σ ⊙ ε⁽ᵐ⁾,

so that the policy meets M plausible readings for each one. At inference z is drawn from the posterior of the
reading at hand.

Shapes: B batch, M samples, C reading inputs, Z latent.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from rise_agents import cloning, readings, shapes
from rise_agents.agent import (
    Progress,
    State,
    draw_state,
    fresh_state,
    make_config,
    require,
    require_widths,
    silent,
)
from rise_agents.cloning import ActionUnits, CloningConfig, Eyes, Lesson
from rise_agents.draws import NormalDraws
from rise_agents.files import StrPath
from rise_agents.forward import LOG_SIGMA_RANGE, Forward, layers_of, standardised
from rise_agents.resume import Resume
from rise_agents.search import EVERYWHERE, Choice, LogRange, Space
from rise_agents.workers import one_thread

if TYPE_CHECKING:
    from torch import Tensor, nn

    from rise_agents.networks import VAE

POSTERIORS = ("sample", "mean")
_ONE = np.uint64(1)
_LOG_SIGMA_RANGE = tuple(np.float32(bound) for bound in LOG_SIGMA_RANGE)


@dataclass(frozen=True)
class Config(CloningConfig):
    """Settings of RISE, beside those of every cloned policy.

    Attributes:
        latent: Z, size of the latent.
        beta: weight of the KL term. Larger: more robust to noise, less exact on clean readings.
        n_samples: M, posterior samples per transition in stage 2.
        encoder_hidden: widths of the encoder's hidden layers; the decoder mirrors them.
        vae_updates: gradient steps of stage 1.
        vae_batch_size: readings per step of stage 1.
        average: actions averaged over so many samples at inference (1: the paper's single draw).
        posterior: ``sample``: act on draws of z, as the paper; ``mean``: act on z = μ, and draw nothing.
    """

    latent: int = 5
    beta: float = 0.05
    n_samples: int = 8
    encoder_hidden: tuple[int, ...] = (64, 64)
    vae_updates: int = 10_000
    vae_batch_size: int = 256
    average: int = 1
    posterior: str = "sample"

    def __post_init__(self) -> None:
        super().__post_init__()
        require(0 <= self.beta < np.inf, "beta must not be negative, nor infinite", self.beta)
        require_widths("encoder_hidden", self.encoder_hidden)
        for name in ("latent", "n_samples", "vae_updates", "vae_batch_size", "average"):
            require(getattr(self, name) >= 1, f"{name} must be at least 1", getattr(self, name))
        require(self.posterior in POSTERIORS, f"posterior must be one of {POSTERIORS}", self.posterior)


class Rise:
    """The paper's agent.

    Args:
        env_id: a registered environment with a task description.
        config: settings that differ from :class:`Config`.
        seed: of the weights, the order of the data and the samples.
        device: where it trains (it acts in NumPy).
    """

    name = "rise"
    Config = Config
    PRESETS: ClassVar[dict[str, dict[str, Any]]] = {}
    BRIEF: ClassVar[dict[str, Any]] = {
        "updates": 300,
        "batch_size": 64,
        "vae_updates": 300,
        "vae_batch_size": 64,
    }
    SEARCH: ClassVar[dict[str, Space]] = {
        EVERYWHERE: {
            **cloning.SEARCH,
            "latent": Choice((5, 8)),
            "beta": LogRange(0.01, 0.1),  # less does as PC-BC, more costs too much on true readings
            "n_samples": Choice((4, 8)),
            "average": Choice((1, 16)),
        },
        # About as many latents as a reading has numbers: 7 here, 5 on the vehicle.
        "RISE-SafePanda-v0": {"latent": Choice((4, 5, 6, 7)), "beta": LogRange(0.005, 0.1)},
    }
    ACTING: ClassVar[frozenset[str]] = frozenset({"average", "posterior"})
    learns_from = "demonstrations"
    evaluate_deterministic = False  # the paper draws z from the posterior at inference

    def __init__(self, env_id: str, config: dict[str, Any], seed: int = 0, device: str = "cpu") -> None:
        self.env_id, self.seed, self.device = env_id, seed, device
        self.config = make_config(type(self), env_id, config)
        self.task, self.units = cloning.make_task(env_id), ActionUnits.of(env_id)
        self._rng = np.random.default_rng(seed)
        self._arrays: dict[str, NDArray] = {}

    @one_thread()
    def learn(self, source: Any, progress: Progress = silent, resume: Resume | StrPath | None = None) -> Rise:
        """Algorithm 1 on :class:`rise_agents.demonstrations.Demonstrations`; see :class:`rise_agents.agent.Agent`."""
        import torch  # here and not above: it takes a second, which who only acts need not spend

        from rise_agents.networks import VAE, mlp
        from rise_agents.stages import to_arrays

        c = self.config
        lesson = cloning.begin(self, source, progress, resume)
        data, eyes, tell = lesson.data, lesson.eyes, lesson.progress
        # Standard units → units of the reading noise: what the decoder answers in.
        sample = lesson.demonstrations.subsample(20_000)
        noise = readings.reading_units(self.task, c.frame, sample)
        ratio = torch.from_numpy((eyes.reading.scale / np.maximum(noise, 1e-9)).astype(np.float32)).to(
            self.device
        )
        share = c.vae_updates / (c.vae_updates + c.updates)

        vae = VAE(data.reading.shape[1], c.encoder_hidden, c.latent).to(self.device)
        self._fit_vae(vae, lesson, ratio, lambda done, figures: tell(share * done, figures))
        with torch.no_grad():
            mu, log_sigma = vae.encoder(data.reading)
        # Stage 2 sees samples of the latent with unit scale, which only renames its axes. The scale is that of
        # the samples, not of their means: where the posterior falls back to the prior all means coincide.
        spread = (mu.var(0) + (2 * log_sigma).exp().mean(0)).sqrt()
        policy = mlp(*self._policy_sizes(data.robot.shape[1])).to(self.device)
        self._fit_policy(
            policy,
            lesson,
            (mu / spread, log_sigma - spread.log()),
            lambda done, figures: tell(share + (1 - share) * done, figures),
        )
        weights = {**to_arrays(vae, "vae"), **to_arrays(policy, "policy")}
        scale = {"vae.spread": spread.cpu().numpy(), "vae.ratio": ratio.cpu().numpy()}
        return self._use({**eyes.arrays(), **weights, **scale})

    def _policy_sizes(self, robot: int) -> tuple[int, tuple[int, ...], int]:
        """Inputs, hidden widths and outputs of π(s, g, z)."""
        c = self.config
        return robot + c.latent, c.hidden, cloning.output_size(self.units.size, c.loss)

    def _fit_vae(self, vae: VAE, lesson: Lesson, ratio: Tensor, progress: Progress) -> None:
        """Stage 1 (lines 1 to 10): the autoencoder learns the readings of the demonstrations."""
        from rise_agents.training import fit  # which imports torch

        c, seen = self.config, lesson.data.reading

        def loss(reading: Tensor, target: Tensor) -> dict[str, Tensor]:
            epsilon = lesson.normal(len(reading), c.latent)
            return vae.loss(reading, target, epsilon, c.beta)

        fit(
            lesson.stages["vae"],
            vae,
            loss,
            (seen, seen * ratio),
            updates=c.vae_updates,
            batch_size=c.vae_batch_size,
            learning_rate=c.learning_rate,
            generator=lesson.generator,
            progress=progress,
        )

    def _fit_policy(
        self, policy: nn.Module, lesson: Lesson, posterior: tuple[Tensor, Tensor], progress: Progress
    ) -> None:
        """Stage 2 (lines 12 to 25): the policy learns their actions, on samples of the posterior."""
        from rise_agents.networks import policy_loss  # which imports torch
        from rise_agents.training import fit

        c, data = self.config, lesson.data

        def loss(robot: Tensor, mu: Tensor, log_sigma: Tensor, action: Tensor) -> dict[str, Tensor]:
            epsilon = lesson.normal(c.n_samples, len(mu), c.latent)
            return policy_loss(policy, robot, mu, log_sigma, action, epsilon, c.loss)

        fit(
            lesson.stages["policy"],
            policy,
            loss,
            (data.robot, *posterior, data.action),
            updates=c.updates,
            batch_size=c.batch_size,
            learning_rate=c.learning_rate,
            generator=lesson.generator,
            progress=progress,
        )

    def _use(self, arrays: dict[str, NDArray]) -> Rise:
        self._arrays = arrays
        self._eyes = Eyes.from_arrays(self.task, self.config.frame, arrays)
        # The networks act in the units of inputs, latent and actions, which saves their conversion at every step.
        first, *rest = layers_of(arrays, "vae.encoder.trunk")
        heads = [
            np.concatenate([arrays[f"vae.encoder.{head}.{part}"] for head in ("mu", "log_sigma")]).T
            for part in ("weight", "bias")
        ]
        units = self._eyes.reading
        self._encoder = Forward([standardised(first, units.mean, units.scale), *rest, (heads[0], heads[1])])
        first, *rest = layers_of(arrays, "policy")
        units, spread = self._eyes.robot, arrays["vae.spread"]
        mean, scale = np.append(units.mean, 0 * spread), np.append(units.scale, spread)
        self._policy = Forward([standardised(first, mean, scale), *rest[:-1], self.units.answering(rest[-1])])
        self._draws = NormalDraws(self.config.average * self.config.latent)
        return self

    def encode(self, reading: NDArray) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """The posterior of readings in their own units (B, C): μ and σ, each (B, Z)."""
        heads, size = self._encoder(reading), self.config.latent
        low, high = _LOG_SIGMA_RANGE
        return heads[:, :size], np.exp(np.minimum(np.maximum(heads[:, size:], low), high))

    def initial_state(self, keys: NDArray[np.uint64]) -> State:
        """Streams of posterior samples for episodes with the given keys (B,)."""
        return fresh_state(keys)

    def predict(
        self,
        observation: dict[str, NDArray],
        state: State = None,
        episode_start: NDArray[np.bool_] | None = None,
        deterministic: bool = False,
    ) -> tuple[NDArray[np.float32], State]:
        """Actions (B, A) for a batch of observations, or (A,) for one.

        Args:
            observation: with the keys of the environment.
            state: what the last call returned.
            episode_start: (B,), rows whose stream of samples starts anew.
            deterministic: act on the posterior mean instead of a sample, as with ``posterior="mean"`` always.
        """
        if not self._arrays:
            raise cloning.untrained(self.name)
        rows, single = readings.checked_batch(self.task, observation)
        robot, reading = self._eyes.inputs(rows)
        mu, sigma = self.encode(reading)
        if deterministic or self.config.posterior == "mean":
            action = self._act(robot, mu)
        else:
            keys, counter = draw_state(state, episode_start, len(mu), self._rng)
            epsilon, size = self._draws(keys, counter), self.config.latent
            action = self._act(robot, mu + sigma * epsilon[:, :size])
            for k in range(1, self.config.average):
                action += self._act(robot, mu + sigma * epsilon[:, k * size : (k + 1) * size])
            if self.config.average > 1:
                action /= self.config.average
            state = (keys, counter + _ONE)
        return (action[0] if single else action), state

    def _act(self, robot: NDArray, z: NDArray[np.float32]) -> NDArray[np.float32]:
        """Actions of π(s, g, z) inside the bounds."""
        return self.units.clip(self._policy(robot, z))

    def save(self, path: str | os.PathLike[str]) -> None:
        """Store the agent; :func:`rise_agents.load_agent` reads it."""
        cloning.save(path, self, self._arrays)

    @classmethod
    def from_checkpoint(cls, arrays: dict[str, NDArray], description: dict[str, Any], device: str) -> Rise:
        """The agent that :meth:`save` stored; ``ValueError`` if the arrays are not those of its config."""
        agent = cls(description["env"], description["config"], description["seed"], device)
        c, (robot, reading) = agent.config, cloning.input_widths(agent)
        expected = {
            **{"vae.spread": (c.latent,), "vae.ratio": (reading,)},
            **shapes.vae("vae", reading, c.encoder_hidden, c.latent),
            **shapes.mlp("policy", *agent._policy_sizes(robot)),
        }
        cloning.check_arrays(agent, arrays, expected)
        require(bool((arrays["vae.spread"] > 0).all()), "vae.spread must be positive", arrays["vae.spread"])
        return agent._use(arrays)

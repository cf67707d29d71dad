"""Presets: how much is trained and measured, by name. A new one is an entry of :data:`PRESETS`."""

from __future__ import annotations

from dataclasses import dataclass

VEHICLE, PANDA = "RISE-GroundVehicle-v0", "RISE-SafePanda-v0"


@dataclass(frozen=True)
class Block:
    """Rows that are measured and compared with each other, under the same conditions.

    Attributes:
        title: what it asks, as pages say.
        agents: the rows, as :class:`benchmarks.protocol.Plan` has them.
        noise_models: each at all levels.
        noise_levels: multiples of the environment's noise scale.
        seeds: training seeds, the first of the run's.
        envs: only there; everywhere if empty.
    """

    title: str
    agents: tuple[str, ...]
    noise_models: tuple[str, ...]
    noise_levels: tuple[float, ...]
    seeds: int
    envs: tuple[str, ...] = ()


@dataclass(frozen=True)
class Preset:
    """How much is trained and measured.

    Attributes:
        demos: episodes of demonstrations per environment.
        episodes: test scenarios per condition.
        noise_levels: multiples of the environment's noise scale.
        seeds: training seeds.
        agents: the rows.
        noise_models: each at all levels.
        blocks: what else is measured, where the rows are those of the preset.
        clips: scenarios that a video shows.
        brief: whether agents train only as long as it takes to see that all works (their ``BRIEF``).
        tuned: whether the settings of ``benchmarks/configs/tuned.toml`` hold, if that is there.
    """

    demos: int
    episodes: int
    noise_levels: tuple[float, ...]
    seeds: int
    agents: tuple[str, ...] = ("rise", "pcbc", "cppo")
    noise_models: tuple[str, ...] = ("step",)
    blocks: tuple[Block, ...] = ()
    clips: int = 3
    brief: bool = False
    tuned: bool = False


def _control(
    title: str, *agents: str, envs: tuple[str, ...] = (), levels: tuple[float, ...] = (0.0, 1.0, 2.0)
) -> Block:
    """Rows of three training seeds under the paper's noise."""
    return Block(title, agents, ("step",), levels, 3, envs)


_BELIEF = ("rise-belief-mean", "rise-belief", "rise-belief-shield")
_UNTRAINED = ("drift:0.3", "dropout:0.7+step", "step+delay:5", "outlier")  # noise that no agent has met
_PAPER = (
    Block("Belief, margin, shield", _BELIEF, ("step", "episode"), (0.0, 1.0, 2.0), 5),
    Block(
        "An error of positions alone",
        ("rise", "pcbc", "cppo", *_BELIEF[1:], "expert-cbf"),
        ("episode@position",),
        (0.5, 1.0, 2.0),
        5,
        (VEHICLE,),
    ),
    Block(
        "Noise of other kinds",
        ("rise", "pcbc", *_BELIEF[1:], "expert-cbf"),
        ("episode@position", *_UNTRAINED),
        (1.0,),
        3,
    ),
    _control("Is it the encoder?", "rise", "rise-mean", "rise-beta0", "pcbc", "pcbc-as-rise", "pcbc-noisy"),
    _control("Draws of z at inference", "rise", "rise-one-draw", "rise-mean", envs=(PANDA,)),
    _control("Is C-PPO trained to its end?", "cppo", "cppo-long"),
    _control("10,000 transitions", "rise-10k", "pcbc-10k", "rise-belief-10k"),
    _control(
        "A Kalman filter that knows the noise level",
        *("rise+kalman", "pcbc+kalman", "expert-cbf+kalman", "expert-cbf", "rise-belief"),
        levels=(1.0, 2.0),
    ),
    _control("β", "rise", "rise-beta0.1", "rise-beta0.2", "rise-beta0.5"),
    _control("β, further", "rise", "rise-beta0.01", "rise-beta0.02", "rise-beta1", envs=(VEHICLE,)),
    _control("M, samples per transition", "rise", "rise-m1", "rise-m4", "rise-m16", envs=(VEHICLE,)),
    _control("Z, size of the latent", "rise", "rise-z2", "rise-z10", envs=(VEHICLE,)),
    _control(
        "The frame",
        *("rise-world", "rise-body", "rise-features", "pcbc-world", "pcbc-body", "pcbc-features"),
        envs=(VEHICLE,),
    ),
    _control("One expert or their mixture", "rise", "rise-cbf", "rise-mpc", envs=(VEHICLE,)),
    _control("Experts", "expert", "expert-cbf+true", "random", envs=(VEHICLE,)),
)
PRESETS = {
    "smoke": Preset(demos=24, episodes=16, noise_levels=(1.0,), seeds=1, clips=1, brief=True),
    "quick": Preset(demos=1_000, episodes=1_000, noise_levels=(0.0, 0.5, 1.0, 2.0), seeds=1),
    "paper": Preset(
        demos=10_000,
        episodes=1_000,
        noise_levels=(0.0, 0.25, 0.5, 1.0, 1.5, 2.0),
        seeds=5,
        agents=("rise", "pcbc", "cppo", "rise-belief", "rise-belief-shield", "expert-cbf"),
        noise_models=("step", "episode"),
        blocks=_PAPER,
        tuned=True,
    ),
}

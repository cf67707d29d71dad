"""The work of a search: studies, their trials, and the jobs that train and judge them."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from benchmarks import results
from benchmarks.jobs import Job, train
from benchmarks.protocol import digest
from benchmarks.tune.ranking import CLEAN, MODEL, NOISY, Rates
from rise_agents import __version__, agent_class, load_agent
from rise_agents.agent import Progress, config_to_dict, make_config
from rise_agents.rollout import rollout
from rise_agents.search import Choice, draw, space_of
from rise_agents.seeds import episode_seeds


@dataclass(frozen=True, eq=False)  # compared by identity: settings are dicts, which have no hash
class Study:
    """One row in one environment, and what is tried there.

    Attributes:
        row: an agent, or a variant of one.
        agent: who is trained for it, a registered name.
        env: where it is meant to act.
        eval_env: where it is judged: ``env`` or what stands in for it.
        scenarios: validation scenarios that it is judged on.
        trials: settings that differ from the agent's defaults; the first of them are the row's own.
        data: the demonstrations to learn from, if it imitates.
        source: names them by their content.
    """

    row: str
    agent: str
    env: str
    eval_env: str
    scenarios: int
    trials: tuple[dict[str, Any], ...]
    data: Path | None = None
    source: str = ""

    @property
    def name(self) -> str:
        """As settings files call it."""
        return f"{self.row}@{self.env}"

    def settings(self, trial: int) -> dict[str, Any]:
        """All settings of a trial, defaults included."""
        return config_to_dict(make_config(agent_class(self.agent), self.env, self.trials[trial]))

    def checkpoint(self, trial: int, seed: int, out: Path) -> Path:
        """Where the agent of a trial lies."""
        facts = (__version__, self.env, self.agent, seed, self.settings(trial), self.source)
        return out / "agents" / self.env / f"{self.agent}-seed{seed}-{digest(*facts)}.rise"

    def result(self, trial: int, seed: int, out: Path) -> Path:
        """Where its rates lie."""
        judged = (self.checkpoint(trial, seed, out).name, self.eval_env, self.scenarios, MODEL, CLEAN, NOISY)
        return out / "trials" / self.env / f"{self.agent}-seed{seed}-{digest(*judged)}.json"

    def jobs(self, trial: int, seed: int, out: Path, every: float) -> list[Job]:
        """Train and judge a trial; ``every`` so many seconds the training stores its state."""
        checkpoint, result = self.checkpoint(trial, seed, out), self.result(trial, seed, out)
        which = f"{self.row} on {self.env}, trial {trial}, seed {seed}"
        learn: dict[str, Any] = {"env": self.env, "agent": self.agent, "seed": seed, "data": self.data}
        learn |= {"config": self.trials[trial], "device": "cpu", "every": every}
        tell: dict[str, Any] = {"checkpoint": checkpoint, "env": self.eval_env, "scenarios": self.scenarios}
        tell["facts"] = {"agent": self.agent, "env": self.env, "seed": seed, "settings": self.trials[trial]}
        return [
            Job(f"train {which}", train, learn, checkpoint, weight=10.0 if self.data else 100.0),
            Job(f"judge {which}", judge, tell, result, needs=(checkpoint,)),
        ]

    def rates(self, trial: int, seed: int, out: Path) -> Rates | None:
        """What a trial reached; None if it was not measured.

        Raises:
            ValueError: the file holds something else.
        """
        path = self.result(trial, seed, out)
        return Rates(*read_result(path)["rates"].values()) if path.exists() else None


def drawn_trials(
    agent: str,
    env: str,
    count: int,
    own: dict[str, Any],
    variant: str = "",
    tried: Mapping[str, Sequence[Any]] = MappingProxyType({}),
) -> tuple[dict[str, Any], ...]:
    """The settings of ``count`` trials: the row's own, then random ones.

    A trial's settings depend on row, environment and its number only: a longer search begins like a short one.

    Args:
        agent: who is trained.
        env: where.
        count: how many.
        own: settings of the row, the same in all trials but for those that are tried.
        variant: the row, if it is not the agent itself.
        tried: values to try, beside what the agent's class declares.

    Raises:
        ValueError: the agent declares no space, or a setting is unknown or out of range.
    """
    space = {
        **space_of(agent_class(agent), env),
        **{name: Choice(tuple(each)) for name, each in tried.items()},
    }
    fixed = {name: value for name, value in own.items() if name not in tried}
    trials = [own]
    for number in range(1, count):
        rng = np.random.default_rng([int(digest(variant or agent, env), 16), number])
        trials.append({**draw(space, rng), **fixed})
    for settings in trials:
        make_config(agent_class(agent), env, settings)
    return tuple(trials)


def condition(agent: str, transitions: int) -> dict[str, Any]:
    """The setting that says from how many transitions an agent learns (0: all); empty where it has none."""
    known = {field.name for field in fields(agent_class(agent).Config)}
    return {"transitions": transitions} if "transitions" in known else {}


def judge(
    output: Path, progress: Progress, checkpoint: Path, env: str, scenarios: int, facts: dict[str, Any]
) -> None:
    """Run a trained agent through the validation scenarios at both noise levels; writes its rates."""
    agent: Any = load_agent(checkpoint)
    seeds = episode_seeds("validation", 0, 0, scenarios)
    done = 0

    def tell(count: int) -> None:
        nonlocal done
        done += count
        progress(done / (2 * scenarios), {})

    rates: list[float] = []
    for level in (CLEAN, NOISY):
        episodes, _ = rollout(
            agent,
            env,
            seeds,
            noise=MODEL,
            noise_level=level,
            deterministic=agent.evaluate_deterministic,
            finished=tell,
        )
        rates += [float(episodes.safe.mean()), float(episodes.reached.mean())]
    seconds = json.loads(checkpoint.with_suffix(".json").read_text())["seconds"]
    found = {**facts, "judged_on": env, "scenarios": scenarios, "training_seconds": seconds}
    found["rates"] = Rates(*rates)._asdict()
    results.atomic_write_text(output, json.dumps(found, indent=2) + "\n")


def read_result(path: Path) -> dict[str, Any]:
    """What :func:`judge` wrote.

    Raises:
        ValueError: the file holds something else.
    """
    try:
        found = json.loads(path.read_text())
        rates = found["rates"]
        fits = list(rates) == list(Rates._fields) and all(0 <= rate <= 1 for rate in rates.values())
    except (OSError, ValueError, LookupError, TypeError, AttributeError):
        fits = False
    if not fits:
        raise ValueError(f"{path} holds no rates of a trial: remove it, and they are measured again")
    return found

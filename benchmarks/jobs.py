"""The pieces of work of a run. A job is a pure function of its arguments that ends by writing its output file.

A job whose output exists is done, whoever did it and whenever: that is all there is to resuming. File names
carry a digest of the version and of all settings that the file depends on, so changed settings never meet old
results.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benchmarks import results
from benchmarks.policies import make_policy
from benchmarks.protocol import Plan, Scenarios, digest, imitates
from benchmarks.videos import record
from rise_agents import AGENTS, __version__, agent_class, checkpoint, demonstrations, make_agent, pretrained
from rise_agents.agent import Progress, config_to_dict, make_config
from rise_agents.demonstrations import recording
from rise_agents.resume import Resume
from rise_agents.rollout import rollout

PARTS = "parts"  # folder for the pieces of demonstrations that are being recorded


@dataclass(frozen=True)
class Job:
    """A piece of work.

    Attributes:
        name: for people.
        run: module-level function ``run(output, progress, **arguments)``.
        arguments: its arguments.
        output: the file whose existence says that the job is done.
        needs: outputs of other jobs that must exist first.
        weight: rough relative duration; long jobs start first.
    """

    name: str
    run: Callable[..., None]
    arguments: dict[str, Any]
    output: Path
    needs: tuple[Path, ...] = ()
    weight: float = 1.0


def demonstrations_folder(plan: Plan, env: str, out: Path) -> Path:
    """Where the demonstrations of a plan lie."""
    return out / "demonstrations" / f"{env}-{digest(__version__, env, plan.expert, plan.demos)}"


def checkpoint_path(plan: Plan, env: str, agent: str, seed: int, out: Path) -> Path:
    """Where a trained agent of a plan lies."""
    if plan.pretrained:
        return pretrained.file_of(agent, env)
    source = [plan.expert, plan.demos] if imitates(agent) else []
    mark = digest(__version__, env, agent, seed, complete_settings(plan, env, agent), source)
    return out / "agents" / env / f"{agent}-seed{seed}-{mark}.rise"


def complete_settings(plan: Plan, env: str, agent: str) -> dict[str, Any]:
    """All settings of a trained agent, the plan's and its own defaults; of a shipped one those it was trained with.

    Raises:
        ValueError: one is unknown or out of range.
        CheckpointError: a shipped agent cannot be used.
    """
    if plan.pretrained:
        return checkpoint.load(pretrained.find(agent, env))[1]["config"]
    return config_to_dict(make_config(agent_class(agent), env, plan.config(agent, env)))


def recording_jobs(plan: Plan, out: Path) -> list[Job]:
    """For each environment in which somebody imitates: a job per piece of demonstrations, one to put them together."""
    jobs = []
    for env in plan.envs:
        if not any(plan.learns_from_expert(agent) for agent in plan.agents):
            continue
        folder = demonstrations_folder(plan, env, out)
        output, parts = folder / demonstrations.DATA, folder / PARTS
        recorded = {"env": env, "expert": plan.expert, "episodes": plan.demos}
        count, pieces = recording.chunk_size(plan.demos), []
        if not output.exists():  # else they are not needed, and gone
            for start in range(0, plan.demos, count):
                arguments = {"env_id": env, "expert": plan.expert, "seed": 0, "start": start, "count": count}
                path = recording.part_path(parts, start)
                pieces.append(Job(f"record {plan.expert} on {env}", recording.record_part, arguments, path))
        needs = tuple(piece.output for piece in pieces)
        jobs += [*pieces, Job(f"collect demonstrations of {env}", collect, recorded, output, needs)]
    return jobs


def training_jobs(plan: Plan, out: Path, device: str, every: float) -> list[Job]:
    """One job for each agent, environment and training seed; ``every`` so many seconds they store their state."""
    jobs = []
    for env in plan.envs:
        for agent, seed in plan.rows(env):
            if agent not in AGENTS or plan.pretrained:
                continue
            folder = demonstrations_folder(plan, env, out)
            clones = imitates(agent)
            arguments: dict[str, Any] = {
                "env": env,
                "agent": agent,
                "seed": seed,
                "config": plan.config(agent, env),
            }
            arguments |= {"data": folder if clones else None, "device": device, "every": every}
            output = checkpoint_path(plan, env, agent, seed, out)
            name = f"train {agent} on {env}" + (f", seed {seed}" if plan.seeds > 1 else "")
            needs = (folder / demonstrations.DATA,) if clones else ()
            jobs.append(Job(name, train, arguments, output, needs, weight=10.0 if clones else 100.0))
    return jobs


def tidy(out: Path) -> None:
    """Remove what a kill in the last lines of a job left: states of finished trainings, pieces of finished sets."""
    for state in out.glob("agents/*/*.training"):
        if state.with_suffix(".rise").exists():
            state.unlink()
    for parts in out.glob(f"demonstrations/*/{PARTS}"):
        if (parts.parent / demonstrations.DATA).exists():
            shutil.rmtree(parts)


def evaluation_jobs(plan: Plan, out: Path) -> list[Job]:
    """One job for each row, noise level and portion of the scenarios."""
    jobs = []
    for env in plan.envs:
        for row, seed in plan.rows(env):
            trained = checkpoint_path(plan, env, row, seed, out) if row in AGENTS else None
            for level in plan.noise_levels:
                for part in plan.chunks(env):
                    arguments: dict[str, Any] = {"env": env, "row": row, "seed": seed, "checkpoint": trained}
                    arguments |= {"noise_model": plan.noise_model, "noise_level": level, "scenarios": part}
                    mark = digest(
                        env,
                        row,
                        seed,
                        _source(plan, trained),
                        plan.noise_model,
                        level,
                        part.start,
                        part.count,
                    )
                    output = (
                        out
                        / "parts"
                        / env
                        / f"{row}-seed{seed}-{plan.noise_model}{level:g}-{part.start}-{mark}.parquet"
                    )
                    name = f"evaluate {row} on {env} at noise {level:g}"
                    jobs.append(Job(name, evaluate, arguments, output, (trained,) if trained else ()))
    return jobs


def video_jobs(plan: Plan, out: Path) -> list[Job]:
    """One clip for each row of the tables, of its first training seed, at the headline noise level."""
    level = min(plan.noise_levels, key=lambda x: (abs(x - 1), x))
    jobs = []
    for env in plan.envs:
        for row, seed in plan.rows(env):
            if seed:
                continue
            trained = checkpoint_path(plan, env, row, 0, out) if row in AGENTS else None
            seeds = [int(s) for s in Scenarios(0, min(plan.clips, plan.episodes)).seeds()]
            arguments: dict[str, Any] = {"env": env, "row": row, "checkpoint": trained, "seeds": seeds}
            arguments |= {"noise_model": plan.noise_model, "noise_level": level}
            mark = digest(env, row, _source(plan, trained), plan.noise_model, level, seeds)
            output = out / "videos" / f"{env}-{row}-{mark}.mp4"
            needs = (trained,) if trained else ()
            jobs.append(Job(f"draw {row} on {env}", record, arguments, output, needs, weight=2.0))
    return jobs


def _source(plan: Plan, trained: Path | None) -> str:
    """What stands for a policy in the names of its results."""
    if trained is None:
        return __version__
    # The name of a shipped file says nothing of its weights, which may be other ones in the next version.
    return pretrained.sha256(trained) if plan.pretrained else trained.name


def check_settings(plan: Plan) -> None:
    """Raise ``ValueError`` if a setting of a trained agent is unknown or out of range, or a shipped one is damaged."""
    for env in plan.envs:
        for agent in plan.agents:
            if agent in AGENTS:
                try:
                    complete_settings(plan, env, agent)
                except (TypeError, ValueError, checkpoint.CheckpointError) as error:
                    raise ValueError(f"settings of {agent}: {error}") from None


def collect(output: Path, progress: Progress, env: str, expert: str, episodes: int) -> None:
    """Put the recorded pieces together (recording more where too many episodes were rejected); removes them."""
    parts = output.parent / PARTS

    def tell(kept: int, tried: int) -> None:
        progress(kept / episodes, {"kept": kept, "tried": tried})

    demonstrations.generate(env, expert, episodes, finished=tell, parts=parts).save(output.parent)
    shutil.rmtree(parts)


def train(
    output: Path,
    progress: Progress,
    env: str,
    agent: str,
    seed: int,
    config: dict[str, Any],
    data: Path | None,
    device: str,
    every: float,
) -> None:
    """Train one agent, from where it was interrupted; writes its checkpoint and a JSON record of the training."""
    resume = Resume(output.with_suffix(".training"), every)
    learner = make_agent(agent, env, config, seed, device)
    learner.learn(env if data is None else demonstrations.load(data), progress, resume)
    record = {"seconds": round(resume.seconds, 1), "device": device, "curve": resume.curve}
    results.atomic_write_text(output.with_suffix(".json"), json.dumps(record) + "\n")
    learner.save(output)
    Path(output.with_suffix(".training")).unlink(missing_ok=True)


def evaluate(
    output: Path,
    progress: Progress,
    env: str,
    row: str,
    seed: int,
    checkpoint: Path | None,
    noise_model: str,
    noise_level: float,
    scenarios: Scenarios,
) -> None:
    """Run one policy through a portion of the scenarios; writes a row per episode."""
    policy = make_policy(env, row, checkpoint)
    seeds, done = scenarios.seeds(), 0

    def tell(count: int) -> None:
        nonlocal done
        done += count
        progress(done / len(seeds), {})

    episodes, _ = rollout(
        policy,
        env,
        seeds,
        noise=noise_model,
        noise_level=noise_level,
        deterministic=getattr(policy, "evaluate_deterministic", True),
        finished=tell,
    )
    table = results.from_columns(
        {
            "env": env,
            "agent": row,
            "train_seed": seed,
            "noise_model": noise_model,
            "noise_level": float(noise_level),
            "scenario": range(scenarios.start, scenarios.start + scenarios.count),
            "env_seed": seeds,
            "noise_seed": seeds,
            "safe": episodes.safe,
            "arrived": episodes.arrived,
            "reached": episodes.reached,
            "steps": episodes.steps,
            "episode_cost": episodes.cost,
            "min_clearance": episodes.min_clearance,
            "episode_return": episodes.episode_return,
        }
    )
    results.write_rows(output, table)

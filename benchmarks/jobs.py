"""The pieces of work of a run. A job is a pure function of its arguments that ends by writing its output file.

A job whose output exists is done, whoever did it and whenever: that is all there is to resuming. File names
carry a digest of the version and of all settings that the file depends on, so changed settings never meet old
results.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from benchmarks import results
from benchmarks.labels import TRUE, agent_label, split_row
from benchmarks.policies import make_policy
from benchmarks.protocol import Plan, Scenarios, digest, imitates
from benchmarks.trajectories import draws
from benchmarks.videos import record
from rise_agents import __version__, agent_class, checkpoint, demonstrations, figures, make_agent, pretrained
from rise_agents.agent import Progress, acting_settings, config_to_dict, make_config
from rise_agents.demonstrations import recording
from rise_agents.resume import Resume
from rise_agents.rollout import rollout
from rise_envs.task import describes_task

_Actor = tuple[list[Any], dict[str, Any]]  # see actor_of
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
        weight: rough relative duration; long jobs start first where nothing else is said.
    """

    name: str
    run: Callable[..., None]
    arguments: dict[str, Any]
    output: Path
    needs: tuple[Path, ...] = ()
    weight: float = 1.0


def demonstrations_folder(plan: Plan, env: str, out: Path, expert: str = "") -> Path:
    """Where the demonstrations of an expert lie: the plan's, if no other is named."""
    return out / "demonstrations" / f"{env}-{digest(__version__, env, expert or plan.expert, plan.demos)}"


def checkpoint_path(plan: Plan, env: str, row: str, seed: int, out: Path) -> Path:
    """Where the trained agent of a row lies; rows whose training is the same share it."""
    if plan.pretrained:
        return plan.shipped(row, env)
    agent = plan.agent_of(row)
    source = [plan.expert_of(row), plan.demos] if imitates(agent) else []
    mark = digest(__version__, env, agent, seed, training_settings(plan, env, row), source)
    return out / "agents" / env / f"{agent}-seed{seed}-{mark}.rise"


def checkpoint_name(plan: Plan, trained: Path, out: Path) -> str:
    """A checkpoint as ``run.json`` names it."""
    if plan.pretrained:
        return f"{trained.name} of rise_agents.pretrained, SHA-256 {pretrained.sha256(trained)}"
    return str(trained.relative_to(out))


def complete_settings(plan: Plan, env: str, row: str) -> dict[str, Any]:
    """All settings of a row's agent, the plan's and its own defaults; of a shipped one those it was trained with.

    Raises:
        ValueError: one is unknown or out of range.
        CheckpointError: a shipped agent cannot be used.
    """
    kind, chosen = agent_class(plan.agent_of(row)), plan.config(row, env)
    if not plan.pretrained:
        return config_to_dict(make_config(kind, env, chosen))
    path = plan.shipped(row, env)
    stored = config_to_dict(make_config(kind, env, checkpoint.load(path)[1]["config"]))
    settings = config_to_dict(make_config(kind, env, {**stored, **chosen}))
    acting = acting_settings(kind)
    for name, value in stored.items():
        if settings[name] != value and name not in acting:
            free = f"only {', '.join(sorted(acting))} can be chosen" if acting else "none can be chosen"
            raise ValueError(f"{path.name} was trained with {name} = {value}, not {settings[name]}: {free}")
    return settings


def training_settings(plan: Plan, env: str, row: str) -> dict[str, Any]:
    """All settings that the training of a row's agent depends on."""
    settings, acting = complete_settings(plan, env, row), acting_settings(agent_class(plan.agent_of(row)))
    return {key: value for key, value in settings.items() if key not in acting}


def how_it_acts(plan: Plan, env: str, row: str) -> dict[str, Any]:
    """All settings by which a row's agent acts; none for what is not trained."""
    agent = plan.agent_of(row)
    if not agent:
        return {}
    acting = acting_settings(agent_class(agent))
    return {key: value for key, value in complete_settings(plan, env, row).items() if key in acting}


def recording_jobs(plan: Plan, out: Path) -> list[Job]:
    """For each expert from whom somebody learns: a job per piece of demonstrations, one to put them together."""
    jobs = []
    for env in plan.envs:
        for expert in plan.experts(env):
            folder = demonstrations_folder(plan, env, out, expert)
            output, parts = folder / demonstrations.DATA, folder / PARTS
            recorded = {"env": env, "expert": expert, "episodes": plan.demos}
            count, pieces = recording.chunk_size(plan.demos), []
            if not output.exists():  # else they are not needed, and gone
                for start in range(0, plan.demos, count):
                    arguments = {"env_id": env, "expert": expert, "seed": 0, "start": start, "count": count}
                    path = recording.part_path(parts, start)
                    pieces.append(Job(f"record {expert} on {env}", recording.record_part, arguments, path))
            needs = tuple(piece.output for piece in pieces)
            by = "" if expert == plan.expert else f" by {expert}"
            jobs += [
                *pieces,
                Job(f"collect demonstrations of {env}{by}", collect, recorded, output, needs),
            ]
    return jobs


def training_jobs(plan: Plan, out: Path, device: str, every: float) -> list[Job]:
    """One job for each training that rows need; ``every`` so many seconds they store their state."""
    jobs: dict[Path, Job] = {}
    for env in plan.envs:
        for row, seed in plan.rows(env):
            agent = plan.agent_of(row)
            if not agent or plan.pretrained:
                continue
            clones = imitates(agent)
            folder = demonstrations_folder(plan, env, out, plan.expert_of(row))
            # Without what only matters when it acts: rows that share a training store and resume one and the same.
            config = training_settings(plan, env, row)
            arguments: dict[str, Any] = {"env": env, "agent": agent, "seed": seed, "config": config}
            arguments |= {"data": folder if clones else None, "device": device, "every": every}
            output = checkpoint_path(plan, env, row, seed, out)
            name = f"train {split_row(row)[0]} on {env}" + (f", seed {seed}" if plan.seeds > 1 else "")
            needs = (folder / demonstrations.DATA,) if clones else ()
            jobs.setdefault(output, Job(name, train, arguments, output, needs, 10.0 if clones else 100.0))
    return list(jobs.values())


def with_events(jobs: Sequence[Job], folder: Path | None) -> list[Job]:
    """The same jobs, trainings among them writing event files: into ``folder``, one folder in it each; None: none."""
    if folder is None:
        return list(jobs)

    def told(job: Job) -> Job:
        events = folder / job.arguments["env"] / job.output.stem
        return replace(job, arguments={**job.arguments, "events": events})

    return [told(job) if job.run is train else job for job in jobs]


def wanted(jobs: Sequence[Job], ends: Sequence[Job]) -> list[Job]:
    """Those of ``jobs`` that are done, that are ``ends``, or whose output a missing end needs, directly or not.

    Who measures needs no training whose episodes are all there, and no demonstrations for a training that is done.
    """
    by_output = {job.output: job for job in jobs}
    asked = {job.output for job in ends}
    open_ends = [job for job in ends if not job.output.exists()]
    while open_ends:
        missing = {path for job in open_ends for path in job.needs if not path.exists()} - asked
        asked |= missing
        open_ends = [by_output[path] for path in missing if path in by_output]
    return [job for job in jobs if job.output in asked or job.output.exists()]


def in_turn(jobs: Sequence[Job], ends: Sequence[Job]) -> list[Job]:
    """``jobs`` such that each of ``ends`` follows what it needs, and so on: who stops early has whole rows."""
    by_output = {job.output: job for job in jobs}
    ordered: dict[Path, Job] = {}

    def take(path: Path) -> None:
        job = by_output.get(path)
        if job is not None and path not in ordered:
            for need in job.needs:
                take(need)
            ordered[path] = job

    for end in ends:
        take(end.output)
    return [*ordered.values(), *(job for job in jobs if job.output not in ordered)]


def tidy(out: Path) -> None:
    """Remove what a kill in the last lines of a job left: states of finished trainings, pieces of finished sets."""
    for state in out.glob("agents/*/*.training"):
        if state.with_suffix(".rise").exists():
            state.unlink()
    for parts in out.glob(f"demonstrations/*/{PARTS}"):
        if (parts.parent / demonstrations.DATA).exists():
            shutil.rmtree(parts)


def evaluation_jobs(plan: Plan, out: Path) -> list[Job]:
    """One job for each row, noise model and level, and portion of the scenarios."""
    jobs = []
    for env in plan.envs:
        for (row, seed), met in plan.measured(env).items():
            actor = actor_of(plan, env, row, seed, out)
            for part in plan.chunks(env):
                first, *others = (_evaluation(plan, out, actor, seed, *condition, part) for condition in met)
                if split_row(row)[1] == TRUE:  # the same episodes under every condition: run once
                    others = [_repetition(job, first) for job in others]
                jobs += [first, *others]
    return jobs


def evaluated(plan: Plan, out: Path, env: str, row: str, model: str, level: float) -> list[Path]:
    """Where the episodes of a row under one condition lie, of the first training seed."""
    actor = actor_of(plan, env, row, 0, out)
    return [_evaluation(plan, out, actor, 0, model, level, part).output for part in plan.chunks(env)]


def _evaluation(
    plan: Plan, out: Path, actor: _Actor, seed: int, model: str, level: float, part: Scenarios
) -> Job:
    source, who = actor
    env, row = who["env"], who["row"]
    arguments = {**who, "seed": seed, "noise_model": model, "noise_level": level, "scenarios": part}
    mark = digest(env, row, seed, *source, model, level, part.start, part.count)
    output = out / "parts" / env / f"{row}-seed{seed}-{model}{level:g}-{part.start}-{mark}.parquet"
    under = f" ({model})" if len({*plan.noise_models, model}) > 1 else ""
    name = f"evaluate {row} on {env} at noise {level:g}{under}"
    return Job(name, evaluate, arguments, output, _needed(arguments))


def _repetition(job: Job, first: Job) -> Job:
    """``job``, whose episodes are those of ``first`` under another condition."""
    under = {name: job.arguments[name] for name in ("noise_model", "noise_level")}
    arguments = {"source": first.output, **under}
    return replace(job, run=repeat, arguments=arguments, needs=(first.output,), weight=0.1)


def actor_of(plan: Plan, env: str, row: str, seed: int, out: Path) -> _Actor:
    """What names the policy of a row in a digest, and the arguments of a job that needs it."""
    trained = checkpoint_path(plan, env, row, seed, out) if plan.agent_of(row) else None
    settings = how_it_acts(plan, env, row)
    source = [_source(plan, trained), *([settings] if settings else [])]
    return source, {"env": env, "row": row, "checkpoint": trained, "settings": settings}


def _needed(arguments: dict[str, Any]) -> tuple[Path, ...]:
    return (arguments["checkpoint"],) if arguments["checkpoint"] else ()


def video_jobs(plan: Plan, out: Path) -> list[Job]:
    """One clip for each row that was asked for, of its first training seed, at the headline noise level."""
    model, headline = plan.headline()
    jobs = []
    for env in filter(draws, plan.envs):
        for row in plan.asked(env):
            level = 0.0 if split_row(row)[1] == TRUE else headline
            source, arguments = actor_of(plan, env, row, 0, out)
            seeds = [int(s) for s in Scenarios(0, min(plan.clips, plan.episodes)).seeds()]
            arguments |= {"seeds": seeds, "noise_model": model, "noise_level": level}
            arguments["label"] = agent_label(row)
            mark = digest(env, row, *source, model, level, seeds)
            output = out / "videos" / f"{env}-{row}-{mark}.mp4"
            needs = _needed(arguments)
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
        for row, seed in plan.rows(env):
            if seed == 0 and plan.agent_of(row):
                try:
                    settings = complete_settings(plan, env, row)
                    if not describes_task(env):  # an agent says itself whether it can do without
                        make_agent(plan.agent_of(row), env, settings)
                except (TypeError, ValueError, checkpoint.CheckpointError) as error:
                    raise ValueError(f"settings of {split_row(row)[0]}: {error}") from None


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
    events: Path | None = None,
) -> None:
    """Train one agent, from where it was interrupted; writes its checkpoint and a JSON record of the training.

    With ``events``, its figures also go to event files in that folder, see :mod:`rise_agents.figures`.
    """
    resume = Resume(output.with_suffix(".training"), every)
    learner = make_agent(agent, env, config, seed, device)
    with figures.written(events, resume, progress) as tell:
        learner.learn(env if data is None else demonstrations.load(data), tell, resume)
    record = {"seconds": round(resume.seconds, 1), "device": device, "curve": resume.curve}
    results.atomic_write_text(output.with_suffix(".json"), json.dumps(record) + "\n")
    learner.save(output)
    says = checkpoint.load(output)[1].get("agent")
    if says != agent:  # whoever loads it would get that one
        output.unlink()
        raise ValueError(
            f"save() of {agent} wrote a checkpoint of {says!r}: it must write the agent's own name"
        )
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
    settings: dict[str, Any],
) -> None:
    """Run one policy through a portion of the scenarios; writes a row per episode."""
    policy = make_policy(env, row, checkpoint, settings, noise_level)
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
        noise_level=0.0 if split_row(row)[1] == TRUE else noise_level,
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


def repeat(output: Path, progress: Progress, source: Path, noise_model: str, noise_level: float) -> None:
    """Write the rows of ``source``, episodes on true readings, once more: for the condition that others meet."""
    columns = results.read_rows(source).to_pydict()
    columns |= {"noise_model": noise_model, "noise_level": float(noise_level)}
    results.write_rows(output, results.from_columns(columns))

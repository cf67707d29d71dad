"""A run from plan to pages: demonstrations, training, evaluation, videos, tables, figures."""

from __future__ import annotations

import json
import platform
import shlex
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from benchmarks import job_times, published, report, results
from benchmarks.display import Display
from benchmarks.executors import Failure, MakeCrew, never, run_jobs
from benchmarks.explorer import trajectory_jobs
from benchmarks.html_report import write_page
from benchmarks.jobs import (
    Job,
    checkpoint_name,
    checkpoint_path,
    complete_settings,
    demonstrations_folder,
    evaluation_jobs,
    in_turn,
    recording_jobs,
    tidy,
    training_jobs,
    video_jobs,
    wanted,
    with_events,
)
from benchmarks.labels import name_rows, split_row
from benchmarks.protocol import Plan, imitates
from benchmarks.published import Published
from benchmarks.sections import sections
from rise_agents import checkpoint, demonstrations
from rise_agents.files import sweep
from rise_agents.pool import Pool


@dataclass(frozen=True)
class How:
    """How a plan is carried out; none of this changes a result, but for the last digits that a device gives.

    Attributes:
        workers: jobs at once, at most; None: one per core of what works.
        device: torch device for training.
        videos: whether to draw clips, and to trace the episodes that the report shows step by step.
        every: seconds between two checkpoints of a training.
        command: how this run was started, for ``run.json``.
        tensorboard: folder for event files of the trainings; None: none are written.
        source: published results from which episodes are taken instead of running them.
        time_is_up: whether to interrupt what runs, and to start nothing more.
        pool: makes what works, see :func:`run_jobs`.
    """

    workers: int | None
    device: str = "cpu"
    videos: bool = True
    every: float = 15.0
    command: tuple[str, ...] = ()
    tensorboard: Path | None = None
    source: Published | None = None
    time_is_up: Callable[[], bool] = never
    pool: MakeCrew = Pool


@dataclass(frozen=True)
class Outcome:
    """How a run ended; if not everything is done, tables and figures show what there is.

    Attributes:
        failures: what failed.
        left: the jobs that are not done, those that failed among them.
    """

    failures: list[Failure]
    left: list[Job]

    @property
    def stopped(self) -> bool:
        """Whether time was up before everything had been tried."""
        failed = {failure.job.output for failure in self.failures}
        return any(job.output not in failed for job in self.left)


def execute(plan: Plan, out: Path, how: How) -> Outcome:
    """Do all that the plan asks for and is not done yet, in the run folder ``out``, as far as time allows."""
    for folder in [out, *(path for path in out.rglob("*") if path.is_dir())]:
        sweep(folder)
    tidy(out)
    name_rows(plan.labels())
    with Display() as display:
        evaluations = evaluation_jobs(plan, out)
        found = published.matches(how.source, plan, out, evaluations) if how.source else []
        if how.source:
            display.say(published.take(how.source, found))
        traces = trajectory_jobs(plan, out)
        ends = [*evaluations, *([*video_jobs(plan, out), *traces] if how.videos else [])]
        before = [*recording_jobs(plan, out), *training_jobs(plan, out, how.device, how.every)]
        jobs = wanted([*before, *ends], ends)
        display.plan(jobs)
        # All workers stay busy to the end if long jobs start first; rows are whole as soon as can be if they do not.
        limited = how.time_is_up is not never
        turn = with_events(in_turn(jobs, ends) if limited else jobs, how.tensorboard)
        watch = job_times.noting(out / job_times.NAME, display.watch)
        failures = run_jobs(turn, how.workers, watch, display.say, how.time_is_up, not limited, how.pool)
    # Asked again: pieces of a set of demonstrations are gone, and not needed, as soon as it is put together.
    outcome = Outcome(failures, [job for job in wanted(jobs, ends) if not job.output.exists()])
    _write_failures(out / "failures.log", failures)
    _write_run(plan, out, how, outcome, how.source if found else None, traces)
    _write_results(out, evaluations)
    return outcome


def _write_results(out: Path, evaluations: list[Job]) -> None:
    """Everything that is computed from the rows of episodes."""
    parts = [job.output for job in evaluations if job.output.exists()]
    if not parts:
        (out / report.EPISODES).unlink(missing_ok=True)  # of an earlier plan, which run.json no longer tells
        return
    rows = results.merge(parts, out / report.EPISODES)
    run = report.read_run(out)
    summary = report.publish(rows, run, out)
    write_page(summary, run, out, out)
    asked, *others = sections(summary, run.get("blocks", ()))
    for env in dict.fromkeys(row.env for row in asked.rows):
        print(report.summary_table_text(asked.rows, env))
    if others:
        print(f"{len(others)} more tables are in {out / 'summary.md'}\n")


def _write_failures(path: Path, failures: list[Failure]) -> None:
    """What went wrong and where, for who looks for a defect; no file if nothing did."""
    if failures:
        texts = [f"{failure.job.name}: {failure.reason}\n{failure.trace}" for failure in failures]
        results.atomic_write_text(path, "\n".join(texts))
    else:
        path.unlink(missing_ok=True)


def _trained(plan: Plan, out: Path) -> dict[str, dict[str, Any]]:
    """How the agent of each row was trained and acts, in words and numbers, per row and environment."""
    facts: dict[str, dict[str, Any]] = {}
    for env in plan.envs:
        for row in _trained_rows(plan, env):
            path = checkpoint_path(plan, env, row, 0, out).with_suffix(".json")
            if plan.pretrained:
                entry = {"trained": "before; the weights come with the package"}
                facts.setdefault(row, {})[env] = {**entry, **complete_settings(plan, env, row)}
            elif path.exists():
                seconds = json.loads(path.read_text())["seconds"]
                settings = complete_settings(plan, env, row)
                by = "expert" if plan.expert_of(row) == plan.expert else plan.expert_of(row)
                tried = f"trial in {settings.get('train_env') or 'the environment'}"
                source = f"{plan.demos:,} {by} episodes" if imitates(plan.agent_of(row)) else tried
                entry = {"learned from": source, "training time": f"{seconds:.0f} s"}
                facts.setdefault(row, {})[env] = {**entry, **settings}
    return facts


def _trained_rows(plan: Plan, env: str) -> list[str]:
    """The rows of trained agents, each once; what stands before one (a filter) makes it no other agent."""
    bases = dict.fromkeys(split_row(row)[0] for row, _ in plan.rows(env))
    return [base for base in bases if plan.agent_of(base)]


def _cards(plan: Plan, out: Path, source: Published | None) -> dict[str, Any]:
    """What is known of the demonstrations of each environment, recorded here or for what was published."""
    cards = {}
    for env in plan.envs:
        asked = () if plan.pretrained else dict.fromkeys((plan.expert, *plan.experts(env)))
        for expert in asked:
            folder = demonstrations_folder(plan, env, out, expert)
            card = None
            if all((folder / name).exists() for name in (demonstrations.DATA, demonstrations.CARD)):
                card = json.loads((folder / demonstrations.CARD).read_text())
            elif source and expert in plan.experts(env):
                card = source.card(env, expert, plan.demos)
            if card is not None:
                cards[env if expert == plan.expert else f"{env} by {expert}"] = card
    return cards


def _write_run(
    plan: Plan, out: Path, how: How, outcome: Outcome, source: Published | None, traces: list[Job]
) -> None:
    """``run.json``: all that is needed to repeat the run; ``source``: published results that are a part of it."""
    run = {
        "command": shlex.join(how.command),
        "plan": asdict(plan),
        "settings": {
            f"{row}@{env}": complete_settings(plan, env, row)
            for env in plan.envs
            for row in _trained_rows(plan, env)
        },
        "device": how.device,
        "failed": [
            {"job": f.job.name, "output": str(f.job.output.relative_to(out)), "reason": f.reason}
            for f in outcome.failures
        ],
        "unfinished": len(outcome.left),
        "demonstrations": _cards(plan, out, source),
        "agents": {
            env: {
                f"{row}-seed{seed}": checkpoint_name(plan, checkpoint_path(plan, env, row, seed, out), out)
                for row, seed in plan.rows(env)
                if plan.agent_of(row)
            }
            for env in plan.envs
        },
        "rows": list(dict.fromkeys(row for env in plan.envs for row, _ in plan.rows(env))),
        "blocks": plan.described(),
        "training": _trained(plan, out),
        "taken_from": source.origin() if source else [],
        "trajectories": [str(job.output.relative_to(out)) for job in traces if job.output.exists()],
        "versions": checkpoint.versions(),
        "python": platform.python_version(),
        "platform": platform.platform(),
    }
    results.atomic_write_text(out / report.RECORD, json.dumps(run, indent=2) + "\n")

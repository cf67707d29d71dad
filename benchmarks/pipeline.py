"""A run from plan to pages: demonstrations, training, evaluation, videos, tables, figures."""

from __future__ import annotations

import json
import platform
import shlex
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from benchmarks import report, results
from benchmarks.display import Display
from benchmarks.executors import Failure, run_jobs
from benchmarks.explorer import trajectory_jobs
from benchmarks.html_report import write_page
from benchmarks.jobs import (
    Job,
    checkpoint_path,
    complete_settings,
    demonstrations_folder,
    evaluation_jobs,
    recording_jobs,
    tidy,
    training_jobs,
    video_jobs,
)
from benchmarks.labels import name_rows, split_row
from benchmarks.protocol import Plan, imitates
from benchmarks.sections import sections
from rise_agents import checkpoint, demonstrations, pretrained
from rise_agents.files import sweep


@dataclass(frozen=True)
class How:
    """How a plan is carried out; none of this changes a result, but for the last digits that a device gives.

    Attributes:
        workers: processes.
        device: torch device for training.
        videos: whether to draw clips, and to trace the episodes that the report shows step by step.
        every: seconds between two checkpoints of a training.
        command: how this run was started, for ``run.json``.
    """

    workers: int
    device: str = "cpu"
    videos: bool = True
    every: float = 15.0
    command: tuple[str, ...] = ()


def execute(plan: Plan, out: Path, how: How) -> list[Failure]:
    """Do all that the plan asks for and is not done yet, in the run folder ``out``.

    Returns:
        What failed; tables and figures then show what there is.
    """
    for folder in [out, *(path for path in out.rglob("*") if path.is_dir())]:
        sweep(folder)
    tidy(out)
    name_rows({name: variant.label for name, variant in plan.variants.items() if variant.label})
    with Display() as display:
        evaluations = evaluation_jobs(plan, out)
        jobs = [*recording_jobs(plan, out), *training_jobs(plan, out, how.device, how.every), *evaluations]
        traces = trajectory_jobs(plan, out)
        jobs += [*video_jobs(plan, out), *traces] if how.videos else []
        display.plan(jobs)
        failures = run_jobs(jobs, how.workers, display.watch, display.say)
    _write_failures(out / "failures.log", failures)
    _write_run(plan, out, how, failures, [job.output for job in traces if job.output.exists()])
    _write_results(out, evaluations)
    return failures


def _write_results(out: Path, evaluations: list[Job]) -> None:
    """Everything that is computed from the rows of episodes."""
    parts = [job.output for job in evaluations if job.output.exists()]
    if not parts:
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
                entry = {"learned from": "before: the weights come with the package"}
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


def _told(trained: Path, plan: Plan, out: Path) -> str:
    """A checkpoint as ``run.json`` names it."""
    if plan.pretrained:
        return f"{trained.name} of rise_agents.pretrained, SHA-256 {pretrained.sha256(trained)}"
    return str(trained.relative_to(out))


def _trained_rows(plan: Plan, env: str) -> list[str]:
    """The rows of trained agents, each once; what stands before one (a filter) makes it no other agent."""
    bases = dict.fromkeys(split_row(row)[0] for row, _ in plan.rows(env))
    return [base for base in bases if plan.agent_of(base)]


def _write_run(plan: Plan, out: Path, how: How, failures: list[Failure], traces: list[Path]) -> None:
    """``run.json``: all that is needed to repeat the run."""
    cards = {}
    for env in plan.envs:
        recorded = () if plan.pretrained else dict.fromkeys((plan.expert, *plan.experts(env)))
        for expert in recorded:
            folder = demonstrations_folder(plan, env, out, expert)
            if all((folder / name).exists() for name in (demonstrations.DATA, demonstrations.CARD)):
                card = json.loads((folder / demonstrations.CARD).read_text())
                cards[env if expert == plan.expert else f"{env} by {expert}"] = card
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
            for f in failures
        ],
        "demonstrations": cards,
        "agents": {
            env: {
                f"{row}-seed{seed}": _told(checkpoint_path(plan, env, row, seed, out), plan, out)
                for row, seed in plan.rows(env)
                if plan.agent_of(row)
            }
            for env in plan.envs
        },
        "rows": list(dict.fromkeys(row for env in plan.envs for row, _ in plan.rows(env))),
        "blocks": plan.described(),
        "training": _trained(plan, out),
        "trajectories": [str(path.relative_to(out)) for path in traces],
        "versions": checkpoint.versions(),
        "python": platform.python_version(),
        "platform": platform.platform(),
    }
    results.atomic_write_text(out / report.RECORD, json.dumps(run, indent=2) + "\n")

"""A run from plan to pages: demonstrations, training, evaluation, videos, tables, figures."""

from __future__ import annotations

import json
import platform
import shlex
from dataclasses import asdict
from pathlib import Path
from typing import Any

from benchmarks import plots, report, results
from benchmarks.display import Display
from benchmarks.executors import Failure, run_jobs
from benchmarks.jobs import (
    Job,
    checkpoint_path,
    complete_settings,
    demonstrations_folder,
    evaluation_jobs,
    generate_demonstrations,
    training_jobs,
    video_jobs,
)
from benchmarks.labels import env_label
from benchmarks.protocol import Plan, imitates
from rise_agents import AGENTS, checkpoint, demonstrations


def execute(
    plan: Plan, out: Path, workers: int, device: str, videos: bool, command: list[str]
) -> list[Failure]:
    """Do all that the plan asks for and is not done yet.

    Args:
        plan: what to measure.
        out: the run folder.
        workers: processes.
        device: torch device for training.
        videos: whether to draw clips.
        command: how this run was started, for ``run.json``.

    Returns:
        What failed; tables and figures then show what there is.
    """
    with Display() as display:
        for env in plan.envs:
            if any(agent in AGENTS and imitates(agent) for agent in plan.agents):
                folder = demonstrations_folder(plan, env, out)
                with display.step(f"demonstrations of {env_label(env)}") as progress:
                    generate_demonstrations(plan, env, folder, workers, progress)
        trainings, evaluations = training_jobs(plan, out, device), evaluation_jobs(plan, out)
        clips = video_jobs(plan, out) if videos else []
        display.plan([*trainings, *evaluations, *clips])
        failures = run_jobs([*trainings, *evaluations, *clips], workers, display.watch)
    _write_run(plan, out, device, command)
    _write_results(plan, out, evaluations, command)
    return failures


def _write_results(plan: Plan, out: Path, evaluations: list[Job], command: list[str]) -> None:
    """Everything that is computed from the rows of episodes."""
    parts = [job.output for job in evaluations if job.output.exists()]
    if not parts:
        return
    rows = results.merge(parts, out / "episodes.parquet")
    order = list(dict.fromkeys(row for env in plan.envs for row, _ in plan.rows(env)))
    summary = results.summarise(rows, order)
    results.write_summary_csv(out / "summary.csv", summary)
    level = results.headline_level(summary)
    plots.save_png(plots.comparison(summary, level), out / "comparison.png")
    plots.save_png(plots.noise_curve(summary), out / "noise_curve.png")
    run = {"command": shlex.join(command), "agents": _trained(plan, out)}
    results.atomic_write_text(out / "summary.md", report.summary_markdown(summary, run))
    for env in plan.envs:
        print(report.summary_table_text(summary, env))


def _trained(plan: Plan, out: Path) -> dict[str, dict[str, Any]]:
    """How each agent was trained, in words and numbers, per agent and environment."""
    facts: dict[str, dict[str, Any]] = {}
    for env in plan.envs:
        for agent in [name for name in plan.agents if name in AGENTS]:
            path = checkpoint_path(plan, env, agent, 0, out).with_suffix(".json")
            if path.exists():
                seconds = json.loads(path.read_text())["seconds"]
                settings = complete_settings(plan, env, agent)
                tried = f"trial in {settings.get('train_env') or 'the environment'}"
                source = f"{plan.demos:,} expert episodes" if imitates(agent) else tried
                entry = {"learned from": source, "training time": f"{seconds:.0f} s"}
                facts.setdefault(agent, {})[env] = {**entry, **settings}
    return facts


def _write_run(plan: Plan, out: Path, device: str, command: list[str]) -> None:
    """``run.json``: all that is needed to repeat the run."""
    cards = {}
    for env in plan.envs:
        card = demonstrations_folder(plan, env, out) / demonstrations.CARD
        if card.exists():
            cards[env] = json.loads(card.read_text())
    run = {
        "command": shlex.join(command),
        "plan": asdict(plan),
        "settings": {
            f"{agent}@{env}": complete_settings(plan, env, agent)
            for env in plan.envs
            for agent in plan.agents
            if agent in AGENTS
        },
        "device": device,
        "demonstrations": cards,
        "agents": {
            env: {
                f"{row}-seed{seed}": str(checkpoint_path(plan, env, row, seed, out).relative_to(out))
                for row, seed in plan.rows(env)
                if row in AGENTS
            }
            for env in plan.envs
        },
        "versions": checkpoint.versions(),
        "python": platform.python_version(),
        "platform": platform.platform(),
    }
    results.atomic_write_text(out / "run.json", json.dumps(run, indent=2, sort_keys=True) + "\n")

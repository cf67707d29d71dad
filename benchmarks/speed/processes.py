"""What processes cost: imports, a second worker, the whole benchmark."""

from __future__ import annotations

import functools
import json
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

from benchmarks.speed.envs import PANDA
from benchmarks.speed.measure import Effort, Sides


@contextmanager
def imports(effort: Effort) -> Iterator[Sides]:
    """The import alone, in interpreters that have just started."""
    yield Sides(lambda: import_seconds("rise_envs"), lambda: import_seconds("gymnasium"))


def import_seconds(module: str) -> float:
    """Seconds that ``import module`` takes in a new interpreter, without the interpreter's own start."""
    script = f"import time; t = time.perf_counter(); import {module}; print(time.perf_counter() - t)"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)  # noqa: S603
    return float(done.stdout)


@contextmanager
def workers(effort: Effort) -> Iterator[Sides]:
    """The benchmark's own evaluation jobs on the Panda with two workers and with one, in scenarios per second.

    Counted from the moment at which the first worker has loaded everything, to the end of the last job.
    """
    from benchmarks.protocol import make_plan
    from rise_agents import demonstrations, make_agent

    brief = {"updates": 20, "vae_updates": 20}
    agent = make_agent("rise", PANDA, brief).learn(demonstrations.generate(PANDA, "cbf", 4))
    plan = make_plan(
        "quick",
        {},
        agents=("rise",),
        envs=(PANDA,),
        noise_models=("step",),
        noise_levels=(1.0,),
        episodes=effort.size(600, 4),
    )
    whole: dict[int, list[float]] = {1: [], 2: []}

    def side(count: int) -> Callable[[], float]:
        def run() -> float:
            with tempfile.TemporaryDirectory() as folder:
                work, total = evaluation_seconds(plan, agent, Path(folder), count)
            whole[count].append(plan.episodes / total)
            return plan.episodes / work

        return run

    def note() -> str:
        two, one = (sorted(whole[n])[len(whole[n]) // 2] for n in (2, 1))
        return f"with the start of the processes, {plan.episodes:,} scenarios: {two / one:.2f} ×"

    yield Sides(side(2), side(1), note)


def evaluation_seconds(plan: Any, agent: Any, out: Path, count: int) -> tuple[float, float]:
    """Seconds that ``count`` workers take for the evaluation jobs of a plan: the work, and all of it."""
    from benchmarks.executors import run_jobs
    from benchmarks.jobs import checkpoint_path, evaluation_jobs

    trained = checkpoint_path(plan, PANDA, "rise", 0, out)
    trained.parent.mkdir(parents=True)
    agent.save(trained)
    jobs = [
        replace(job, run=noted, arguments={"run": job.run, "arguments": job.arguments})
        for job in evaluation_jobs(plan, out)
    ]
    started = time.perf_counter()
    failures = run_jobs(jobs, count, lambda job, share, figures: None)
    total = time.perf_counter() - started
    if failures:
        raise RuntimeError(f"{failures[0].job.name}: {failures[0].reason}")
    spans = [json.loads(job.output.with_suffix(".span").read_text()) for job in jobs]
    return max(end for _, end in spans) - min(start for start, _ in spans), total


def noted(output: Path, progress: Any, run: Callable[..., None], arguments: dict[str, Any]) -> None:
    """A job that leaves behind when it began, after everything was loaded, and when it ended."""
    from benchmarks.policies import make_policy
    from benchmarks.speed.envs import make

    make_policy(arguments["env"], arguments["row"], arguments["checkpoint"])
    make(arguments["env"]).close()
    started = time.monotonic()  # the same clock in all processes
    run(output, progress, **arguments)
    output.with_suffix(".span").write_text(json.dumps([started, time.monotonic()]))


@contextmanager
def bench(effort: Effort, cold: bool) -> Iterator[Sides]:
    """The whole quick benchmark from nothing, or once more in the same folder; what it made stays there."""
    yield Sides(lambda: bench_seconds(effort.folder / "bench", effort.quick)[0 if cold else 1])


@functools.cache
def bench_seconds(folder: Path, quick: bool) -> tuple[float, float]:
    """Seconds that the benchmark takes the first time, and the second time in the same folder."""
    shutil.rmtree(folder, ignore_errors=True)
    command = [sys.executable, "-m", "benchmarks.run", "--agents", "rise", "pcbc", "cppo"]
    command += ["--preset", "smoke" if quick else "quick", "--out", str(folder)]
    seconds = []
    for _ in range(2):
        started = time.perf_counter()
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL)  # noqa: S603
        seconds.append(time.perf_counter() - started)
    return seconds[0], seconds[1]

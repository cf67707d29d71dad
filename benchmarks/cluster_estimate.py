"""How long a preset takes on a cluster: ``python -m benchmarks.cluster_estimate runs/quick --nodes 1 16 128``.

Every job of the preset gets the time that the most similar ones took in a run that was measured, and the schedule of
:mod:`benchmarks.executors` itself starts them, on a clock of its own.
"""

from __future__ import annotations

import heapq
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from benchmarks.presets import PRESETS
from rise_agents.cli import Parser, command

if TYPE_CHECKING:
    from benchmarks.jobs import Job
    from rise_agents.pool import Ended

_EXAMPLES = """\
examples:
  python -m benchmarks.cluster_estimate runs/quick --nodes 1 16 128 --cores 32
  python -m benchmarks.cluster_estimate runs/paper --docs docs/cluster.md

Times are those that a run wrote into job_times.csv of its folder: per update of a training and per episode.
"""


def parser() -> Parser:
    """The command line."""
    p = Parser(
        plugins=True,
        prog="python -m benchmarks.cluster_estimate",
        description="Estimate how long a preset takes on a cluster, from the times of a run's jobs.",
        epilog=_EXAMPLES,
    )
    p.add_argument("run", type=Path, metavar="RUN_DIR", help="folder of a run, whole or not")
    p.add_argument("--preset", default="paper", metavar="NAME", help="what is to be run (default: paper)")
    p.add_argument(
        "--nodes",
        nargs="+",
        type=int,
        default=[1, 16, 128],
        metavar="N",
        help="how many there are, a line of the table each (default: 1 16 128)",
    )
    p.add_argument(
        "--cores", type=int, default=2, metavar="N", help="of a node, each with a job (default: 2)"
    )
    p.add_argument("--price", type=float, metavar="X", help="of a node for an hour, in whatever currency")
    p.add_argument("--no-videos", action="store_true", help="without the clips")
    p.add_argument("--docs", type=Path, metavar="FILE", help="page whose table is renewed, docs/cluster.md")
    return p  # fmt: skip


@dataclass(frozen=True)
class Cost:
    """What a run takes with a number of workers.

    Attributes:
        workers: jobs at once.
        wall: s from its start to its end.
        work: s that all jobs take together.
    """

    workers: int
    wall: float
    work: float

    @property
    def efficiency(self) -> float:
        """The share of the paid time in which a job runs, in [0, 1]."""
        return self.work / (self.wall * self.workers) if self.wall else 1.0


class _Clock:
    """A pool in which time passes at once: every job ends after the seconds that are known of it."""

    def __init__(self, workers: int, seconds: Mapping[Path, float]) -> None:
        self.workers, self._seconds = workers, seconds
        self.now = 0.0
        self.done: set[Path] = set()
        self._running: list[tuple[float, int, Path]] = []

    def __enter__(self) -> _Clock:
        return self

    def __exit__(self, *exception: object) -> None:
        pass

    @property
    def busy(self) -> int:
        return len(self._running)

    @property
    def free(self) -> int:
        return self.workers - self.busy

    def start(self, key: int, function: Callable[..., Any], job: Job) -> None:
        heapq.heappush(self._running, (self.now + self._seconds[job.output], key, job.output))

    def wait(self) -> list[Ended]:
        from rise_agents.pool import Ended

        self.now, key, output = heapq.heappop(self._running)
        self.done.add(output)
        return [Ended(key)]


def simulate(jobs: Sequence[Job], seconds: Mapping[Path, float], workers: int) -> Cost:
    """What the jobs take with so many workers, of which each output takes so many ``seconds``.

    Raises:
        ValueError: some jobs need what none of them makes.
    """
    from benchmarks.executors import run_jobs

    clock = _Clock(workers, seconds)
    failures = run_jobs(
        jobs, workers, lambda job, share, figures: None, pool=lambda *_: clock, exists=clock.done.__contains__
    )
    if failures:
        raise ValueError(f"{failures[0].job.name} needs what no job makes")
    return Cost(workers, clock.now, sum(seconds[job.output] for job in jobs))


def jobs_of(preset: str, videos: bool) -> list[Job]:
    """All jobs of a preset in an empty folder."""
    from benchmarks.explorer import trajectory_jobs
    from benchmarks.jobs import evaluation_jobs, recording_jobs, training_jobs, video_jobs, wanted
    from benchmarks.protocol import make_plan
    from rise_envs import ENVS, STAND_INS

    plan = make_plan(preset, {}, envs=tuple(env for env in ENVS if env not in STAND_INS))
    nowhere = Path("/nowhere")
    ends = evaluation_jobs(plan, nowhere)
    if videos:
        ends += [*video_jobs(plan, nowhere), *trajectory_jobs(plan, nowhere)]
    before = [*recording_jobs(plan, nowhere), *training_jobs(plan, nowhere, "cpu", 15.0)]
    return wanted([*before, *ends], ends)


def table(costs: Mapping[int, Cost], cores: int, price: float | None) -> str:
    """A line for each number of nodes."""
    from benchmarks.pages import markdown_table

    header = ["Nodes", "Cores", "Wall time, h", "Core hours of work", "Node hours", "Efficiency"]
    lines = []
    for nodes, cost in costs.items():
        hours = nodes * cost.wall / 3600
        cells = [f"{nodes:,}", f"{nodes * cores:,}", f"{cost.wall / 3600:.2f}", f"{cost.work / 3600:.1f}"]
        cells += [f"{hours:.1f}", f"{100 * cost.efficiency:.0f} %"]
        lines.append([*cells, *([] if price is None else [f"{price * hours:,.2f}"])])
    header += [] if price is None else ["Price"]
    return markdown_table(header, ["---:"] * len(header), lines)


def _check(a: Any) -> None:
    from rise_agents.agent import nearest

    if a.preset not in PRESETS:
        raise ValueError(f"unknown preset {a.preset!r}: {nearest(a.preset, PRESETS)}")
    for name, values in (("--nodes", a.nodes), ("--cores", [a.cores])):
        if not all(1 <= value <= 100_000 for value in values):
            raise ValueError(f"{name} takes whole numbers from 1 to 100,000, got {min(values)}")
    if a.price is not None and not 0 <= a.price < float("inf"):
        raise ValueError(f"--price must be a number, not negative, got {a.price:g}")


def estimate(a: Any) -> str:
    """The table and what it is of, for the arguments of a command line."""
    from benchmarks import job_times
    from benchmarks.pages import machine

    known = job_times.Estimate(job_times.read(a.run / job_times.NAME))
    jobs = jobs_of(a.preset, not a.no_videos)
    guesses = {job.output: known.seconds(job) for job in jobs}
    seconds = {path: guess or 0.0 for path, guess in guesses.items()}
    unknown = Counter(job_times.kind(job) for job in jobs if guesses[job.output] is None)
    kinds = Counter(job_times.kind(job) for job in jobs)
    lines = [f"Preset `{a.preset}`: " + ", ".join(f"{n:,} `{kind}`" for kind, n in kinds.items()) + "."]
    lines.append(f"Times per unit of work are those of `{a.run.name}`, measured on: {machine()}")
    if unknown:
        lines.append("Not measured, and not counted: " + ", ".join(f"`{kind}`" for kind in unknown) + ".")
    costs = {nodes: simulate(jobs, seconds, nodes * a.cores) for nodes in a.nodes}
    path = simulate(jobs, seconds, len(jobs)).wall
    lines.append(
        f"The longest chain of counted jobs that wait for each other takes {path / 3600:.2f} h: no cluster is faster."
    )
    return "\n".join([*lines, "", table(costs, a.cores, a.price)])


@command("benchmarks.cluster_estimate")
def main(argv: Sequence[str] | None = None) -> int:
    """Estimate; returns the exit code: 0 done, 1 a file cannot be written, 2 bad arguments, 130 interrupted."""
    a = parser().parse_args(argv)
    _check(a)
    from benchmarks.pages import CLUSTER

    if a.docs is not None:
        CLUSTER.check(a.docs)
    text = estimate(a)
    if a.docs is not None:
        CLUSTER.update(a.docs, text)
    print(text)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())

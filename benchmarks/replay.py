"""Watch any recorded episode again: ``python -m benchmarks.replay RUN_DIR --env ID --agent ROW --scenario N``.

An episode follows from its seeds, its noise and the agent that acted, which ``run.json``, ``episodes.parquet`` and the
checkpoints of a run folder name. It is run anew, and must come out as it is stored, in every outcome.
"""

from __future__ import annotations

import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from rich import box
from rich.console import Console
from rich.table import Table

from benchmarks.labels import TRUE, agent_label, condition_label, env_label, name_rows, split_row
from benchmarks.recorded import Row, Run, open_run
from benchmarks.report import read_run
from benchmarks.trajectories import Trajectory, repeating, step_seconds
from rise_agents.cli import Parser, command

_SUFFIXES = (".mp4", ".png")
_LISTED = 20
_EXAMPLES = """\
examples:
  python -m benchmarks.replay runs/quick --list --unsafe              the collisions, the deepest first
  python -m benchmarks.replay runs/quick --env RISE-SafePanda-v0 --agent rise --scenario 7
  python -m benchmarks.replay runs/quick --env RISE-GroundVehicle-v0 --agent pcbc --scenario 3 \\
      --noise-level 2 --out clip.mp4 frames.png                       a film in real time, and key frames
"""


def parser() -> Parser:
    """The command line."""
    p = Parser(
        plugins=True,
        prog="python -m benchmarks.replay",
        description="Run a recorded episode again, check that it comes out as stored, say what happened, draw it.",
        epilog=_EXAMPLES,
    )
    p.add_argument("run", type=Path, metavar="RUN_DIR", help="folder of a run, with its agents")
    p.add_argument("--env", metavar="ID", help="environment (default: the run's, if it has but one)")
    p.add_argument("--agent", metavar="ROW", help="row of the tables: rise, pcbc+kalman, expert-cbf, …")
    p.add_argument("--scenario", type=int, metavar="N", help="number of the scenario, from 0")
    p.add_argument("--seed", type=int, metavar="K", help="training seed (default: 0)")
    p.add_argument("--noise-model", metavar="MODEL", help="as in the run (default: its first)")
    p.add_argument(
        "--noise-level", type=float, metavar="X", help="as in the run (default: the one nearest to 1)"
    )
    p.add_argument(
        "--out",
        nargs="+",
        type=Path,
        default=[],
        metavar="FILE",
        help="clip.mp4: a film in real time; frames.png: key frames, the closest moment among them",
    )
    p.add_argument(
        "--list",
        action="store_true",
        help="list episodes instead, by their least clearance; no run of anything",
    )
    p.add_argument("--unsafe", action="store_true", help="list collisions only")
    p.add_argument(
        "--limit", type=int, default=_LISTED, metavar="N", help=f"so many are listed (default: {_LISTED})"
    )
    return p


def listed(run: Run, unsafe: bool = False, limit: int = _LISTED, **values: Any) -> tuple[str, int]:
    """Episodes with these values of their columns (None: any) as a text table; and how many there are.

    Args:
        run: which has them.
        unsafe: collisions only.
        limit: the first of these, by their least clearance.
        **values: of columns.
    """
    rows = [row for row in run.select(**values) if not (unsafe and row["safe"])]
    rows.sort(key=lambda row: (row["min_clearance"], row["env"], row["agent"], row["scenario"]))
    table = Table(box=box.SIMPLE_HEAD, pad_edge=False)
    for name in (
        "Env",
        "Agent",
        "Seed",
        "Noise",
        "Level",
        "Scenario",
        "Result",
        "Steps",
        "Cost",
        "Clearance m",
    ):
        table.add_column(name, justify="left" if name in ("Env", "Agent", "Noise", "Result") else "right")
    for row in rows[:limit]:
        table.add_row(
            *(row["env"], row["agent"], str(row["train_seed"]), row["noise_model"]),
            *(f"{row['noise_level']:g}", str(row["scenario"]), _result(row), str(row["steps"])),
            *(f"{row['episode_cost']:g}", f"{row['min_clearance']:.3f}"),
        )
    return _printed(table), len(rows)


def told(row: Row, trajectory: Trajectory, rounded: bool) -> str:
    """What happened in an episode, and how it compares with what is stored, as a small text table."""
    dt, closest = step_seconds(row["env"]), trajectory.closest
    outcomes = trajectory.outcomes
    collision = np.flatnonzero(trajectory.cost)
    facts = {
        "result": _result(row),
        "steps": f"{len(trajectory.action)} ({len(trajectory.action) * dt:.2f} s)",
        "cost": f"{outcomes['episode_cost']:g} steps in collision"
        + (f", the first at {(collision[0] + 1) * dt:.2f} s" if collision.size else ""),
        "least clearance": f"{outcomes['min_clearance']:.4f} m at {closest * dt:.2f} s (step {closest})",
        "return": f"{outcomes['episode_return']:.4f}",
        "as stored": "equal; what is stored is rounded to multiples of 2⁻¹³, about 10⁻⁴"
        if rounded
        else "equal, to the last digit",
    }
    level = 0.0 if split_row(row["agent"])[1] == TRUE else row["noise_level"]
    title = f"{agent_label(row['agent'])} on {env_label(row['env'])}, scenario {row['scenario']}, "
    title += f"{condition_label(row['noise_model'], level)}, training seed {row['train_seed']}"
    table = Table(box=None, show_header=False, pad_edge=False)
    for name, value in facts.items():
        table.add_row(name, value)
    return f"{title}\n{_printed(table)}"


def draw(row: Row, trajectory: Trajectory, files: Sequence[Path]) -> None:
    """Draw an episode again into films (``.mp4``) and key frames (``.png``).

    Raises:
        ValueError: an environment that draws no pictures.
        OSError: a file cannot be written.
    """
    from benchmarks import videos  # what draws is loaded by those who draw only

    level = 0.0 if split_row(row["agent"])[1] == TRUE else row["noise_level"]
    clip = videos.film(repeating(trajectory.action), row["env"], row["env_seed"], row["noise_model"], level)
    title = f"{agent_label(row['agent'])} · {env_label(row['env'])} · noise level {level:g}"
    for file in files:
        if file.suffix == ".png":
            videos.write_strip(file, clip)
        else:
            frames = videos.captioned(clip, title, f"scenario {row['scenario']} · ")
            videos.write_film(file, frames, 1 / step_seconds(row["env"]))


def _result(row: Row) -> str:
    """How an episode ended, in words."""
    arrived = "reached the goal" if row["arrived"] else "did not reach the goal"
    return arrived if row["safe"] else f"collision, {arrived}"


def _printed(table: Table) -> str:
    text = io.StringIO()
    Console(file=text, width=200, color_system=None).print(table)
    return "\n".join(line.rstrip() for line in text.getvalue().strip("\n").splitlines())


def _the_row(run: Run, arguments: Any) -> Row:
    """The episode that the arguments name."""
    for name in ("agent", "scenario"):
        if getattr(arguments, name) is None:
            raise ValueError(f"--{name} is missing: name an episode, or ask for a --list of them")
    envs = run.rows["env"].unique().to_pylist()
    if arguments.env is None and len(envs) > 1:
        raise ValueError(f"--env is missing: the run has {' and '.join(sorted(envs))}")
    env = envs[0] if arguments.env is None else arguments.env
    key = {"env": env, "agent": arguments.agent, "train_seed": arguments.seed or 0}
    run.find(**key)  # says first of these what there is
    models = list(dict.fromkeys(row["noise_model"] for row in run.select(**key)))
    first = next((model for model in run.noise_models if model in models), models[0])
    key["noise_model"] = first if arguments.noise_model is None else arguments.noise_model
    run.find(**key)
    levels = {row["noise_level"] for row in run.select(**key)}
    nearest = min(levels, key=lambda level: (abs(level - 1), level))
    key["noise_level"] = nearest if arguments.noise_level is None else arguments.noise_level
    return run.find(**key, scenario=arguments.scenario)


@command("benchmarks.replay")
def main(argv: Sequence[str] | None = None) -> int:
    """Replay or list; returns the exit code: 0 done, 1 a file cannot be written, 2 bad arguments or input, 130."""
    arguments = parser().parse_args(argv)
    for file in arguments.out:
        if file.suffix not in _SUFFIXES:
            raise ValueError(f"--out {str(file)!r} must end in {' or '.join(_SUFFIXES)}")
    if arguments.limit < 1:
        raise ValueError(f"--limit must be at least 1, got {arguments.limit}")
    if arguments.unsafe and not arguments.list:
        raise ValueError("--unsafe chooses among the episodes of a --list")
    if arguments.out and arguments.list:
        raise ValueError("--out draws one episode: leave out --list, and name it by --agent and --scenario")
    run = open_run(arguments.run)
    name_rows(read_run(arguments.run).get("labels", {}))
    if arguments.list:
        return _list(run, arguments)
    row = _the_row(run, arguments)
    trajectory = run.recreate(row)
    print(told(row, trajectory, run.rounded))
    if arguments.out:
        draw(row, trajectory, arguments.out)
        print(f"Written: {', '.join(map(str, arguments.out))}")
    return 0


def _list(run: Run, arguments: Any) -> int:
    values = {"env": arguments.env, "agent": arguments.agent, "train_seed": arguments.seed}
    values |= {"noise_model": arguments.noise_model, "noise_level": arguments.noise_level}
    values |= {"scenario": arguments.scenario}
    given = {name: value for name, value in values.items() if value is not None}
    run.find(**given)  # says what there is where there is none
    text, count = listed(run, arguments.unsafe, arguments.limit, **given)
    print(text)
    print(f"{min(count, arguments.limit):,} of {count:,} episodes")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())

"""Show a run on Weights & Biases: ``python -m benchmarks.upload RUN_DIR --project NAME``.

It reads a run folder, whenever that was made, so that neither trainings nor workers ever wait for a network.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benchmarks import report, results
from benchmarks.labels import count, split_row
from rise_agents.cli import Parser, WorkFailed, command

_EXAMPLES = """\
examples:
  python -m benchmarks.upload runs/quick --project safe-imitation
  python -m benchmarks.upload runs/quick --project safe-imitation --entity my-lab
  python -m benchmarks.upload runs/quick --project safe-imitation --offline    wandb sync sends it later

A run that is uploaded again is renewed: each training has the name of its checkpoint.
"""


@dataclass(frozen=True)
class Tracked:
    """A training, as a tracker has it.

    Attributes:
        key: the same for the same training, in any run folder.
        name: for people.
        env: environment.
        agent: the row whose training it is.
        config: settings, and what was learned from.
        curve: (step, figures of that moment) in order; steps of the environment, or thousandths of the training.
        summary: rates of all rows that act by it, as ``row/noise model/level/safety_rate``.
    """

    key: str
    name: str
    env: str
    agent: str
    config: dict[str, Any]
    curve: list[tuple[int, dict[str, float]]]
    summary: dict[str, float]


def tracked(folder: Path) -> list[Tracked]:
    """The trainings of a run folder, of those that are there.

    Raises:
        ValueError: it is none, or a file in it is damaged.
    """
    run = report.read_run(folder)
    if not run:
        raise ValueError(f"{str(folder)!r} is not the folder of a run: it has no {report.RECORD}")
    episodes = folder / report.EPISODES
    rates = _rates(episodes) if episodes.exists() else {}
    found = []
    for env, checkpoints in run["agents"].items():
        rows: dict[str, list[str]] = {}
        for key, path in checkpoints.items():
            rows.setdefault(path, []).append(key)
        for path, keys in rows.items():
            record = (folder / path).with_suffix(".json")
            if record.is_file():
                found.append(_tracked(env, path, keys, record, run["training"], rates))
    return found


def _tracked(
    env: str, path: str, keys: Sequence[str], record: Path, training: Mapping[str, Any], rates: _Rates
) -> Tracked:
    """The training of a checkpoint, by which the rows and seeds ``keys`` act."""
    row, _, seed = keys[0].rpartition("-seed")
    base = split_row(row)[0]
    config = {"env": env, "agent": base, "seed": int(seed), **training.get(base, {}).get(env, {})}
    points = [
        (_step(point), {k: v for k, v in point.items() if k != "share"}) for point in results.curve(record)
    ]
    summary = {
        name: rate
        for key in keys
        for name, rate in rates.get((env, *key.rpartition("-seed")[::2]), {}).items()
    }
    return Tracked(f"{Path(path).stem}-{env}", f"{base}, seed {seed}", env, base, config, points, summary)


def _step(point: Mapping[str, float]) -> int:
    return round(point["steps"] if "steps" in point else 1_000 * point.get("share", 0))


_Rates = Mapping[tuple[str, ...], Mapping[str, float]]


def _rates(path: Path) -> _Rates:
    """Both rates of (env, row, training seed), by their names in :attr:`Tracked.summary`."""
    rows = results.read_rows(path)
    keys = ["env", "agent", "train_seed", "noise_model", "noise_level"]
    means = rows.group_by(keys).aggregate([("safe", "mean"), ("reached", "mean")])
    found: dict[tuple[str, ...], dict[str, float]] = {}
    for line in means.to_pylist():
        env, agent, seed, model, level = (line[key] for key in keys)
        name = f"{agent}/{model}/{level:g}"
        own = found.setdefault((env, agent, str(seed)), {})
        own |= {f"{name}/safety_rate": line["safe_mean"], f"{name}/reach_rate": line["reached_mean"]}
    return found


def send(
    trainings: Sequence[Tracked], folder: Path, project: str, entity: str = "", offline: bool = False
) -> str:
    """Write trainings to Weights & Biases, a run each, in a group per environment.

    Args:
        trainings: of :func:`tracked`.
        folder: where its own files go.
        project: of Weights & Biases.
        entity: user or team; empty: as its configuration says.
        offline: whether the files stay there until ``wandb sync`` sends them; False: as its configuration says.

    Returns:
        Where they are now, in words.
    """
    import wandb

    where = ""
    for each in trainings:
        run = wandb.init(
            project=project,
            entity=entity or None,
            dir=str(folder),
            id=each.key,
            name=each.name,
            group=each.env,
            job_type=each.agent,
            config=each.config,
            mode="offline" if offline else None,
            resume=None if offline else "allow",
            settings=wandb.Settings(silent=True),
        )
        where = f"project {project}"
        if run.offline:
            where = f"{folder / 'wandb'}: wandb sync sends it"
        elif run.disabled:
            where = "no project: WANDB_MODE or the configuration of wandb says disabled"
        for step, figures in each.curve:
            run.log(figures, step=step)
        run.summary.update(each.summary)
        run.finish()
    return where


def parser() -> Parser:
    """The command line."""
    p = Parser(
        prog="python -m benchmarks.upload",
        description="Show a run on Weights & Biases: every training with its settings, its curve and its rates.",
        epilog=_EXAMPLES,
    )
    p.add_argument("run", type=Path, metavar="RUN_DIR", help="folder of a run, finished or not")
    p.add_argument("--project", required=True, metavar="NAME", help="project to show it in")
    p.add_argument("--entity", default="", metavar="NAME", help="user or team (default: your own)")
    p.add_argument(
        "--offline", action="store_true", help="only write files, into RUN_DIR/wandb, to be sent later"
    )
    return p


@command("benchmarks.upload", interrupted="interrupted; give the command again")
def main(argv: Sequence[str] | None = None) -> int:
    """Upload; returns the exit code: 0 done, 1 it could not be sent, 2 bad input, 130 interrupted."""
    a = parser().parse_args(argv)
    trainings = tracked(a.run)
    if not trainings:
        raise ValueError(f"{str(a.run)!r} has no training that has ended")
    if importlib.util.find_spec("wandb") is None:
        raise ValueError("this needs one more package: pip install 'rise-suite[wandb]'")
    try:
        where = send(trainings, a.run, a.project, a.entity, a.offline)
    except Exception as error:  # of a library that has many kinds, most of a network
        why = " ".join(str(error).split())
        raise WorkFailed(why if a.offline else f"{why}; with --offline it goes into files first") from error
    print(f"{count([len(trainings)], 'training')} in {where}")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())

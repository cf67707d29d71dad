"""The command line of :mod:`rise_agents.demonstrations`."""

from __future__ import annotations

import argparse
import shutil
from collections.abc import Sequence
from pathlib import Path

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from rise_agents import demonstrations
from rise_agents.agent import nearest
from rise_agents.cli import INTERRUPTED, KEPT, Parser, WorkFailed, at_work, command, prepare_folder
from rise_agents.demonstrations.minari_io import check_id, export
from rise_agents.demonstrations.recording import chunk_size
from rise_agents.experts import expert_names
from rise_agents.files import sole_user, sweep
from rise_agents.pool import TaskError
from rise_agents.seeds import episode_seeds
from rise_agents.workers import available_cores
from rise_envs import ENVS

_EXAMPLES = """\
examples:
  python -m rise_agents.demonstrations --env RISE-GroundVehicle-v0 --episodes 10000 --out demos/vehicle
  python -m rise_agents.demonstrations --env RISE-SafePanda-v0 --expert cbf --episodes 500 --out demos/panda
  python -m rise_agents.demonstrations --env RISE-GroundVehicle-v0 --out demos/vehicle --minari rise/vehicle-v0

With --minari, a set that the folder holds already is exported.

The result is the same for any number of workers. A recording that was stopped goes on where it was: give the same
command again.
"""


def parser() -> Parser:
    """The command line."""
    p = Parser(
        plugins=True,
        prog="python -m rise_agents.demonstrations",
        description="Record an expert's safe and successful episodes.",
        epilog=_EXAMPLES,
    )
    p.add_argument("--env", required=True, metavar="ID", help=f"environment: {', '.join(ENVS)}")
    p.add_argument("--expert", default="mixture", metavar="NAME", help="who demonstrates (default: mixture)")
    p.add_argument("--episodes", type=int, default=1000, metavar="N", help="episodes to keep (default: 1000)")
    p.add_argument(
        "--seed", type=int, default=0, metavar="N", help="range of training seeds, 0 to 999 (default: 0)"
    )
    p.add_argument("--workers", type=int, default=None, metavar="N", help="processes (default: one per core)")
    p.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder to write")
    p.add_argument("--minari", metavar="ID", help="also export to the local Minari store under this id")
    return p


def checked(argv: Sequence[str] | None) -> argparse.Namespace:
    """The arguments; raises ``ValueError`` for whatever can be known to fail before hours of recording."""
    a = parser().parse_args(argv)
    if a.env not in ENVS:
        raise ValueError(f"unknown environment {a.env!r}: {nearest(a.env, ENVS)}")
    if a.expert not in expert_names(a.env):
        raise ValueError(f"unknown expert {a.expert!r}: {nearest(a.expert, expert_names(a.env))}")
    for name in ("episodes", "workers"):
        if getattr(a, name) is not None and getattr(a, name) < 1:
            raise ValueError(f"--{name} must be at least 1, got {getattr(a, name)}")
    episode_seeds("train", a.seed, 0, a.episodes)  # raises where the seeds do not suffice
    if (a.out / demonstrations.DATA).exists() and a.minari is None:
        raise ValueError(f"{a.out} holds a demonstration set already: name another folder or remove it")
    if a.minari is not None:
        check_id(a.minari)
    prepare_folder(a.out)
    return a


def record(a: argparse.Namespace, bars: Progress) -> demonstrations.Demonstrations:
    """Record what the folder lacks; raises :class:`WorkFailed` if a worker process died or gave up."""
    bar = bars.add_task(f"{a.expert} on {a.env}", total=a.episodes)
    try:
        return demonstrations.generate(
            a.env,
            a.expert,
            a.episodes,
            a.seed,
            a.workers or available_cores(),
            finished=lambda kept, tried: bars.update(bar, completed=kept),
            parts=a.out / ".parts" / f"{a.expert}-seed{a.seed}-{chunk_size(a.episodes)}",
        )
    except TaskError as error:
        raise WorkFailed(f"{error}; {KEPT}") from error


def recorded(a: argparse.Namespace) -> demonstrations.Demonstrations:
    """The set that is in the folder already; raises ``ValueError`` if it is not the one that the arguments ask for."""
    made = demonstrations.load(a.out)
    there = {"env": made.env_id, **made.card}
    for name in ("env", "expert", "episodes", "seed"):
        if there.get(name) != getattr(a, name):
            raise ValueError(f"{a.out} holds a set of --{name} {there.get(name)}: name another folder")
    return made


@command("rise_agents.demonstrations", interrupted=INTERRUPTED)
def main(argv: Sequence[str] | None = None) -> int:
    """Record demonstrations; returns the exit code: 0 done, 1 failed, 2 bad arguments, 130 interrupted."""
    console = Console(stderr=True)
    try:
        a = checked(argv)
    except OSError as error:  # of a path that no system takes
        raise ValueError(str(error)) from None
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    bars = Progress(*columns, console=console, disable=not console.is_terminal)
    with at_work(), sole_user(a.out), bars:
        sweep(a.out)
        if (a.out / demonstrations.DATA).exists():  # the export is what is missing
            made = recorded(a)
        else:
            made = record(a, bars)
            made.save(a.out)
        shutil.rmtree(a.out / ".parts", ignore_errors=True)
        if a.minari is not None:
            export(made, a.minari)
    card = made.card
    print(
        f"{card['episodes']:,} episodes, {card['transitions']:,} transitions in {a.out}; "
        f"{card['tried']:,} tried, {100 * card['rejection_rate']:.2f} % rejected as unsafe or unsuccessful"
    )
    return 0


if __name__ == "__main__":
    raise SystemExit(main())

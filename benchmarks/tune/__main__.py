"""The command line of :mod:`benchmarks.tune`."""

from __future__ import annotations

import argparse
import sys
import time
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from benchmarks import job_options
from benchmarks.run import parse_settings
from rise_agents import AGENTS
from rise_agents.cli import INTERRUPTED, Parser, at_work, command, prepare_file, prepare_folder

if TYPE_CHECKING:
    from benchmarks.tune.search import Search

_EXAMPLES = """\
examples:
  python -m benchmarks.tune --agents rise pcbc cppo --envs RISE-GroundVehicle-v0
  python -m benchmarks.tune --agents rise pcbc --demos runs/paper/demonstrations/RISE-GroundVehicle-v0-05b560dddb
  python -m benchmarks.tune --envs RISE-SafePanda-v0 --eval-env RISE-SafePandaKinematic-v0 --write tuned.toml

A search that was stopped continues where it was: give the same command again.
"""


def parser() -> Parser:
    """The command line."""
    p = Parser(
        plugins=True,
        prog="python -m benchmarks.tune",
        description="Search settings, with the same budget for each agent, on validation scenarios.",
        epilog=_EXAMPLES,
    )
    p.add_argument(
        "--agents",
        nargs="+",
        default=["rise", "pcbc", "cppo"],
        metavar="NAME",
        help="agents, or variants of them, to search settings of (default: rise pcbc cppo)",
    )
    p.add_argument(
        "--config",
        nargs="+",
        default=[],
        type=Path,
        metavar="FILE",
        help="config files with variants, and settings that are the same in all trials",
    )
    p.add_argument(
        "--envs", nargs="+", metavar="ID", help="environments (default: all whose results are reported)"
    )
    p.add_argument(
        "--trials",
        type=int,
        default=16,
        metavar="N",
        help="settings in the first round, the defaults among them (default: 16)",
    )
    p.add_argument(
        "--seeds", type=int, default=3, metavar="N", help="training seeds of the second round (default: 3)"
    )
    p.add_argument(
        "--scenarios", type=int, default=400, metavar="N", help="validation scenarios (default: 400)"
    )
    p.add_argument(
        "--clean-loss",
        type=float,
        default=1.0,
        metavar="P",
        help="points that the chosen settings may lose to the best agent on true readings (default: 1)",
    )
    p.add_argument(
        "--demos",
        nargs="+",
        type=Path,
        default=[],
        metavar="DIR",
        help="recorded demonstrations, one set per environment (default: record them)",
    )
    p.add_argument(
        "--episodes",
        type=int,
        default=2_000,
        metavar="N",
        help="episodes to record where no set is given (default: 2000)",
    )
    p.add_argument("--expert", default="mixture", metavar="NAME", help="who demonstrates (default: mixture)")
    p.add_argument(
        "--transitions",
        type=int,
        default=10_000,
        metavar="N",
        help="transitions to learn from, others for each training seed; 0: all (default: 10000)",
    )
    p.add_argument(
        "--eval-env", default="", metavar="ID", help="judge the agents of what this stands in for here"
    )
    p.add_argument(
        "--set",
        nargs="+",
        default=[],
        metavar="AGENT.FIELD=VALUE",
        dest="settings",
        help="settings that are not searched but the same in all trials, for instance rise.average=4",
    )
    job_options.add_options(p)
    p.add_argument(
        "--write", type=Path, metavar="FILE", help="settings file that the chosen settings go into, too"
    )
    p.add_argument(
        "--known",
        type=Path,
        metavar="FILE",
        help="trials.csv of an earlier search: what it measured of the very same trials is not measured again",
    )
    p.add_argument(
        "--out", type=Path, default=Path("runs/tune"), metavar="DIR", help="folder (default: runs/tune)"
    )
    return p


def search_of(a: argparse.Namespace) -> Search:
    """The search that the arguments ask for; raises ``ValueError`` for what can be known to fail before any work."""
    from benchmarks import configs
    from benchmarks.protocol import make_plan
    from benchmarks.tune import settings_file
    from benchmarks.tune.ranking import MODEL
    from benchmarks.tune.search import Search
    from rise_agents.agent import nearest
    from rise_envs import ENVS, STAND_INS

    given = parse_settings(a.settings)
    read = configs.read(configs.files(False, a.config))
    for name in a.agents:
        if name not in AGENTS and name not in read.variants:
            raise ValueError(f"unknown agent {name!r}: {nearest(name, [*AGENTS, *read.variants])}")
    plan = make_plan(
        "quick",
        given,
        a.config,
        agents=tuple(dict.fromkeys(a.agents)),
        envs=tuple(dict.fromkeys(a.envs or [env for env in ENVS if env not in STAND_INS])),
        demos=a.episodes,
        episodes=a.scenarios,
        noise_models=(MODEL,),
        seeds=a.seeds,
        expert=a.expert,
    )
    tried = {
        row: {name: each for name, each in own.items() if name not in given.get(row, {})}
        for row, own in read.searches.items()
    }
    search = Search(plan, a.trials, a.transitions, a.clean_loss / 100, a.eval_env, tuple(a.demos), tried)
    for row, env in search.pairs():
        search.study(row, env)
    if a.write is not None:
        settings_file.read(a.write)
        prepare_file(a.write)
    job_options.check(a)
    return search


@command("benchmarks.tune", interrupted=INTERRUPTED)
def main(argv: Sequence[str] | None = None) -> int:
    """Search settings; returns the exit code: 0 done, 1 something failed, 2 bad arguments, 130 interrupted."""
    started = time.perf_counter()
    a = parser().parse_args(argv)
    warnings.simplefilter("ignore", DeprecationWarning)  # of libraries; their users cannot act on them
    search = search_of(a)
    from benchmarks.tune.known import read
    from benchmarks.tune.search import How, execute, given_sets  # only now: it imports all that work needs

    sets = given_sets(search)
    earlier = read(a.known) if a.known else {}
    prepare_folder(a.out)
    with job_options.pool_of(a, a.out) as pool, at_work():
        from rise_agents.files import sole_user

        told = ("python", "-m", "benchmarks.tune", *(sys.argv[1:] if argv is None else argv))
        how = How(a.workers, a.checkpoint_every, told, a.write, a.tensorboard, earlier, pool)
        with sole_user(a.out):
            failures = execute(search, sets, a.out, how)
    for failure in failures:
        print(f"benchmarks.tune: failed: {failure.job.name}: {failure.reason}", file=sys.stderr)
    print(f"{'Finished' if not failures else 'Stopped'} after {time.perf_counter() - started:.0f} s: {a.out}")
    return 1 if failures else 0


if __name__ == "__main__":
    raise SystemExit(main())

"""The benchmark's command line: ``python -m benchmarks.run --agents rise pcbc cppo``.

Records demonstrations, trains what is not trained yet, runs every agent through the same noisy scenarios, and
writes tables, figures and videos. Run it again in the same folder and it continues where it stopped.
"""

from __future__ import annotations

import argparse
import ctypes
import json
import math
import sys
import time
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from benchmarks import job_options
from benchmarks.labels import count
from benchmarks.presets import PRESETS
from benchmarks.protocol import Plan, make_plan, with_filters
from rise_agents.cli import INTERRUPTED, Parser, at_work, command, prepare_folder

if TYPE_CHECKING:
    from benchmarks.pipeline import Outcome
    from benchmarks.published import Published

# Those of torch that can train. A name that is none of them is refused without importing torch.
_DEVICES = ("cpu", "cuda", "hpu", "mps", "mtia", "xla", "xpu")
_EXAMPLES = """\
examples:
  python -m benchmarks.run --agents rise pcbc cppo                    both tasks, 1,000 scenarios, about 8 minutes
  python -m benchmarks.run --agents rise pcbc --envs RISE-GroundVehicle-v0 --noise-model step episode
  python -m benchmarks.run --agents rise rise-mean pcbc pcbc-noisy --filter kalman
  python -m benchmarks.run --agents expert random --noise-levels 0    what the experts reach on true readings
  python -m benchmarks.run --agents rise --set rise.beta=0.1 --out runs/beta-0.1
  python -m benchmarks.run --agents rise pcbc cppo --preset smoke     everything once, in a minute
  python -m benchmarks.run --agents rise pcbc cppo --pretrained       without training, the weights of the package
  python -m benchmarks.run --preset paper --hours 11.5                stops in time where a job may take 12 hours
  python -m benchmarks.run --agents rise mine --config mine.toml --preset paper --published docs/results --no-videos
                                       what is published is taken from there: only what is new is trained and run

A run that was stopped continues where it was: give the same command again.
"""


def parser() -> Parser:
    """The command line."""
    p = Parser(
        plugins=True,
        prog="python -m benchmarks.run",
        description="Compare agents on noisy obstacle readings: train, evaluate, tables, figures, videos.",
        epilog=_EXAMPLES,
    )
    p.add_argument(
        "--agents",
        nargs="+",
        metavar="NAME",
        help="agents and variants to compare; 'expert' and 'random' add reference rows, NAME+kalman is NAME behind"
        " a filter, expert+true the experts on true readings (default: the preset's, mostly rise pcbc cppo)",
    )
    p.add_argument(
        "--envs", nargs="+", metavar="ID", help="environments (default: all whose results are reported)"
    )
    p.add_argument(
        "--preset",
        default="quick",
        metavar="NAME",
        help=f"how much is trained and measured: {', '.join(PRESETS)} (default: quick)",
    )
    p.add_argument(
        "--pretrained",
        action="store_true",
        help="train nobody: evaluate the weights that come with the package",
    )
    p.add_argument(
        "--config",
        nargs="+",
        type=Path,
        default=[],
        metavar="FILE",
        help="TOML files with settings and variants of agents (see benchmarks/configs/variants.toml)",
    )
    p.add_argument(
        "--filter",
        nargs="+",
        default=[],
        metavar="NAME",
        help="for every row a second one behind this filter, for instance kalman",
    )
    p.add_argument(
        "--published",
        type=Path,
        metavar="DIR",
        help="take the episodes of the same agents from published results, for instance docs/results, instead of"
        " training and running them again; with --pretrained those of the same weights. Their clips need their"
        " training: --no-videos skips both",
    )
    p.add_argument("--seeds", type=int, metavar="N", help="training seeds per agent")
    p.add_argument(
        "--episodes", type=int, metavar="N", help="test scenarios per condition (preset quick: 1,000)"
    )
    p.add_argument(
        "--noise-levels",
        nargs="+",
        type=float,
        metavar="X",
        help="multiples of the environment's reading noise (preset quick: 0 0.5 1 2)",
    )
    p.add_argument(
        "--noise-model",
        nargs="+",
        metavar="MODEL",
        help="step, outlier, episode, drift, dropout, delay, quantise, sums as in step+episode, or on some channels"
        " only, as in step@position+episode@radius (preset quick: step)",
    )
    p.add_argument("--demos", type=int, metavar="N", help="expert episodes to learn from, per environment")
    p.add_argument("--expert", default="mixture", metavar="NAME", help="who demonstrates (default: mixture)")
    p.add_argument(
        "--set",
        nargs="+",
        default=[],
        metavar="AGENT.FIELD=VALUE",
        dest="settings",
        help="settings of an agent or variant, as in rise.beta=0.1 or cppo@RISE-SafePanda-v0.total_steps=100000",
    )
    job_options.add_options(p)
    p.add_argument("--device", default="cpu", help="torch device that agents train on (default: cpu)")
    p.add_argument(
        "--hours",
        type=float,
        metavar="H",
        help="stop after so many hours: what runs is interrupted as by Ctrl-C, tables and figures show what there is,"
        " and the same command goes on (default: when all is done)",
    )
    p.add_argument("--no-videos", action="store_true", help="skip the clips, and the episodes of the page")
    p.add_argument("--out", type=Path, metavar="DIR", help="run folder (default: runs/PRESET)")
    return p  # fmt: skip


def parse_settings(texts: Sequence[str]) -> dict[str, dict[str, Any]]:
    """``AGENT.FIELD=VALUE`` texts as nested settings; values are JSON, or plain words.

    Raises:
        ValueError: a text of another form.
    """
    settings: dict[str, dict[str, Any]] = {}
    for text in texts:
        name, equals, value = text.partition("=")
        agent, dot, field = name.rpartition(".")
        if not (equals and dot and agent and field):
            raise ValueError(f"--set takes AGENT.FIELD=VALUE, for instance rise.beta=0.1, got {text!r}")
        try:
            parsed = json.loads(value)
        except (ValueError, RecursionError):
            parsed = value
        settings.setdefault(agent, {})[field] = parsed
    return settings


def _check_nobody_trains(arguments: argparse.Namespace) -> None:
    """Raise ``ValueError`` for what says how to train, beside --pretrained."""
    usual = parser().parse_args([])
    names = ("seeds", "demos", "expert", "device", "tensorboard", "checkpoint_every")
    given = [name for name in names if getattr(arguments, name) != getattr(usual, name)]
    if given:
        options = " and ".join("--" + name.replace("_", "-") for name in given)
        raise ValueError(f"--pretrained trains nobody: leave out {options}")


def plan_of(arguments: argparse.Namespace) -> Plan:
    """The plan that the arguments ask for, every setting checked before any work starts."""
    from rise_envs import ENVS, STAND_INS

    if arguments.hours is not None and not 0 < arguments.hours < math.inf:
        raise ValueError(f"--hours must be a number above 0, got {arguments.hours:g}")
    if arguments.pretrained:
        _check_nobody_trains(arguments)
    reported = [env for env in ENVS if env not in STAND_INS]
    plan = make_plan(
        arguments.preset,
        parse_settings(arguments.settings),
        arguments.config,
        agents=_rows(arguments),
        envs=tuple(dict.fromkeys(arguments.envs or reported)),
        demos=arguments.demos,
        episodes=arguments.episodes,
        noise_models=None if arguments.noise_model is None else tuple(dict.fromkeys(arguments.noise_model)),
        noise_levels=None if arguments.noise_levels is None else tuple(sorted(set(arguments.noise_levels))),
        seeds=arguments.seeds,
        expert=arguments.expert,
        pretrained=arguments.pretrained,
    )
    from benchmarks.jobs import check_settings  # only now: it imports all that a run needs

    check_settings(plan)
    _check_device(arguments.device)
    job_options.check(arguments)
    return plan


def _source(folder: Path | None, out: Path) -> Published | None:
    """The published results in a folder; raises ``ValueError`` if there are none, or the run would write into them."""
    if folder is None:
        return None
    from benchmarks.published import read

    found = read(folder)
    if folder.resolve() == out.resolve():
        raise ValueError(f"--out is the folder of published results itself, {str(out)!r}: name another")
    return found


def _rows(arguments: argparse.Namespace) -> tuple[str, ...] | None:
    """The rows that were asked for; None: those of the preset."""
    if arguments.agents is None and not arguments.filter:
        return None
    preset = PRESETS.get(arguments.preset)
    return with_filters(arguments.agents or (preset.agents if preset else ()), arguments.filter)


def _has_gpu_driver() -> bool:
    """Whether NVIDIA's or AMD's driver is there; torch calls both cuda."""
    for library in ("libcuda.so.1", "nvcuda.dll"):
        try:
            ctypes.CDLL(library)
        except OSError:
            continue
        return True
    return Path("/dev/kfd").exists()


def _check_device(device: str) -> None:
    if device == "cpu":
        return
    kind, colon, index = device.partition(":")
    if kind not in _DEVICES or (colon and not (index.isascii() and index.isdecimal())):
        raise ValueError(f"--device {device[:40]!r} is none of torch: known: {', '.join(_DEVICES)}")
    if kind == "cuda" and not _has_gpu_driver():
        raise ValueError(f"--device {device} cannot be used here: no driver of a GPU is installed")
    import torch  # a second or more, but only torch knows whether it can use a device

    try:
        torch.zeros(1, device=device)
    except (AssertionError, RuntimeError) as error:
        reason = str(error).splitlines()[0]
        raise ValueError(f"--device {device} cannot be used here: {reason}") from None


def time_limit(
    hours: float, started: float, clock: Callable[[], float] = time.perf_counter
) -> Callable[[], bool]:
    """What says whether ``hours`` have passed since ``started``, seconds of ``clock``."""
    return lambda: clock() - started >= 3600 * hours


def _told(outcome: Outcome, hours: float | None, out: Path) -> list[str]:
    """What was not done, a line each."""
    lines = [f"failed: {failure.job.name}: {failure.reason}" for failure in outcome.failures]
    if lines:
        lines.append(f"where in the code: {out / 'failures.log'}")
    if outcome.stopped:
        left = f"{count([len(outcome.left)], 'job')} {'is' if len(outcome.left) == 1 else 'are'} left"
        lines.append(f"stopped by --hours after {hours:g} h; {left}: give the same command again to go on")
    return lines


@command("benchmarks.run", interrupted=INTERRUPTED)
def main(argv: Sequence[str] | None = None) -> int:
    """Run the benchmark; returns the exit code: 0 done, 1 not all was done, 2 bad arguments, 130 interrupted."""
    started = time.perf_counter()
    arguments = parser().parse_args(argv)
    warnings.simplefilter("ignore", DeprecationWarning)  # of libraries; their users cannot act on them
    plan = plan_of(arguments)
    out = arguments.out or Path("runs") / arguments.preset
    source = _source(arguments.published, out)
    prepare_folder(out)
    with job_options.pool_of(arguments, out) as pool, at_work():
        from benchmarks.executors import never
        from benchmarks.pipeline import How, execute
        from rise_agents.files import sole_user

        how = How(
            workers=arguments.workers,
            device=arguments.device,
            videos=not arguments.no_videos,
            every=arguments.checkpoint_every,
            command=("python", "-m", "benchmarks.run", *(sys.argv[1:] if argv is None else argv)),
            tensorboard=arguments.tensorboard,
            source=source,
            time_is_up=never if arguments.hours is None else time_limit(arguments.hours, started),
            pool=pool,
        )
        with sole_user(out):
            outcome = execute(plan, out, how)
    lines = _told(outcome, arguments.hours, out)
    for line in lines:
        print(f"benchmarks.run: {line}", file=sys.stderr)
    print(f"{'Stopped' if lines else 'Finished'} after {time.perf_counter() - started:.0f} s: {out}")
    return 1 if lines else 0


if __name__ == "__main__":
    raise SystemExit(main())

"""The command line: ``python -m rise_agents.runtime``."""

from __future__ import annotations

import signal
import sys
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from rise_agents.agent import nearest
from rise_agents.checkpoint import CheckpointError
from rise_agents.cli import Parser, WorkFailed, at_work, command, prepare_file
from rise_agents.runtime import log
from rise_agents.runtime.loop import ControlLoop, Mind, Monotonic
from rise_agents.runtime.policies import load_policy, warm_up
from rise_agents.runtime.robots import EnvRobot
from rise_agents.runtime.streams import NoisyStream, ReadingStream, RobotReadings
from rise_agents.runtime.summary import summarise, text
from rise_agents.runtime.udp import LOOPBACK, UdpStream, address
from rise_agents.runtime.watchdog import Limits, Rules
from rise_envs import ENVS
from rise_envs.noise import make_noise
from rise_envs.settings import finite
from rise_envs.streams import checked_seed
from rise_envs.task import env_class, task_of

_EXAMPLES = """\
examples:
  python -m rise_agents.runtime --agent agent.rise --env RISE-SafePanda-v0 --seconds 60
  python -m rise_agents.runtime --agent agent.onnx --env RISE-GroundVehicle-v0 --noise-model step+dropout:0.2
  python -m rise_agents.runtime --agent agent.rise --env RISE-SafePanda-v0 --udp 5005 --noise-level 0 &
  python -m rise_agents.runtime.send --env RISE-SafePanda-v0 --to 127.0.0.1:5005 --seconds 60
"""


def parser() -> Parser:
    """The command line."""
    p = Parser(
        plugins=True,
        prog="python -m rise_agents.runtime",
        description="Let a trained agent control a simulated robot in real time, past a virtual obstacle.",
        epilog=_EXAMPLES,
    )
    p.add_argument("--agent", required=True, metavar="CKPT", help="checkpoint, exported file (.onnx) or name")
    p.add_argument("--env", required=True, metavar="ID", help="the robot's task")
    p.add_argument("--seconds", type=float, default=60.0, metavar="S", help="how long (default: 60)")
    p.add_argument("--rate", type=float, metavar="HZ", help="periods a second (default: the task's own)")
    p.add_argument("--seed", type=int, default=0, metavar="N", help="of episodes, noise, draws (default: 0)")
    p.add_argument("--noise-model", default="step", metavar="MODEL", help="of the readings (default: step)")
    p.add_argument("--noise-level", type=float, default=1.0, metavar="X", help="multiplies it (default: 1)")
    p.add_argument(
        "--udp", metavar="[HOST:]PORT", help="goal and obstacles come as datagrams (HOST: loopback)"
    )
    p.add_argument("--log", type=Path, metavar="FILE", help="where the run is kept (default: not)")
    p.add_argument(
        "--stale-after",
        type=float,
        default=1.9,
        metavar="X",
        help="periods that a reading is good for (default: 1.9)",
    )
    p.add_argument(
        "--overruns", type=int, default=3, metavar="N", help="late periods in a row that stop it (default: 3)"
    )
    p.add_argument(
        "--resume-after", type=float, metavar="S", help="go on after so long without trouble (default: never)"
    )
    p.add_argument(
        "--rate-limit",
        type=float,
        nargs="+",
        metavar="X",
        help="greatest change of each action a second (default: any)",
    )
    p.add_argument(
        "--spin", type=float, default=0.5, metavar="MS", help="awake before a period (default: 0.5)"
    )
    return p


def _checked(a: Any) -> tuple[Rules, Limits, float]:
    """Rules, limits and period that the arguments ask for."""
    if a.env not in ENVS:
        raise ValueError(f"--env {a.env!r} is none of ours: {nearest(a.env, ENVS)}")
    checked_seed(a.seed)
    task = task_of(a.env)
    finite("--seconds", a.seconds, 1e-3)
    finite("--spin", a.spin, 0.0, 1e3)
    period = task.dt if a.rate is None else 1.0 / finite("--rate", a.rate, 1e-3, 1e4)
    make_noise(a.noise_model, a.noise_level, task.noise_channels)
    env = env_class(a.env)()
    space = env.action_space
    env.close()
    rate = None if a.rate_limit is None else np.array(a.rate_limit)
    limits = Limits(space.low.astype(np.float64), space.high.astype(np.float64), rate)
    if a.log is not None:
        prepare_file(a.log)
    return Rules(a.stale_after, a.overruns, a.resume_after), limits, period


_POLITE = (signal.SIGINT, signal.SIGTERM)


def _handle(how: Any) -> list[Any]:
    return [signal.signal(number, how) for number in _POLITE]


def _ignore(*_: Any) -> None:
    """Nothing; with ``SIG_IGN`` in its place Python complains of a signal that came before, but was not handled yet."""


@contextmanager
def _interrupted_once() -> Iterator[None]:
    """Ctrl-C and a polite kill end the run; another one cuts short neither the robot's stop nor the log."""

    def interrupt(*_: Any) -> None:
        _handle(_ignore)
        raise KeyboardInterrupt

    before = _handle(interrupt)
    try:
        yield
    finally:
        for number, handler in zip(_POLITE, before, strict=True):
            signal.signal(number, handler)


@command("rise_agents.runtime", bad_input=(CheckpointError, ImportError))
def main(argv: Sequence[str] | None = None) -> int:
    """Control; returns the exit code: 0 done, 1 the robot or the disk failed, 2 bad arguments, 130 interrupted."""
    a: Any = parser().parse_args(argv)
    rules, limits, period = _checked(a)
    policy, task, clock = load_policy(a.agent, a.env), task_of(a.env), Monotonic(1e-3 * a.spin)
    with ExitStack() as stack:
        udp = None if a.udp is None else stack.enter_context(_listening(a.udp, task, clock))
        robot = EnvRobot(a.env, clock, a.seed, follow=udp)
        stack.callback(robot.close)
        true: ReadingStream = RobotReadings(robot) if udp is None else udp
        stream = NoisyStream(true, task, a.noise_model, a.noise_level, a.seed)
        warm_up(policy, task)
        mind = Mind(policy, a.seed)
        about = {
            **{"agent": a.agent, "env": a.env, "seed": a.seed, "period": period, "noise": a.noise_model},
            **{"noise_level": a.noise_level, "udp": a.udp, "deterministic": mind.deterministic},
            **{"stale_after": rules.stale_after, "overruns": rules.overruns, "resume_after": a.resume_after},
            **{"rate_limit": a.rate_limit},
        }
        recorder = log.Recorder(task, len(limits.low), about)
        loop = ControlLoop(mind, robot, stream, task, limits, period, rules, clock, recorder)
        with at_work(), _interrupted_once():
            return _run(loop, a, udp)


def _run(loop: ControlLoop, a: Any, udp: UdpStream | None) -> int:
    code = 0
    try:
        loop.run(a.seconds)
        _handle(_ignore)
    except KeyboardInterrupt:
        code = 130
    found = loop.recorder.log()
    if len(found):
        print(text(summarise(found)))
    if udp is not None:
        counts = udp.receiver.counts
        print("datagrams   " + ", ".join(f"{counts[key]:,} {key}" for key in sorted(counts)))
    if a.log is not None:
        log.write(a.log, found)
        print(f"kept in     {a.log}")
    stopped = loop.watchdog.stopped
    if stopped is not None and stopped.kind == "robot":
        raise WorkFailed(str(stopped))
    return code


@contextmanager
def _listening(text: str, task: Any, clock: Monotonic) -> Iterator[UdpStream]:
    where = address(text)
    try:
        stream = UdpStream(task, where, clock.now)
    except OSError as error:
        raise ValueError(f"--udp {text}: cannot listen there ({error.strerror or error})") from None
    print(f"listening   {stream.address[0]}:{stream.address[1]}", flush=True)
    if where[0] not in (LOOPBACK, "::1", "localhost"):
        print("rise_agents.runtime: whoever can send to this port moves the obstacle", file=sys.stderr)
    try:
        yield stream
    finally:
        stream.close()


if __name__ == "__main__":
    raise SystemExit(main())

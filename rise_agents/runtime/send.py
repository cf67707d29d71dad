"""The command line ``python -m rise_agents.runtime.send``: a virtual obstacle for a loop in another process."""

from __future__ import annotations

import secrets
import socket
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rise_agents.agent import nearest
from rise_agents.cli import Parser, WorkFailed, command
from rise_agents.runtime import log
from rise_agents.runtime.loop import Clock, Monotonic
from rise_agents.runtime.udp import Packet, address, pack
from rise_envs import ENVS
from rise_envs.settings import finite, whole
from rise_envs.streams import checked_seed
from rise_envs.task import env_class, task_of

# Goal and reading at a time (s from the start); None: there are no more.
Source = Callable[[float], tuple[NDArray, NDArray] | None]

_EXAMPLES = """\
examples:
  python -m rise_agents.runtime.send --env RISE-SafePanda-v0 --to 127.0.0.1:5005 --seconds 60
  python -m rise_agents.runtime.send --log run.parquet --to 127.0.0.1:5005
"""


def parser() -> Parser:
    """The command line."""
    p = Parser(
        plugins=True,
        prog="python -m rise_agents.runtime.send",
        description="Send goal and obstacles of an environment, or of a recorded run, as UDP datagrams.",
        epilog=_EXAMPLES,
    )
    p.add_argument("--env", metavar="ID", help="whose obstacles and goal are sent, as they are")
    p.add_argument("--log", type=Path, metavar="FILE", help="or: the readings of this run, as they were")
    p.add_argument("--to", default="5005", metavar="HOST:PORT", help="where to (default: 5005 on loopback)")
    p.add_argument(
        "--rate", type=float, default=100.0, metavar="HZ", help="datagrams a second (default: 100)"
    )
    p.add_argument("--seconds", type=float, default=60.0, metavar="S", help="how long (default: 60)")
    p.add_argument("--seed", type=int, default=0, metavar="N", help="of the episode (default: 0)")
    return p


class VirtualObstacle:
    """Obstacles and goal of an episode in which the robot stands still; between steps they move straight."""

    def __init__(self, env_id: str, seed: int) -> None:
        self.task = task_of(env_id)
        self._env: Any = env_class(env_id)()
        space = self._env.action_space
        self._rest = np.clip(np.zeros(space.shape), space.low, space.high).astype(space.dtype)
        self._seen, _ = self._env.reset(seed=seed)
        self._step = 0

    def __call__(self, time: float) -> tuple[NDArray, NDArray]:
        """Goal (D,) and reading (C,) at ``time`` (s), which never goes back."""
        dt = self.task.dt
        while (self._step + 1) * dt <= time:
            self._seen = self._env.step(self._rest)[0]
            self._step += 1
        position, velocity, radius = self.task.split(self._seen["obstacle"][None])
        now = position + (time - self._step * dt) * velocity
        c = np.concatenate((now, velocity, radius[..., None]), -1)
        return self._seen["desired_goal"], c.ravel()


def recorded(found: log.Log) -> Source:
    """The goals and readings of a run, when they were read; periods without one are left out."""
    known = np.isfinite(found.vectors["reading"]).all(1)
    if not known.any():
        raise ValueError("the run has no readings")
    time = found.numbers["begin"][known]
    goal, reading = (found.vectors[name][known] for name in ("goal", "reading"))

    def source(now: float) -> tuple[NDArray, NDArray] | None:
        row = int(np.searchsorted(time - time[0], now, side="right")) - 1
        return None if now > time[-1] - time[0] else (goal[row], reading[row])

    return source


def send(
    source: Source, to: Callable[[bytes], Any], rate: float, seconds: float, clock: Clock | None = None
) -> int:
    """Send what a source says at a fixed rate; returns the number of datagrams."""
    clock, session = Monotonic() if clock is None else clock, secrets.randbits(64)
    start, count = clock.now(), 0
    while count < seconds * rate:
        clock.wait(start + count / rate)
        now = clock.now()
        said = source(now - start)
        if said is None:
            break
        to(pack(Packet(session, count, now, *said)))
        count += 1
    return count


def _source(a: Any) -> Source:
    if (a.env is None) == (a.log is None):
        raise ValueError("name one of --env and --log")
    if a.log is not None:
        return recorded(log.read(a.log))
    if a.env not in ENVS:
        raise ValueError(f"--env {a.env!r} is none of ours: {nearest(a.env, ENVS)}")
    return VirtualObstacle(a.env, checked_seed(a.seed))


@command("rise_agents.runtime.send")
def main(argv: Sequence[str] | None = None) -> int:
    """Send; returns the exit code: 0 done, 1 the network failed, 2 bad arguments, 130 interrupted."""
    a: Any = parser().parse_args(argv)
    finite("--rate", a.rate, 1e-3, 1e4)
    finite("--seconds", a.seconds, 0.0)
    to = address(a.to)
    whole("the port of --to", to[1], 1)
    source = _source(a)
    family = socket.AF_INET6 if ":" in to[0] else socket.AF_INET
    try:
        with socket.socket(family, socket.SOCK_DGRAM) as out:
            count = send(source, lambda data: _to(out, data, to), a.rate, a.seconds)
    except socket.gaierror as error:
        raise ValueError(f"--to {a.to}: {error.strerror}") from None
    except OSError as error:
        raise WorkFailed(f"cannot send to {a.to}: {error.strerror}") from None
    print(f"{count:,} datagrams sent to {to[0]}:{to[1]}")
    return 0


def _to(out: socket.socket, data: bytes, to: tuple[str, int]) -> None:
    try:
        out.sendto(data, to)
    except ConnectionRefusedError:  # nobody listens yet, or no more: the next one may arrive
        pass


if __name__ == "__main__":
    raise SystemExit(main())

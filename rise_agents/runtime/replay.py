"""The command line ``python -m rise_agents.runtime.replay``: what happened in a run, and whether it happens again."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from rise_agents.checkpoint import CheckpointError
from rise_agents.cli import Parser, command
from rise_agents.runtime import log
from rise_agents.runtime.loop import Mind
from rise_agents.runtime.policies import load_policy
from rise_agents.runtime.summary import summarise, text

_EXAMPLES = """\
examples:
  python -m rise_agents.runtime.replay run.parquet
  python -m rise_agents.runtime.replay run.parquet --agent agent.rise    decides again on what was read, and compares
"""


def parser() -> Parser:
    """The command line."""
    p = Parser(
        plugins=True,
        prog="python -m rise_agents.runtime.replay",
        description="Tell what happened in a recorded run; with the agent, decide it all again.",
        epilog=_EXAMPLES,
    )
    p.add_argument("log", type=Path, metavar="LOG", help="what python -m rise_agents.runtime --log wrote")
    p.add_argument("--agent", metavar="CKPT", help="checkpoint, exported file or name: compare its decisions")
    return p


def decide_again(found: log.Log, policy: Any) -> float:
    """Largest difference between what ``policy`` wants on the recorded observations and what was wanted then.

    Decisions that were discarded are not in a log; they changed nothing that the policy remembers
    (:class:`rise_agents.runtime.loop.Mind`).

    Raises:
        ValueError: a policy that cannot read them, or nothing was decided.
    """
    mind = Mind(policy, int(found.about["seed"]), bool(found.about["deterministic"]))
    largest = -1.0
    for t in np.flatnonzero(np.isfinite(found.vectors["wanted"]).all(1)):
        parts = {"observation": "state", "desired_goal": "goal", "obstacle": "reading"}
        seen = {key: found.vectors[name][t] for key, name in parts.items()}
        wanted = mind.decide(seen, bool(found.flags["fresh"][t]))
        if np.shape(wanted) != found.vectors["wanted"][t].shape:
            raise ValueError(f"the agent's actions are {np.shape(wanted)}, the log's are others")
        largest = max(largest, float(np.abs(wanted - found.vectors["wanted"][t]).max()))
    if largest < 0:
        raise ValueError("nothing was decided in this run")
    return largest


@command("rise_agents.runtime.replay", bad_input=(CheckpointError, ImportError))
def main(argv: Sequence[str] | None = None) -> int:
    """Replay; returns the exit code: 0 done, 2 bad arguments or files, 130 interrupted."""
    a: Any = parser().parse_args(argv)
    try:
        found = log.read(a.log)
        print(
            f"{a.log}: {found.about.get('agent', 'a policy')} in {found.about.get('env', 'a task of its own')}"
        )
        print(text(summarise(found)))
        for t, event in enumerate(found.events):
            if event:
                print(f"{found.numbers['begin'][t]:10.3f} s  {event}")
        if a.agent:
            difference = decide_again(found, load_policy(a.agent, str(found.about["env"])))
            print(f"decided again by {a.agent}: actions differ by {difference:.1e} at most")
    except (KeyError, TypeError) as error:
        raise ValueError(f"{a.log}: says not enough of its run ({error})") from None
    return 0


if __name__ == "__main__":
    raise SystemExit(main())

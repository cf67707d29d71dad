"""The command line: ``python -m benchmarks.fidelity``."""

from __future__ import annotations

import time
import warnings
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

from rise_agents.cli import Parser, command, prepare_folder

_EXAMPLES = """\
examples:
  python -m benchmarks.fidelity                               all of it, some ten minutes
  python -m benchmarks.fidelity --quick                       seconds: shows that it runs, no more
  python -m benchmarks.fidelity --docs docs/environments.md   measure, then renew the tables and the figure of the page
"""
_LEVELS = (0.0, 1.0)


def parser() -> Parser:
    """The command line."""
    p = Parser(
        prog="python -m benchmarks.fidelity",
        description="Measure how far RISE-SafePandaKinematic-v0 is from Bullet: hand, clearance, Safety and Reach.",
        epilog=_EXAMPLES,
    )
    p.add_argument(
        "--episodes", type=int, default=1_000, metavar="N", help="scenarios of each agent (default: 1000)"
    )
    p.add_argument("--quick", action="store_true", help="a handful of episodes, barely trained agents")
    p.add_argument(
        "--docs", type=Path, metavar="PAGE", help="renew the tables in this page, and images/fidelity.png"
    )
    p.add_argument(
        "--out",
        type=Path,
        default=Path("runs/fidelity"),
        metavar="DIR",
        help="folder (default: runs/fidelity)",
    )
    return p


def _tell(tell: Any, share: float) -> None:
    """Say how much is done, without figures."""
    tell(share, {})


def measure_all(episodes: int, quick: bool) -> tuple[list[Any], dict[str, Any]]:
    """All rows of ``fidelity.csv``, and the paths that the figure shows."""
    from benchmarks.display import Display
    from benchmarks.fidelity import measure, page

    count, demos, updates = (3, 4, 20) if quick else (200, 300, 4_000)
    rows: list[Any] = []
    paths: dict[str, Any] = {}
    kinds: dict[str, Any] = {
        "random": lambda tell: measure.random_paths(count, False, tell),
        "table": lambda tell: measure.random_paths(count, True, tell),
        "cbf": lambda tell: measure.expert_paths("cbf", count, tell),
        "mpc": lambda tell: measure.expert_paths("mpc", count, tell),
    }
    with Display() as display:
        for name, measured in kinds.items():
            with display.step(f"actions {page.TITLES[name]}") as tell:
                paths[name] = measured(partial(_tell, tell))
                rows += page.path_rows(name, paths[name])
        for name in ("cbf", "mpc", "pcbc", "rise"):
            expert = name in kinds
            if expert:
                policy = measure.make_expert(name, measure.BULLET)
            else:
                with display.step(f"train {name}") as tell:
                    policy = measure.trained(name, demos, updates, partial(_tell, tell))
            # A step of the MPC expert takes ten times as long as one of the engine.
            scenarios = max(3, episodes // 5) if name == "mpc" else episodes
            label = f"expert-{name}" if expert else name
            for level in _LEVELS:
                with display.step(f"{label} at noise {level:g}, in both") as tell:
                    loops = measure.closed_loop(policy, level, scenarios, partial(_tell, tell))
                rows += page.loop_rows(label, level, loops)
    return rows, paths


@command("benchmarks.fidelity")
def main(argv: Sequence[str] | None = None) -> int:
    """Measure and write; returns the exit code: 0 done, 2 bad arguments, 130 interrupted.

    A target that is not met is no failure of the command.
    """
    started = time.perf_counter()
    arguments = parser().parse_args(argv)
    if arguments.episodes < 3:
        raise ValueError(f"--episodes must be at least 3, got {arguments.episodes}")
    if arguments.docs:
        from benchmarks.pages import FIDELITY

        FIDELITY.check(arguments.docs)
    out: Path = arguments.out
    prepare_folder(out)
    warnings.simplefilter("ignore", DeprecationWarning)  # of libraries; their users cannot act on them
    from benchmarks import plots
    from benchmarks.fidelity import page
    from benchmarks.results import atomic_write_text
    from rise_agents.workers import limit_threads

    limit_threads()
    rows, paths = measure_all(3 if arguments.quick else arguments.episodes, arguments.quick)
    page.write_csv(out / "fidelity.csv", rows)
    drawn = page.figure(paths)
    plots.save_png(drawn, out / "fidelity.png")
    text = page.markdown(rows, "fidelity.png")
    atomic_write_text(out / "fidelity.md", text + "\n")
    if arguments.docs:
        plots.save_png(drawn, arguments.docs.parent / "images" / "fidelity.png")
        page.BLOCK.update(arguments.docs, page.markdown(rows, "images/fidelity.png"))
    print(text)
    for row in rows:
        if not row.met:
            print(f"not met: {row.name}: {row.quantity} {row.value:.1f} {row.unit}, wanted {row.target:g}")
    print(f"Finished after {time.perf_counter() - started:.0f} s: {out}")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())

"""The command line: ``python -m benchmarks.speed``."""

from __future__ import annotations

import argparse
import sys
import time
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rise_agents.agent import nearest
from rise_agents.cli import Parser, command, prepare_folder

THROUGHPUT = "throughput"  # the figure, named among the rows
_EXAMPLES = """\
examples:
  python -m benchmarks.speed                              every row and the figure, about five minutes
  python -m benchmarks.speed --rows vehicles panda        two rows
  python -m benchmarks.speed --bench-times                and the whole benchmark, cold and warm: ten minutes more
  python -m benchmarks.speed --docs docs/performance.md   measure, then renew the table and figure of the page
  python -m benchmarks.speed --docs docs/performance.md --render   the same from the last measurement

Close other programs first: every row compares two sides that take turns, but a busy machine still blurs it.
"""


def parser() -> Parser:
    """The command line."""
    p = Parser(
        prog="python -m benchmarks.speed",
        description="Measure the suite's speed against its peers, in turn.",
        epilog=_EXAMPLES,
    )
    p.add_argument(
        "--rows", nargs="+", metavar="NAME", help="rows to measure; 'throughput' is the figure (default: all)"
    )
    p.add_argument(
        "--repeats", type=int, default=7, metavar="N", help="measurements of each side (default: 7)"
    )
    p.add_argument("--quick", action="store_true", help="small sizes, seconds: shows that it runs, no more")
    p.add_argument("--bench-times", action="store_true", help="also time the whole benchmark, twice")
    p.add_argument(
        "--docs", type=Path, metavar="PAGE", help="renew the table in this page, and images/throughput.png"
    )
    p.add_argument("--render", action="store_true", help="measure nothing: use what is in the folder")
    p.add_argument(
        "--out", type=Path, default=Path("runs/speed"), metavar="DIR", help="folder (default: runs/speed)"
    )
    return p


def chosen(arguments: argparse.Namespace) -> list[str]:
    """The names of the rows to measure; raises ``ValueError`` for an unknown one, or a page without block."""
    from benchmarks.pages import SPEED
    from benchmarks.speed.rows import ROWS

    if arguments.docs:
        SPEED.check(arguments.docs)
    if arguments.repeats < 1:
        raise ValueError(f"--repeats must be at least 1, got {arguments.repeats}")
    known = [*ROWS, THROUGHPUT]
    for name in arguments.rows or ():
        if name not in known:
            raise ValueError(f"unknown row {name!r}: {nearest(name, known)}")
    slow = [name for name, row in ROWS.items() if not row.by_default]
    names = list(arguments.rows or [name for name in known if name not in slow])
    # The whole benchmark first: nothing has been compiled yet by then, in an installation that is new.
    return list(dict.fromkeys([*(slow if arguments.bench_times else []), *names]))


def measure_all(names: Sequence[str], arguments: argparse.Namespace, out: Path) -> list[str]:
    """Measure and write ``speed.csv``, ``machine.txt`` and ``throughput.csv``; returns what went wrong."""
    from benchmarks import pages
    from benchmarks.display import Display
    from benchmarks.results import atomic_write_text
    from benchmarks.speed import measure, throughput
    from benchmarks.speed.rows import ROWS

    quick = arguments.quick
    repeats = min(arguments.repeats, 2) if quick else arguments.repeats
    effort = measure.Effort(repeats, 0.01 if quick else 0.25, quick, out)
    results: list[measure.Result] = []
    wrong: list[str] = []
    with Display() as display:
        for name in names:
            with display.step(name) as tell:
                tell(0.0, {})
                if name == THROUGHPUT:
                    points, failed = throughput.sweep(effort, tell)
                    throughput.write_points(out / "throughput.csv", points)
                    wrong += [f"{THROUGHPUT}, {line}" for line in failed]
                    continue
                row = ROWS[name]
                try:
                    results.append(measure.measure(row, effort, tell))
                except measure.Unavailable as error:
                    results.append(measure.not_measured(row, str(error)))
                except Exception as error:
                    results.append(measure.not_measured(row, pages.reason(error)))
                    wrong.append(f"{name}: {pages.reason(error)}")
    table = out / "speed.csv"
    if results:  # rows that were not measured now stay as they are
        old = measure.read_csv(table) if table.exists() else []
        measure.write_csv(table, pages.renewed(old, results, ROWS))
    atomic_write_text(out / "machine.txt", pages.machine() + "\n")
    return wrong


def render(out: Path, docs: Path | None) -> None:
    """Table, ``speed.md`` and figure from the files in ``out``; raises ``ValueError`` if they are not there."""
    from benchmarks import plots
    from benchmarks.results import atomic_write_text
    from benchmarks.speed import measure, page, throughput

    points = out / "throughput.csv"
    if points.exists():
        drawn = throughput.figure(throughput.read_points(points))
        plots.save_png(drawn, out / "throughput.png")
        if docs:
            plots.save_png(drawn, docs.parent / "images" / "throughput.png")
    table = out / "speed.csv"
    if not table.exists() and points.exists() and not docs:
        return
    results = measure.read_csv(table)
    about = (out / "machine.txt").read_text().strip()
    picture = "throughput.png" if points.exists() else None
    atomic_write_text(out / "speed.md", "# Speed\n\n" + page.markdown(results, about, picture))
    if docs:
        image = docs.parent / "images" / "throughput.png"
        page.update_page(docs, results, about, image if image.exists() else None)
    print(page.table_text(results))


@command("benchmarks.speed")
def main(argv: Sequence[str] | None = None) -> int:
    """Measure and report; returns the exit code: 0 done, 1 a row failed, 2 bad arguments, 130 interrupted.

    A target that is not met is no failure of the command.
    """
    started = time.perf_counter()
    arguments: Any = parser().parse_args(argv)
    names = chosen(arguments)
    prepare_folder(arguments.out)
    warnings.simplefilter("ignore", DeprecationWarning)  # of libraries; their users cannot act on them
    from rise_agents.workers import limit_threads

    limit_threads()
    wrong = [] if arguments.render else measure_all(names, arguments, arguments.out)
    render(arguments.out, arguments.docs)
    for line in wrong:
        print(f"benchmarks.speed: failed: {line}", file=sys.stderr)
    print(f"Finished after {time.perf_counter() - started:.0f} s: {arguments.out}")
    return 1 if wrong else 0


if __name__ == "__main__":
    raise SystemExit(main())

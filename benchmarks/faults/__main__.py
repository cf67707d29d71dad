"""The command line: ``python -m benchmarks.faults``."""

from __future__ import annotations

import argparse
import math
import sys
import time
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from rise_agents.agent import nearest
from rise_agents.cli import Parser, command, prepare_folder
from rise_agents.workers import available_cores

if TYPE_CHECKING:
    from benchmarks.faults import measure

QUICK = 0.02
_SHOWN = 20  # faults of a row that are printed; all are in faults.txt
_EXAMPLES = """\
examples:
  python -m benchmarks.faults                                      every row in full: about an hour
  python -m benchmarks.faults --quick                              a fiftieth of the trials: some ten minutes
  python -m benchmarks.faults --rows mutated-checkpoints fuzz      two rows
  python -m benchmarks.faults --rows fuzz --seed 7 --only 4711     one trial again, as a fault that was found says
  python -m benchmarks.faults --docs docs/reliability.md           try everything, then renew the table of the page
  python -m benchmarks.faults --docs docs/reliability.md --render  the same from the last trials

Everything happens in a temporary folder, which is kept, and named, if something was found. Rows that are tried again
take the place of the former ones in the table; the others stay.
"""


def parser() -> Parser:
    """The command line."""
    p = Parser(
        prog="python -m benchmarks.faults",
        description="Try to break the suite: killed processes, full disks, forged files, hostile arguments.",
        epilog=_EXAMPLES,
    )
    p.add_argument("--rows", nargs="+", metavar="NAME", help="rows to try (default: all)")
    p.add_argument(
        "--share", type=float, metavar="X", help="of the full number of trials, in (0, 1] (default: 1)"
    )
    p.add_argument("--quick", action="store_true", help=f"the same as --share {QUICK:g}")
    p.add_argument("--seed", type=int, default=0, metavar="N", help="of everything random (default: 0)")
    p.add_argument("--only", type=int, metavar="N", help="the trial of this number alone, of one row")
    p.add_argument("--workers", type=int, metavar="N", help="processes (default: one per core)")
    p.add_argument("--docs", type=Path, metavar="PAGE", help="renew the table in this page")
    p.add_argument("--render", action="store_true", help="try nothing: use what is in the folder")
    p.add_argument(
        "--out", type=Path, default=Path("runs/faults"), metavar="DIR", help="folder (default: runs/faults)"
    )
    return p


def share_of(arguments: argparse.Namespace) -> float:
    """The share of the trials to make; raises ``ValueError`` for what cannot be one."""
    if arguments.quick and arguments.share is not None:
        raise ValueError("--quick and --share say the same: give one of them")
    share = QUICK if arguments.quick else 1.0 if arguments.share is None else arguments.share
    if not (math.isfinite(share) and 0 < share <= 1):
        raise ValueError(f"--share must lie in (0, 1], got {arguments.share}")
    return share


def chosen(arguments: argparse.Namespace) -> list[str]:
    """The names of the rows to try; raises ``ValueError`` for arguments that make no sense."""
    from benchmarks.faults.rows import ROWS
    from benchmarks.pages import FAULTS

    for name in arguments.rows or ():
        if name not in ROWS:
            raise ValueError(f"unknown row {name!r}: {nearest(name, ROWS)}")
    names = list(dict.fromkeys(arguments.rows or ROWS))
    if arguments.seed < 0:
        raise ValueError(f"--seed must not be negative, got {arguments.seed}")
    if arguments.workers is not None and arguments.workers < 1:
        raise ValueError(f"--workers must be at least 1, got {arguments.workers}")
    if arguments.only is not None and (arguments.only < 0 or len(names) != 1):
        raise ValueError("--only takes the number of a trial, from 0 on, of the one row that --rows names")
    if arguments.only is not None and (arguments.render or arguments.docs):
        raise ValueError("--only makes one trial, which is no table: leave out --render and --docs")
    if arguments.docs:
        FAULTS.check(arguments.docs)
    return names


def try_all(names: Sequence[str], share: float, arguments: argparse.Namespace) -> list[measure.Result]:
    """Make the trials; writes ``faults.csv``, ``faults.txt`` and ``machine.txt``, but for ``--only`` one trial.

    Returns:
        The results of the rows that were tried.
    """
    from benchmarks import pages
    from benchmarks.display import Display
    from benchmarks.faults import measure
    from benchmarks.faults.rows import ROWS
    from benchmarks.results import atomic_write_text

    workers = arguments.workers or available_cores()
    out: Path = arguments.out
    table = out / "faults.csv"
    results = measure.read_csv(table) if table.exists() else []  # other rows stay as they are
    tried: list[measure.Result] = []
    lines: list[str] = []
    if arguments.only is None:
        atomic_write_text(out / "machine.txt", pages.machine() + "\n")
    with measure.temporary_folder(keep=lambda: bool(lines)) as folder, Display() as display:
        effort = measure.Effort(share, arguments.seed, workers, arguments.only, folder)
        for name in names:
            with display.step(name) as tell:
                tell(0.0, {})
                result, found = measure.measure(ROWS[name], effort, tell)
            for line in found[:_SHOWN]:
                print(f"benchmarks.faults: {line}", file=sys.stderr)
            if found[_SHOWN:]:
                print(f"benchmarks.faults: {name}: {len(found) - _SHOWN} more", file=sys.stderr)
            tried.append(result)
            lines += found
            if arguments.only is not None:
                continue
            results = pages.renewed(results, [result], ROWS)
            # After each row: an interruption hours later loses only the row that it meets.
            measure.write_csv(table, results)
            atomic_write_text(out / "faults.txt", "".join(f"{line}\n" for line in lines))
    if lines:
        print(f"benchmarks.faults: the files of these trials are in {folder}", file=sys.stderr)
    return tried


def render(out: Path, docs: Path | None, names: Sequence[str]) -> bool:
    """Table and ``faults.md`` from the files in ``out``; whether the targets of the rows ``names`` are met.

    Raises:
        ValueError: they are not there.
    """
    from benchmarks import pages
    from benchmarks.faults import measure, page
    from benchmarks.results import atomic_write_text

    results = measure.read_csv(out / "faults.csv")
    about = pages.known_machine(out)
    text = page.markdown(results, about)
    atomic_write_text(out / "faults.md", "# Faults\n\n" + text)
    if docs:
        page.BLOCK.update(docs, text)
    print(page.table_text(results))
    return all(result.met != "no" for result in results if result.name in names)


@command("benchmarks.faults")
def main(argv: Sequence[str] | None = None) -> int:
    """Try and report; returns the exit code: 0 all met, 1 some not met, 2 bad arguments, 130 interrupted."""
    started = time.perf_counter()
    arguments = parser().parse_args(argv)
    share, names = share_of(arguments), chosen(arguments)
    prepare_folder(arguments.out)
    warnings.simplefilter("ignore", DeprecationWarning)  # of libraries; their users cannot act on them
    if not arguments.render:
        from rise_agents.workers import limit_threads

        limit_threads()
        tried = try_all(names, share, arguments)
    if arguments.only is not None:
        from benchmarks.faults.page import table_text

        print(table_text(tried))
        return 0 if all(result.met != "no" for result in tried) else 1
    met = render(arguments.out, arguments.docs, names)
    print(f"Finished after {time.perf_counter() - started:.0f} s: {arguments.out}")
    return 0 if met else 1


if __name__ == "__main__":
    raise SystemExit(main())

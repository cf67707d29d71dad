"""Turn a finished run into what is committed of it: ``python -m benchmarks.publish RUN_DIR``."""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from benchmarks import report, results
from benchmarks.results_page import PAGE, check_page, renew_page, stale
from rise_agents.cli import Parser, command, prepare_folder
from rise_agents.files import sole_user

DEFAULT_OUT = Path("docs") / "results"
_OF_THE_MACHINE = (
    "platform",
    "failed",
    "trajectories",
)  # entries of run.json that say nothing of the results
_FOLDERS = re.compile(r"(?<![\w.:~-])/(?:[^\s/'\"]+/)+")  # those of an absolute path, not its last name
_EXAMPLES = f"""\
examples:
  python -m benchmarks.publish runs/paper                  into {DEFAULT_OUT.as_posix()}, where written words stay
  python -m benchmarks.publish runs/paper --out results    into another folder
  python -m benchmarks.publish runs/paper --partial        what there is of a run that is not finished
  python -m benchmarks.publish docs/results --check        whether what is published follows from its episodes
"""


def publish(run: Path, out: Path, partial: bool = False) -> None:
    """Write the results of the run folder ``run`` to ``out``: episodes, record, tables, figures and page.

    All tables, figures and blocks of the page are computed from the episodes as they are stored there.

    Args:
        run: folder of a run.
        out: folder to write to.
        partial: also what there is of a run of which jobs are left or failed; its page then says so.

    Raises:
        ValueError: no finished run, no episodes, or a page in ``out`` that lacks a block; nothing is written then.
        OSError: a file cannot be written.
    """
    check_page(out)
    record = trimmed(run, partial)
    if not (run / report.EPISODES).exists():
        raise ValueError(f"{str(run)!r} has no episodes yet: there is nothing to publish")
    rows = results.rounded(results.read_rows(run / report.EPISODES))
    prepare_folder(out)
    for stem in (*(Path(name).stem for name in report.FIGURES), "others-"):  # this run may not have them all
        for old in out.glob(f"{stem}*.png"):
            old.unlink()
    results.write_compact(out / report.EPISODES, rows)
    results.atomic_write_text(out / report.RECORD, json.dumps(record, indent=1, ensure_ascii=False) + "\n")
    report.publish(rows, report.read_run(out), out)
    renew_page(out)


def trimmed(run: Path, partial: bool = False) -> dict[str, Any]:
    """``run.json`` of a run folder without what is of the machine alone, and with how each training ended.

    ``trainings`` has, per environment and checkpoint, seconds, device and the last point of the training curve.

    Args:
        run: folder of a run.
        partial: also of a run that is not finished; ``unfinished`` says how many jobs it lacks.

    Raises:
        ValueError: there is no such record, or jobs of the run are left or failed.
    """
    path = run / report.RECORD
    told = report.read_run(run)
    if not told:
        raise ValueError(f"{path} is missing: {str(run)!r} is not the folder of a finished run")
    record = json.loads(path.read_bytes())
    failed, left = record.get("failed") or [], told["unfinished"]
    if (failed or left) and not partial:
        what = (
            f"some jobs of {str(run)!r} failed"
            if failed
            else f"{str(run)!r} is not finished, jobs left: {left:,}"
        )
        raise ValueError(
            f"{what}: give the run's command again first, or publish what there is with --partial"
        )
    kept = {key: value for key, value in record.items() if key not in _OF_THE_MACHINE}
    try:
        kept["unfinished"] = max(left, len(failed))  # older records do not count what failed
        return _without_folders({**kept, "trainings": _trainings(run, record.get("agents", {}))})
    except (AttributeError, TypeError) as error:
        raise ValueError(f"{path} is not the record of a run ({error})") from None


def _trainings(run: Path, agents: dict[str, dict[str, str]]) -> dict[str, dict[str, Any]]:
    """How the trainings ended, from the records beside the checkpoints that ``run.json`` names."""
    ends: dict[str, dict[str, Any]] = {}
    for env, checkpoints in agents.items():
        for name in dict.fromkeys(checkpoints.values()):  # rows may share a training
            path = run / f"{name.removesuffix('.rise')}.json"
            if path.exists():
                ends.setdefault(env, {})[path.stem] = _end(path)
    return ends


def _end(path: Path) -> dict[str, Any]:
    """Seconds, device and the last point of the curve of one training."""
    try:
        training = json.loads(path.read_bytes())
        end = {"seconds": training["seconds"], "device": training["device"]}
        return end | {"end": training["curve"][-1] if training["curve"] else {}}
    except (OSError, ValueError, LookupError, TypeError) as error:
        raise ValueError(f"{path} is not the record of a training ({error})") from None


def _without_folders(value: Any) -> Any:
    """``value`` with absolute paths cut to their last names, in all texts that it holds."""
    if isinstance(value, dict):
        return {key: _without_folders(inner) for key, inner in value.items()}
    if isinstance(value, list):
        return [_without_folders(inner) for inner in value]
    return _FOLDERS.sub("", value) if isinstance(value, str) else value


def parser() -> Parser:
    """The command line."""
    p = Parser(
        plugins=True,
        prog="python -m benchmarks.publish",
        description="Turn a finished run into what is committed of it: episodes in few bytes, tables, figures, page.",
        epilog=_EXAMPLES,
    )
    p.add_argument("run", type=Path, metavar="RUN_DIR", help="folder of a finished run")
    p.add_argument(
        "--out",
        type=Path,
        default=DEFAULT_OUT,
        metavar="DIR",
        help=f"folder to write to (default: {DEFAULT_OUT.as_posix()})",
    )
    p.add_argument(
        "--partial",
        action="store_true",
        help="publish what there is of a run of which jobs are left or failed; the page says so",
    )
    p.add_argument(
        "--check",
        action="store_true",
        help="write nothing: say whether tables and blocks of the page in RUN_DIR, a published folder, follow from "
        "its episodes; figures, and words that people wrote, are not compared",
    )
    return p


@command("benchmarks.publish")
def main(argv: Sequence[str] | None = None) -> int:
    """Publish or check; returns the exit code: 0 done, 1 not as the episodes say or not written, 2 bad input."""
    arguments = parser().parse_args(argv)
    run, out = arguments.run, arguments.out
    if arguments.check:
        return _check(run)
    if not run.is_dir():
        raise ValueError(f"{str(run)!r} is not a folder")
    if run.resolve() == out.resolve():
        raise ValueError(f"--out is the run folder itself, {str(run)!r}: name another folder")
    with sole_user(run):
        publish(run, out, arguments.partial)
    print(f"Written: {out / PAGE} and what it is made from")
    return 0


def _check(folder: Path) -> int:
    found = stale(folder)
    for what in found:
        print(f"benchmarks.publish: {folder}: {what} is not what the episodes say", file=sys.stderr)
    if not found:
        print(f"{folder}: tables, and blocks of the page, are what the episodes say")
    return 1 if found else 0


if __name__ == "__main__":
    raise SystemExit(main())

"""How much of the code the fast tests reach: lines and branches, of every process that they start."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from benchmarks.faults.measure import Effort, Fault, Findings, Tell, Unavailable

ROOT = Path(__file__).parents[2]
PACKAGES = ("rise_envs", "rise_agents", "benchmarks")
# Tests of compiled functions, once more without the compiler: in Python their lines can be seen, and there is no other
# honest way to count them.
COMPILED = ("tests/test_vehicle_backends.py", "tests/test_panda_kinematics.py")
_PATIENCE = 3_600.0  # s


def measured(
    tests: Sequence[str], place: Path, workers: int, compiler: bool = True, root: Path = ROOT
) -> int:
    """Run tests under coverage; returns pytest's exit code."""
    environment = {**os.environ, "COVERAGE_FILE": str(place / ".coverage")}
    command = [sys.executable, "-m", "coverage", "run", f"--rcfile={root / 'pyproject.toml'}", "-m", "pytest"]
    if not compiler:
        environment["NUMBA_DISABLE_JIT"] = "1"
        tests = ["-W", "ignore::RuntimeWarning", *tests]  # whole numbers wrap around, as they are meant to
    options = ["-q", "-p", "no:cacheprovider", *(["-n", str(workers)] if workers > 1 else [])]
    with (place / "log").open("ab") as log:
        done = subprocess.run(  # noqa: S603
            [*command, *options, *tests], cwd=root, env=environment, stdout=log, stderr=log, timeout=_PATIENCE
        )
    return done.returncode


class Report(NamedTuple):
    """What was reached, in per cent.

    Attributes:
        all: lines and branches together, as coverage counts them.
        branches: branches alone.
        files: of each file, lines and branches, the least covered first.
    """

    all: float
    branches: float
    files: list[tuple[float, str]]


def report(place: Path, root: Path = ROOT) -> Report:
    """The coverage that the runs in ``place`` have left."""
    environment = {**os.environ, "COVERAGE_FILE": str(place / ".coverage")}
    target = place / "coverage.json"
    for words in (["combine", "-q"], ["json", "-q", "-o", str(target)]):
        command = [
            sys.executable,
            "-m",
            "coverage",
            words[0],
            f"--rcfile={root / 'pyproject.toml'}",
            *words[1:],
        ]
        done = subprocess.run(command, cwd=root, env=environment, capture_output=True)  # noqa: S603
        if done.returncode:  # nothing of ours was imported
            return Report(0.0, 0.0, [])
    found = json.loads(target.read_text())
    files = sorted((each["summary"]["percent_covered"], name) for name, each in found["files"].items())
    totals = found["totals"]
    branches = 100 * totals["covered_branches"] / max(1, totals["num_branches"])
    return Report(float(totals["percent_covered"]), branches, files)


def run(
    effort: Effort, tell: Tell, tests: Sequence[str] = (), compiled: Sequence[str] = COMPILED
) -> Findings:
    """All fast tests, then those of compiled functions without the compiler; with a share, a share of the files."""
    try:
        import coverage  # noqa: F401
    except ImportError:
        raise Unavailable("the package coverage is not installed: pip install 'rise-suite[dev]'") from None
    if not (ROOT / "tests").is_dir():
        raise Unavailable("the tests are not installed with the packages: run it in the repository")
    findings = Findings()
    every = sorted(str(path.relative_to(ROOT)) for path in (ROOT / "tests").glob("test_*.py"))
    files = list(tests) or every[: effort.count(len(every))]
    with effort.scratch("tests") as place:
        code = measured(files, place, effort.workers)
        tell(0.6, {})
        if not tests and effort.share == 1:
            code = measured(compiled, place, effort.workers, compiler=False) or code
        reached = report(place)
        findings.figure = reached.all
        if code:
            tail = (place / "log").read_text(errors="replace").strip().splitlines()[-1:]
            findings.add(0, [Fault("failed test run", " ".join(tail))], 0)
            effort.keep(place / "log", "log")
    findings.trials = len(files)
    least = ", ".join(f"{Path(name).as_posix()} {share:.0f} %" for share, name in reached.files[:5])
    findings.note = f"lines and branches; branches alone {reached.branches:.1f} %; least covered: {least}"
    return findings

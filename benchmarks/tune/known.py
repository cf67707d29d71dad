"""Rates that an earlier search measured, taken from its table: ``python -m benchmarks.tune --known trials.csv``.

A line is taken for a trial only if it names the very same one: the name of its result is a digest of the version, the
agent, all its settings, the demonstrations, the training seed and what it was judged on.
"""

from __future__ import annotations

import csv
import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from benchmarks import results
from benchmarks.tune.ranking import Rates
from benchmarks.tune.report import COLUMNS
from benchmarks.tune.studies import Study


def read(path: Path) -> dict[str, dict[str, str]]:
    """The lines of a table of trials, by the name of their result.

    Raises:
        ValueError: it cannot be read, or is no such table; the message names file and line.
    """
    try:
        with path.open(newline="", encoding="utf-8") as file:
            reader = csv.DictReader(file)
            if tuple(reader.fieldnames or ()) != COLUMNS:
                raise ValueError(f"{path} is no table of trials: its columns must be {', '.join(COLUMNS)}")
            lines = list(reader)
    except OSError as error:
        raise ValueError(f"cannot read {path}: {error.strerror}") from None
    except (UnicodeDecodeError, csv.Error) as error:
        raise ValueError(f"{path} is no table of trials: {error}") from None
    for number, line in enumerate(lines, start=2):
        try:
            fits = all(0 <= float(line[name]) <= 1 for name in Rates._fields)
            fits = fits and float(line["training_seconds"]) >= 0
            json.loads(line["settings"])
        except (TypeError, ValueError, RecursionError):
            fits = False
        if not fits:
            raise ValueError(f"{path}, line {number} is not what a search wrote")
    return {line["result"]: line for line in lines}


def recall(studies: Iterable[Study], seeds: int, known: Mapping[str, Mapping[str, str]], out: Path) -> int:
    """Write the results of all trials that are known and not measured here; returns how many.

    Raises:
        OSError: a file cannot be written.
    """
    taken = 0
    for study in studies:
        for trial in range(len(study.trials)):
            for seed in range(seeds):
                path = study.result(trial, seed, out)
                line = known.get(path.name)
                if line is not None and not path.exists():
                    results.atomic_write_text(
                        path, json.dumps(_result(study, trial, seed, line), indent=2) + "\n"
                    )
                    taken += 1
    return taken


def _result(study: Study, trial: int, seed: int, line: Mapping[str, str]) -> dict[str, Any]:
    """As :func:`benchmarks.tune.studies.judge` writes it."""
    return {
        **{"agent": study.agent, "env": study.env, "seed": seed, "settings": study.trials[trial]},
        **{"judged_on": study.eval_env, "scenarios": study.scenarios},
        "training_seconds": float(line["training_seconds"]),
        "rates": {name: float(line[name]) for name in Rates._fields},
    }

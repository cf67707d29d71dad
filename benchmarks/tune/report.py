"""What a search found: the table of all trials, and the chosen settings with how they were chosen."""

from __future__ import annotations

import csv
import io
import json
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benchmarks import results
from benchmarks.tune import settings_file
from benchmarks.tune.ranking import KEPT, MODEL, Rates
from benchmarks.tune.studies import Study, read_result
from rise_agents import agent_class
from rise_agents.agent import config_to_dict, make_config

COLUMNS = (
    *("agent", "env", "trial", "train_seed", "settings", "clean_safety", "clean_reach", "safety", "reach"),
    *("score", "training_seconds", "result"),
)


@dataclass(frozen=True)
class Found:
    """What came of a study.

    Attributes:
        study: what was searched.
        chosen: number of the trial.
        rates: its means over training seeds.
        defaults: those of trial 0 with training seed 0, if it was measured.
        finalists: trials of the second round.
        seeds: training seeds of the second round.
        measured: trials of the first round.
    """

    study: Study
    chosen: int
    rates: Rates
    defaults: Rates | None
    finalists: tuple[int, ...]
    seeds: int
    measured: int


def chosen_settings(found: Found) -> dict[str, Any]:
    """The settings that differ from the agent's defaults; from how much it learned is a condition and no choice.

    Of a variant all that were searched: what is left out would be as its agent's.
    """
    study = found.study
    defaults = config_to_dict(make_config(agent_class(study.agent), study.env, {}))
    searched = {name for trial in study.trials[1:] for name in trial} if study.row != study.agent else set()
    settings = study.settings(found.chosen)
    return {
        name: value
        for name, value in settings.items()
        if (name in searched or value != defaults[name]) and name != "transitions"
    }


def comments(found: Found, command: Sequence[str], clean_loss: float) -> list[str]:
    """How settings were chosen, in lines."""
    study, count = found.study, len(found.study.trials)
    seeds = ", ".join(map(str, range(found.seeds)))
    lines = [
        f"{study.name}: trial {found.chosen} of {count} (0: the defaults), searched by",
        f"  {shlex.join(command)}",
        f"{count} settings with training seed 0, the best 1 in {KEPT} with seeds {seeds}; {_source(study)}.",
        f"{study.scenarios} validation scenarios of {study.eval_env}, noise {MODEL}: the best score at level 1",
        f"among those not shown to lose more than {100 * clean_loss:g} points to the best of all agents at level 0.",
        f"Mean over seeds {seeds}: {_told(found.rates)}.",
    ]
    if found.defaults is not None:
        lines.append(f"The defaults, seed 0: {_told(found.defaults)}.")
    if found.measured < count:
        lines.append(f"{count - found.measured} of the {count} settings could not be trained or judged.")
    return lines


def _told(rates: Rates) -> str:
    percent = [f"{100 * rate:.2f} %" for rate in rates]
    return (
        f"level 0: Safety {percent[0]}, Reach {percent[1]}; level 1: Safety {percent[2]}, Reach {percent[3]}; "
        f"score {100 * rates.score:.2f}"
    )


def _source(study: Study) -> str:
    if study.data is None:
        return "learned by trial"
    cut = study.settings(0).get("transitions", 0)
    return f"learned from {f'{cut:,} transitions, others for each seed' if cut else 'all demonstrations'}"


def tables(found: Sequence[Found], command: Sequence[str], clean_loss: float) -> dict[str, str]:
    """The text of each study's settings table, by its name."""
    return {
        each.study.name: settings_file.table(
            each.study.name, chosen_settings(each), comments(each, command, clean_loss)
        )
        for each in found
    }


def write_settings(path: Path, new: Mapping[str, str]) -> None:
    """Put tables into a settings file, which keeps its others.

    Raises:
        ValueError: the file cannot be read, or not be kept.
    """
    settings_file.read(path)
    try:
        text = settings_file.merged(path.read_text() if path.exists() else "", new)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None
    results.atomic_write_text(path, text)


def write_trials(path: Path, studies: Sequence[Study], seeds: int, out: Path) -> None:
    """A CSV line for each trial and training seed that was measured."""
    text = io.StringIO()
    writer = csv.DictWriter(text, COLUMNS, lineterminator="\n")
    writer.writeheader()
    for study in studies:
        for trial in range(len(study.trials)):
            for seed in range(seeds):
                rates = study.rates(trial, seed, out)
                if rates is None:
                    continue
                line = {"agent": study.row, "env": study.env, "trial": trial, "train_seed": seed}
                line |= {"settings": json.dumps(study.trials[trial], sort_keys=True)}
                line |= {name: f"{rate:.6g}" for name, rate in rates._asdict().items()}
                result = study.result(trial, seed, out)
                line |= {"training_seconds": read_result(result)["training_seconds"], "result": result.name}
                writer.writerow({**line, "score": f"{rates.score:.6g}"})
    results.atomic_write_text(path, text.getvalue())

"""A search from start to end: demonstrations, two rounds of trials, tables."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from benchmarks.display import Display
from benchmarks.executors import Failure, MakeCrew, run_jobs
from benchmarks.jobs import Job, demonstrations_folder, recording_jobs, tidy, wanted, with_events
from benchmarks.labels import count, name_rows
from benchmarks.protocol import Plan, imitates
from benchmarks.tune import known, report
from benchmarks.tune.ranking import Rates, best_clean, finalists, mean, ranked
from benchmarks.tune.studies import Study, condition, drawn_trials, judge
from rise_agents import demonstrations
from rise_agents.files import sweep
from rise_agents.pool import Pool
from rise_envs import STAND_INS

if TYPE_CHECKING:
    from benchmarks.tune.figure import Marks


@dataclass(frozen=True)
class Search:
    """What is searched, complete: the same search finds the same settings.

    Attributes:
        plan: agents, environments, fixed settings; ``demos`` episodes of its ``expert`` are recorded, ``episodes``
            validation scenarios judge, ``seeds`` training seeds decide.
        trials: settings in the first round of each study.
        transitions: that each training seed learns from; 0: from all.
        clean_loss: what the chosen settings may lose on true readings, in [0, 1].
        eval_env: a stand-in that agents of what it models are judged in; empty: none.
        sets: folders of recorded demonstrations.
        tried: of variants, values of settings to try beside what is tried of their agents.
    """

    plan: Plan
    trials: int
    transitions: int
    clean_loss: float
    eval_env: str = ""
    sets: tuple[Path, ...] = ()
    tried: Mapping[str, Mapping[str, list[Any]]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for name, value, low in (("trials", self.trials, 1), ("transitions", self.transitions, 0)):
            if value < low:
                raise ValueError(f"{name} must be at least {low}, got {value}")
        for name, variant in self.plan.variants.items():
            if variant.expert:
                raise ValueError(
                    f"{name} has demonstrations of its own: search settings of {variant.agent} instead"
                )
        if not 0 <= self.clean_loss <= 1:
            raise ValueError(f"the clean loss must lie from 0 to 100 points, got {100 * self.clean_loss:g}")
        if self.eval_env and STAND_INS.get(self.eval_env) not in self.plan.envs:
            known = ", ".join(f"{name} for {env}" for name, env in STAND_INS.items())
            raise ValueError(f"{self.eval_env!r} stands in for no environment of this search; known: {known}")

    def study(self, row: str, env: str, source: tuple[Path, str] | None = None) -> Study:
        """A row in an environment, learning from the set in a folder with a digest.

        Raises:
            ValueError: its agent declares no space, or its settings make no sense.
        """
        agent = self.plan.agent_of(row)
        own = {**condition(agent, self.transitions), **self.plan.config(row, env)}
        try:
            trials = drawn_trials(agent, env, self.trials, own, row, self.tried.get(row, {}))
        except ValueError as error:
            raise ValueError(f"settings of {row}: {error}") from None
        judged = self.eval_env if STAND_INS.get(self.eval_env) == env else env
        data, digest = source if source is not None and imitates(agent) else (None, "")
        return Study(row, agent, env, judged, self.plan.episodes, trials, data, digest)

    def pairs(self) -> list[tuple[str, str]]:
        """(row, environment) of each study."""
        return [(row, env) for env in self.plan.envs for row in self.plan.asked(env)]


@dataclass(frozen=True)
class How:
    """How a search is carried out; none of this changes what it finds.

    Attributes:
        workers: jobs at once, at most; None: one per core of what works.
        every: seconds between two checkpoints of a training.
        command: how it was started, for the comments of settings files.
        write: a settings file that the chosen settings go into, beside the one in the folder.
        tensorboard: folder for event files of the trainings; None: none are written.
        known: lines of an earlier search's table, by the name of their result.
        pool: makes what works, see :func:`run_jobs`.
    """

    workers: int | None
    every: float
    command: tuple[str, ...]
    write: Path | None = None
    tensorboard: Path | None = None
    known: Mapping[str, Mapping[str, str]] = field(default_factory=dict)
    pool: MakeCrew = Pool


def given_sets(search: Search) -> dict[str, tuple[Path, str]]:
    """Folder and digest of the sets that are there, by environment.

    Raises:
        ValueError: one is damaged, too small, of an environment that is not searched, or the second of its kind.
    """
    found: dict[str, tuple[Path, str]] = {}
    for folder in search.sets:
        loaded = _checked_set(folder, search)
        if loaded.env_id not in search.plan.envs or loaded.env_id in found:
            why = "a second set" if loaded.env_id in found else "a set of an environment that is not searched"
            raise ValueError(f"{folder} holds {why}: {loaded.env_id}")
        found[loaded.env_id] = folder, loaded.digest()
    return found


def _checked_set(folder: Path, search: Search) -> demonstrations.Demonstrations:
    loaded = demonstrations.load(folder)
    needed, there = search.transitions * search.plan.seeds, len(loaded.actions)
    if there < needed:
        raise ValueError(
            f"{folder} holds {there:,} transitions, but {search.plan.seeds} training seeds need {needed:,}: "
            "record more episodes, or use fewer transitions or seeds"
        )
    return loaded


def execute(search: Search, sets: Mapping[str, tuple[Path, str]], out: Path, how: How) -> list[Failure]:
    """Do what the search asks for and is not done yet, in the folder ``out``; returns what failed.

    Raises:
        ValueError: recorded demonstrations do not suffice, or a file is not what it should be.
    """
    name_rows(search.plan.labels())
    for folder in [out, *(path for path in out.rglob("*") if path.is_dir())]:
        sweep(folder)
    tidy(out)
    sources, failures = _recorded(search, sets, out, how)
    studies = [
        search.study(row, env, sources.get(env))
        for row, env in search.pairs()
        if env in sources or not search.plan.learns_from_expert(row)
    ]
    if how.known:
        taken = known.recall(studies, search.plan.seeds, how.known, out)
        print(f"taken from an earlier search: {count([taken], 'result')}", file=sys.stderr)
    first = {study: range(len(study.trials)) for study in studies}
    failures += _run(_jobs(first, [0], out, how.every), how, "first round: ")
    rates = {study: _measured(study, first[study], [0], out) for study in studies}
    best = _best(rates)
    second = {
        study: finalists(rates[study], search.clean_loss, best[study.env], study.scenarios, len(study.trials))
        for study in studies
        if rates[study]
    }
    seeds = range(search.plan.seeds)
    failures += _run(_jobs(second, seeds[1:], out, how.every), how, "second round: ")

    found = []
    finals = {study: _measured(study, trials, seeds, out) for study, trials in second.items()}
    best = _best(finals)
    for study, final in finals.items():
        if final:
            episodes = study.scenarios * len(seeds)
            chosen = ranked(final, search.clean_loss, best[study.env], episodes)[0]
            trials = tuple(second[study])
            numbers = (chosen, final[chosen], rates[study].get(0), trials, len(seeds), len(rates[study]))
            found.append(report.Found(study, *numbers))
    report.write_trials(out / "trials.csv", studies, len(seeds), out)
    if best:
        from benchmarks.plots import save_png  # who only asks for help need not wait for what draws
        from benchmarks.tune.figure import figure

        winners = {(each.study.row, each.study.env): each.chosen for each in found}
        save_png(figure(_marks(studies, seeds, out), winners, search.clean_loss, best), out / "search.png")
    tables = report.tables(found, how.command, search.clean_loss)
    for path in [out / "tuned.toml", *([how.write] if how.write else [])]:
        report.write_settings(path, tables)
    print("\n".join(tables.values()))
    return failures


def _marks(studies: Sequence[Study], seeds: Sequence[int], out: Path) -> Marks:
    """All that was measured, for the figure."""
    marks: dict[tuple[str, str], dict[int, tuple[Rates, int]]] = {}
    for study in studies:
        for trial in range(len(study.trials)):
            measured = [rates for seed in seeds if (rates := study.rates(trial, seed, out))]
            if measured:
                marks.setdefault((study.row, study.env), {})[trial] = mean(measured), len(measured)
    return marks


def _best(rates: Mapping[Study, Mapping[int, Rates]]) -> dict[str, Rates]:
    """Of all agents of a round the best on true readings, by environment."""
    envs = {study.env for study, measured in rates.items() if measured}
    return {
        env: best_clean(r for s, own in rates.items() if s.env == env for r in own.values()) for env in envs
    }


def _recorded(
    search: Search, sets: Mapping[str, tuple[Path, str]], out: Path, how: How
) -> tuple[dict[str, tuple[Path, str]], list[Failure]]:
    """Folder and digest of every environment's demonstrations, after recording those that are not there."""
    jobs = [
        job
        for job in recording_jobs(search.plan, out)
        if not any(demonstrations_folder(search.plan, env, out) in job.output.parents for env in sets)
    ]
    failures = _run(jobs, how) if jobs else []
    sources = dict(sets)
    for env in search.plan.envs:
        folder = demonstrations_folder(search.plan, env, out)
        if env not in sources and (folder / demonstrations.DATA).exists():
            sources[env] = folder, _checked_set(folder, search).digest()
    return sources, failures


def _jobs(trials: Mapping[Study, Iterable[int]], seeds: Iterable[int], out: Path, every: float) -> list[Job]:
    """Train and judge; settings that two trials share are trained once, and none whose rates are there already."""
    jobs = [
        job
        for seed in seeds
        for study, numbers in trials.items()
        for trial in numbers
        for job in study.jobs(trial, seed, out, every)
    ]
    unique = list({job.output: job for job in jobs}.values())
    return wanted(unique, [job for job in unique if job.run is judge])


def _run(jobs: Sequence[Job], how: How, title: str = "") -> list[Failure]:
    with Display() as display:
        display.plan(jobs, title)
        turn = with_events(jobs, how.tensorboard)
        return run_jobs(turn, how.workers, display.watch, display.say, pool=how.pool)


def _measured(study: Study, trials: Iterable[int], seeds: Iterable[int], out: Path) -> dict[int, Rates]:
    """Mean rates of the trials that were measured with all the seeds."""
    every = {trial: [study.rates(trial, seed, out) for seed in seeds] for trial in trials}
    return {trial: mean([r for r in rates if r]) for trial, rates in every.items() if all(rates)}

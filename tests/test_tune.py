"""The search: its rule on hand-made rates, its draws, its files, and a small one from end to end."""

from __future__ import annotations

import csv
import json
import math
import shutil
import tomllib
from pathlib import Path

import imageio.v3 as imageio
import numpy as np
import pytest
from scipy import stats

from benchmarks import configs
from benchmarks.configs import SHIPPED
from benchmarks.executors import Failure
from benchmarks.plots import colour
from benchmarks.protocol import make_plan
from benchmarks.tune import report, search, settings_file
from benchmarks.tune.__main__ import main, parser, search_of
from benchmarks.tune.figure import figure
from benchmarks.tune.ranking import Rates, best_clean, finalists, mean, ranked, shown_loss
from benchmarks.tune.studies import drawn_trials
from rise_agents import AGENTS, agent_class, load_agent, make_agent
from rise_agents.agent import make_config
from rise_agents.pcbc import PCBC
from rise_agents.readings import FRAMES
from rise_agents.rollout import rollout
from rise_agents.search import EVERYWHERE, Choice, LogRange, draw, space_of
from rise_agents.seeds import SPLITS
from rise_envs import ENVS, STAND_INS

VEHICLE, PANDA, MODEL = "RISE-GroundVehicle-v0", "RISE-SafePanda-v0", "RISE-SafePandaKinematic-v0"


# --- the figure ------------------------------------------------------------------------------------------------


def test_the_figure_has_a_mark_per_setting_and_a_ring_around_the_chosen_one():
    good, noisy, poor = Rates(0.99, 0.97, 0.8, 0.7), Rates(0.98, 0.98, 0.9, 0.9), Rates(0.5, 0.5, 0.5, 0.5)
    marks = {("rise", VEHICLE): {0: (good, 1), 4: (noisy, 3), 5: (poor, 1)}, ("pcbc", PANDA): {1: (good, 1)}}
    best = {VEHICLE: good, PANDA: good}
    drawn = figure(marks, {("rise", VEHICLE): 4}, 0.01, best)
    vehicle, panda = drawn.axes
    places = [line.get_xydata()[0].tolist() for line in vehicle.lines if line.get_marker() == "o"]
    assert places == [[98.0, 75.0], [98.0, 90.0], [98.0, 90.0]]  # the last one is the ring
    assert [line.get_markerfacecolor() for line in vehicle.lines[:2]] == ["white", colour(["rise"], "rise")]
    assert vehicle.lines[-1].get_xdata()[0] == pytest.approx(97.0)
    assert [text.get_text() for text in vehicle.texts] == ["← 1 further left"] and not panda.texts
    assert [line.get_marker() for line in panda.lines] == ["o", "None"]
    with pytest.raises(ValueError, match="no settings"):
        figure({("rise", VEHICLE): {}}, {}, 0.01, best)


# --- the rule --------------------------------------------------------------------------------------------------

MANY = 10**20  # episodes, of which rates are exact


def test_a_loss_counts_as_far_as_its_episodes_show_it():
    """A loss of exactly a point is called more than one in one of twenty cases."""
    rng = np.random.default_rng(0)
    draws = rng.binomial(1_000, [[0.96], [0.97]], (2, 20_000)) / 1_000
    called = [shown_loss(own, best, 1_000) > 0.01 for own, best in draws.T]
    assert np.mean(called) == pytest.approx(0.05, abs=0.006)
    assert shown_loss(0.98, 0.99, MANY) == pytest.approx(0.01)
    assert shown_loss(0.99, 0.98, 1000) < -0.01
    assert shown_loss(1.0, 1.0, 3) == 0.0
    best = Rates(1.0, 0.99, 0.5, 0.5)
    rates = {
        0: Rates(0.995, 0.985, 0.6, 0.6),
        1: Rates(0.995, 0.975, 0.9, 0.9),
    }  # loses 0.5, 1.5 points of Reach
    assert ranked(rates, 0.01, best, 1_000) == [1, 0]
    assert ranked(rates, 0.01, best, 10_000) == [0, 1]
    assert finalists(rates, 0.01, best, 1_000, 4) == [1] and finalists(rates, 0.01, best, 10_000, 4) == [0]


def test_the_best_score_wins_among_those_that_see_as_well_as_the_best():
    rates = {
        0: Rates(0.99, 0.98, 0.80, 0.78),  # the best on true readings
        1: Rates(0.98, 0.97, 0.90, 0.70),  # loses one point in both, which is allowed: 0.80
        2: Rates(0.99, 0.96, 0.95, 0.95),  # loses two points of Reach
        3: Rates(0.97, 0.98, 0.99, 0.99),  # loses two points of Safety
    }
    assert ranked(rates, 0.01, rates[0], MANY) == [1, 0, 3, 2]
    assert ranked(rates, 0.02, rates[0], MANY) == [3, 2, 1, 0]
    assert ranked(rates, 0.0, rates[0], MANY) == [0, 1, 3, 2]  # who loses less comes first


def test_what_another_agent_can_do_when_it_sees_well_none_may_give_up():
    rates = {0: Rates(0.99, 0.98, 0.80, 0.78), 1: Rates(0.98, 0.97, 0.90, 0.90)}
    assert ranked(rates, 0.01, rates[0], MANY) == [1, 0]
    assert ranked(rates, 0.01, Rates(0.995, 0.98, 0.1, 0.1), MANY) == [
        0,
        1,
    ]  # 1 is 1.5 points less safe than the other agent
    assert ranked(rates, 0.01, Rates(1.0, 1.0, 0.1, 0.1), MANY) == [0, 1]  # neither is eligible: 0 loses less


def test_the_reference_is_the_best_mean_on_true_readings():
    rates = {0: Rates(1.0, 0.5, 0.9, 0.9), 1: Rates(0.9, 0.9, 0.1, 0.1)}
    assert best_clean(rates.values()) == rates[1]  # 0.9 beats 0.75
    assert ranked(rates, 0.01, rates[1], MANY) == [1, 0]  # trial 0 loses 40 points of Reach
    equal = [Rates(0.9, 0.9, 0.1, 0.1), Rates(0.9, 0.9, 0.2, 0.1)]
    assert best_clean(equal) == equal[1]


def test_of_equal_trials_the_lower_number_is_better():
    same = Rates(0.9, 0.9, 0.8, 0.8)
    assert ranked({5: same, 2: same, 0: same}, 0.01, same, MANY) == [0, 2, 5]
    assert ranked({}, 0.01, same, MANY) == []


def test_a_quarter_goes_on_even_if_fewer_are_eligible():
    rates = {n: Rates(0.9 if n else 1.0, 0.9, 0.5 + n / 100, 0.5) for n in range(8)}
    assert finalists(rates, 0.01, rates[0], MANY, 8) == [0, 7]
    assert len(finalists(rates, 0.01, rates[0], MANY, 5)) == 2
    assert finalists({3: rates[3]}, 0.01, rates[0], MANY, 8) == [3]
    assert finalists({}, 0.01, rates[0], MANY, 8) == []


def test_means_and_scores():
    both = mean([Rates(1.0, 0.8, 0.6, 0.4), Rates(0.9, 0.7, 0.7, 0.1)])
    assert both == pytest.approx((0.95, 0.75, 0.65, 0.25))
    assert both.score == pytest.approx(0.45) and both.clean == pytest.approx(0.85)


# --- what is drawn ---------------------------------------------------------------------------------------------


def test_a_log_range_is_uniform_in_its_logarithm():
    rng, domain = np.random.default_rng(0), LogRange(1e-3, 1.0)
    drawn = np.array([domain.draw(rng) for _ in range(2_000)])
    assert drawn.min() >= 1e-3 and drawn.max() <= 1.0
    assert stats.kstest((np.log10(drawn) + 3) / 3, "uniform").pvalue > 0.01
    assert all(float(f"{value:.3g}") == value for value in drawn)


def test_a_choice_draws_each_value_equally_often():
    rng = np.random.default_rng(0)
    drawn = [Choice((1, 2, 4)).draw(rng) for _ in range(3_000)]
    assert stats.chisquare([drawn.count(value) for value in (1, 2, 4)]).pvalue > 0.01


@pytest.mark.parametrize(("low", "high"), [(0, 1), (2, 1), (1, math.inf), (math.nan, 1)])
def test_ranges_that_make_no_sense_are_refused(low, high):
    with pytest.raises(ValueError, match="0 < low < high"):
        LogRange(low, high)


@pytest.mark.parametrize("env", ENVS)
@pytest.mark.parametrize("name", [name for name in AGENTS if hasattr(agent_class(name), "SEARCH")])
def test_every_declared_value_is_one_that_the_agent_takes(name, env):
    kind = agent_class(name)
    for field, domain in space_of(kind, env).items():
        for value in domain.values if isinstance(domain, Choice) else (domain.low, domain.high):
            make_config(kind, env, {field: value})
    for seed in range(50):
        settings = draw(space_of(kind, env), np.random.default_rng(seed))
        make_agent(name, env, json.loads(json.dumps(settings)))


def test_an_environment_s_own_space_goes_over_the_common_one_and_holds_for_its_stand_in(monkeypatch):
    declared = {EVERYWHERE: {"a": Choice((1,)), "b": Choice((2,))}, PANDA: {"b": Choice((3,))}}
    monkeypatch.setattr(PCBC, "SEARCH", declared)
    assert space_of(PCBC, VEHICLE) == {"a": Choice((1,)), "b": Choice((2,))}
    assert space_of(PCBC, PANDA) == space_of(PCBC, MODEL) == {"a": Choice((1,)), "b": Choice((3,))}


def test_an_agent_without_a_space_is_refused(monkeypatch, capsys):
    monkeypatch.delattr(PCBC, "SEARCH")
    assert main(["--agents", "pcbc"]) == 2
    assert "pcbc declares no settings to search: give PCBC a SEARCH" in capsys.readouterr().err


def test_a_longer_search_begins_with_the_trials_of_a_shorter_one():
    short, long = (drawn_trials("rise", VEHICLE, count, {"latent": 4}) for count in (3, 9))
    assert long[:3] == short and short[0] == {"latent": 4}
    assert len({json.dumps(trial) for trial in long}) == 9
    assert all(trial["latent"] == 4 for trial in long)
    assert drawn_trials("rise", PANDA, 3, {})[1] != drawn_trials("rise", VEHICLE, 3, {})[1]


def test_what_a_variant_wants_tried_is_and_its_other_settings_stay(tmp_path):
    """Trial 0 is the variant as it is; ``--set`` takes a setting out of the search."""
    mine = tmp_path / "mine.toml"
    mine.write_text(
        '[variants.noisy]\nagent = "pcbc"\nbatch_size = 64\ntrain_noise = 1.0\n'
        "search.train_noise = [0.25, 0.5]\nsearch.n_samples = [3]\n"
    )
    command = ["--agents", "noisy", "--envs", VEHICLE, "--config", str(mine), "--trials", "40"]
    study = search_of(parser().parse_args(command)).study("noisy", VEHICLE)
    common = {"transitions": 10_000, "batch_size": 64}
    assert (study.name, study.agent) == (f"noisy@{VEHICLE}", "pcbc")
    assert study.trials[0] == {**common, "train_noise": 1.0}
    assert {trial["train_noise"] for trial in study.trials[1:]} == {0.25, 0.5}
    assert all(trial["n_samples"] == 3 and common.items() <= trial.items() for trial in study.trials[1:])
    assert {trial["frame"] for trial in study.trials[1:]} == set(FRAMES)
    fixed = search_of(parser().parse_args([*command, "--set", "noisy.train_noise=0.75"]))
    assert {trial["train_noise"] for trial in fixed.study("noisy", VEHICLE).trials} == {0.75}


def test_the_found_settings_of_a_variant_are_all_there_and_hold_in_a_run(tmp_path, monkeypatch):
    """Also those that are as the agent's defaults: what is left out would be as was found for the agent."""
    run, _ = made_up(lambda settings, seed: Rates(1.0, 1.0, 0.5, 0.6 if len(settings) > 3 else 0.4))
    monkeypatch.setattr(search, "run_jobs", run)
    monkeypatch.setattr(search, "_recorded", lambda *a: ({VEHICLE: (tmp_path, "d")}, []))
    command = ["--agents", "pcbc-noisy", "--envs", VEHICLE, "--trials", "2", "--out", str(tmp_path)]
    assert main(command) == 0
    written = tmp_path / "tuned.toml"
    trial = drawn_trials(
        "pcbc", VEHICLE, 2, {}, "pcbc-noisy", configs.read([SHIPPED]).searches["pcbc-noisy"]
    )[1]
    assert tomllib.loads(written.read_text()) == {f"pcbc-noisy@{VEHICLE}": trial}
    with written.open("a") as file:
        file.write(f'["pcbc@{VEHICLE}"]\nframe = "world"\nbatch_size = 64\n')
    plan = make_plan("quick", {}, [written], agents=("pcbc-noisy",), envs=(VEHICLE,))
    assert plan.config("pcbc-noisy", VEHICLE) == {"batch_size": 64, **trial}


# --- settings files --------------------------------------------------------------------------------------------

SETTINGS = {
    "frame": "body",
    "hidden": [256, 256],
    "learning_rate": 3e-05,
    "updates": 20_000,
    "yes": True,
    "odd": 'a "β" \\ \n\t]',
}
OLD = """\
# a file of ours
# in two lines

# why
[first]
beta = 0.1  # here, too

["rise@X-v0"]
hidden = [
  1, 2,
]

# the last
["pcbc@X-v0"]
updates = 5
"""


def test_tables_are_toml():
    text = settings_file.table("rise@RISE-X-v0", SETTINGS, ["why", "how"])
    assert tomllib.loads(text) == {"rise@RISE-X-v0": SETTINGS}
    assert text.startswith('# why\n# how\n["rise@RISE-X-v0"]\n')
    assert tomllib.loads(settings_file.table("a", {}, [])) == {"a": {}}


def test_merging_replaces_its_own_tables_and_keeps_all_else():
    new = {name: settings_file.table(name, {"beta": 2.5}, ["new"]) for name in ("rise@X-v0", "more")}
    text = settings_file.merged(OLD, new)
    assert tomllib.loads(text) == {
        "first": {"beta": 0.1},
        "rise@X-v0": {"beta": 2.5},
        "pcbc@X-v0": {"updates": 5},
        "more": {"beta": 2.5},
    }
    assert list(tomllib.loads(text)) == ["first", "rise@X-v0", "pcbc@X-v0", "more"]
    for kept in (
        "# a file of ours\n# in two lines\n",
        "# why\n[first]\nbeta = 0.1  # here, too\n",
        "# the last\n",
    ):
        assert kept in text
    assert settings_file.merged(text, new) == text
    assert settings_file.merged("", {"more": new["more"]}) == new["more"]


@pytest.mark.parametrize(
    "text",
    [
        "[a]\nx = [\n[1],\n[2],\n]\n",
        "[new]\nx = 1\n[new.b]\ny = 2\n",
        's = """\n[a]\n"""\n',
    ],
)
def test_what_cannot_be_kept_is_refused(text):
    with pytest.raises(ValueError, match="cannot be told apart"):
        settings_file.merged(text, {"new": "[new]\n"})


def test_a_file_that_is_no_toml_is_refused_before_any_work(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for text, says in (("beta: 1", "as TOML"), ("beta = 1", "outside of a table")):
        Path("settings.toml").write_text(text)
        assert main(["--agents", "pcbc", "--write", "settings.toml"]) == 2
        error = capsys.readouterr().err
        assert says in error and "settings.toml" in error and error.count("\n") == 1
    for name in ("settings.toml/x", "x" * 300):
        assert main(["--agents", "pcbc", "--write", name]) == 2
        assert capsys.readouterr().err.count("\n") == 1
    assert {path.name for path in tmp_path.iterdir()} == {"settings.toml"}


# --- from end to end, with rates that are made up ---------------------------------------------------------------


def made_up(objective):
    """A stand-in of ``run_jobs`` that trains nobody: the rates of trial settings and seed are ``objective``'s."""
    calls = []

    def run(jobs, workers, watch, say, **how):
        failures = []
        for job in jobs:
            if job.output.exists():
                continue
            calls.append(job.name)
            job.output.parent.mkdir(parents=True, exist_ok=True)
            if job.name.startswith("judge"):
                facts = job.arguments["facts"]
                rates = objective(facts["settings"], facts["seed"])
                if rates is None:
                    failures.append(Failure(job, "on purpose"))
                    continue
                job.output.write_text(json.dumps({"rates": rates._asdict(), "training_seconds": 1.0}))
            else:
                job.output.write_bytes(b"")
        return failures

    return run, calls


def test_the_best_mean_over_the_seeds_is_chosen_from_the_finalists(tmp_path, monkeypatch, capsys):
    """Trial 3 is the best with seed 0 and the worse one of both finalists with three; trial 5 fails."""
    trials = drawn_trials("cppo", VEHICLE, 8, {})

    def objective(settings, seed):
        number = trials.index(settings)
        if number == 5:
            return None
        score = {3: (0.9, 0.5, 0.5), 6: (0.8, 0.8, 0.8)}.get(number, (0.6, 0.9, 0.9))[seed]
        return Rates(0.95, 0.95, score, score)

    run, calls = made_up(objective)
    monkeypatch.setattr(search, "run_jobs", run)
    command = ["--agents", "cppo", "--envs", VEHICLE, "--trials", "8", "--out", str(tmp_path)]
    assert main(command) == 1
    assert "cppo on RISE-GroundVehicle-v0, trial 5, seed 0: on purpose" in capsys.readouterr().err
    trained = [call.partition("trial ")[2] for call in calls if call.startswith("train")]
    assert trained == [f"{n}, seed 0" for n in range(8)] + [f"{n}, seed {s}" for s in (1, 2) for n in (3, 6)]
    chosen = tomllib.loads((tmp_path / "tuned.toml").read_text())[f"cppo@{VEHICLE}"]
    defaults = vars(make_agent("cppo", VEHICLE).config)
    assert chosen == {name: value for name, value in trials[6].items() if value != defaults[name]}
    text = (tmp_path / "tuned.toml").read_text()
    assert "trial 6 of 8" in text and "score 80.00" in text and "1 of the 8 settings" in text
    with (tmp_path / "trials.csv").open() as file:
        lines = list(csv.DictReader(file))
    assert tuple(lines[0]) == report.COLUMNS
    assert [(line["trial"], line["train_seed"]) for line in lines if line["trial"] in "36"] == [
        (trial, seed) for trial in "36" for seed in "012"
    ]
    assert imageio.imread(tmp_path / "search.png").shape[1] > 500
    assert len(lines) == 7 + 2 * 2 and all(json.loads(line["settings"]) in trials for line in lines)


def test_what_has_its_rates_is_not_trained_again(tmp_path, monkeypatch):
    run, calls = made_up(lambda settings, seed: Rates(1.0, 1.0, 0.5, 0.5))
    monkeypatch.setattr(search, "run_jobs", run)
    command = ["--agents", "cppo", "--envs", VEHICLE, "--trials", "4", "--out", str(tmp_path)]
    assert main(command) == 0
    shutil.rmtree(tmp_path / "agents")  # a search goes on from its rates alone
    calls.clear()
    assert main(command) == 0 and calls == []
    command[command.index("4")] = "5"
    assert main(command) == 0
    assert calls == [
        f"{do} cppo on {VEHICLE}, trial {n}, seed {s}"
        for n, s in ((4, 0), (1, 1), (1, 2))
        for do in ("train", "judge")
    ]


def test_rates_of_an_earlier_search_are_taken_for_the_very_same_trials(tmp_path, monkeypatch, capsys):
    run, calls = made_up(lambda settings, seed: Rates(1.0, 0.9, 0.5, 0.123456 if settings else 0.4))
    monkeypatch.setattr(search, "run_jobs", run)
    command = ["--agents", "cppo", "--envs", VEHICLE, "--trials", "5"]
    assert main([*command, "--out", str(tmp_path / "first")]) == 0
    first = (tmp_path / "first" / "trials.csv").read_text()
    calls.clear()
    known = ["--known", str(tmp_path / "first" / "trials.csv")]
    assert main([*command, "--out", str(tmp_path / "second"), *known]) == 0
    assert calls == [] and (tmp_path / "second" / "trials.csv").read_text() == first
    assert "9 results" in capsys.readouterr().err  # five trials, two of them with two more seeds
    for other in (["--scenarios", "399"], ["--set", "cppo.gae_lambda=0.9"]):
        calls.clear()
        assert main([*command, "--out", str(tmp_path / other[-1]), *known, *other]) == 0
        assert len(calls) == 2 * 9


@pytest.mark.parametrize(
    ("spoil", "says"),
    [
        (lambda text: text.replace("score", "sore"), "columns must be"),
        (lambda text: text.replace("0.5,", "1.5,"), "line 2"),
        (lambda text: text.replace("{}", "{"), "line 2"),
        (lambda text: "\x00" + text, "no table of trials"),
    ],
)
def test_a_table_of_trials_that_is_none_is_refused(spoil, says, tmp_path, monkeypatch, capsys):
    run, calls = made_up(lambda settings, seed: Rates(1.0, 0.9, 0.5, 0.4))
    monkeypatch.setattr(search, "run_jobs", run)
    command = ["--agents", "cppo", "--envs", VEHICLE, "--trials", "1", "--out", str(tmp_path)]
    assert main(command) == 0
    table = tmp_path / "known.csv"
    table.write_text(spoil((tmp_path / "trials.csv").read_text()))
    calls.clear()
    capsys.readouterr()
    assert main([*command, "--known", str(table)]) == 2
    assert main([*command, "--known", str(tmp_path / "missing.csv")]) == 2
    error = capsys.readouterr().err
    assert says in error and "cannot read" in error and error.count("\n") == 2 and calls == []


def test_the_same_budget_for_everybody_and_other_tables_are_kept(tmp_path, monkeypatch):
    run, calls = made_up(lambda settings, seed: Rates(1.0, 1.0, 0.5, 0.5))
    monkeypatch.setattr(search, "run_jobs", run)
    monkeypatch.setattr(search, "_recorded", lambda *a: ({env: (tmp_path, "d") for env in ENVS}, []))
    (tmp_path / "all.toml").write_text('["rise@Other-v0"]\nbeta = 3.0\n')
    command = ["--trials", "5", "--out", str(tmp_path / "out"), "--write", str(tmp_path / "all.toml")]
    assert main(command) == 0
    for name in ("rise", "pcbc", "cppo"):
        for env in (VEHICLE, PANDA):
            own = [call for call in calls if call.startswith(f"train {name} on {env},")]
            assert len(own) == 5 + 2 * 2  # of five trials two go on
    names = {f"{name}@{env}" for name in ("rise", "pcbc", "cppo") for env in (VEHICLE, PANDA)}
    written = tomllib.loads((tmp_path / "all.toml").read_text())
    assert set(written) == {*names, "rise@Other-v0"}
    assert all(written[name] == {} for name in names)  # of equals the defaults win


def test_a_stand_in_judges_only_the_agents_of_what_it_models():
    found = search_of(parser().parse_args(["--eval-env", MODEL]))
    assert [found.study("rise", env).eval_env for env in (VEHICLE, PANDA)] == [VEHICLE, MODEL]
    assert STAND_INS[MODEL] == PANDA


# --- from end to end -------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def tuned(tmp_path_factory, vehicle_demonstrations):
    folder = tmp_path_factory.mktemp("tune")
    vehicle_demonstrations.save(folder / "set")
    command = ["--agents", "pcbc", "--envs", VEHICLE, "--demos", str(folder / "set"), "--transitions", "700"]
    command += ["--set", "pcbc.updates=30", "--trials", "3", "--seeds", "2", "--scenarios", "12"]
    assert main([*command, "--workers", "2", "--out", str(folder / "out")]) == 0
    return folder, command


def test_a_small_search_measures_on_validation_scenarios(tuned):
    folder, _ = tuned
    results = sorted((folder / "out" / "trials" / VEHICLE).glob("*.json"))
    assert len(results) == 4  # three settings, and one again with another seed
    for path in results:
        found = json.loads(path.read_text())
        made = drawn_trials("pcbc", VEHICLE, 3, {"transitions": 700, "updates": 30})
        assert found["settings"] in made
    agents = {p: load_agent(p, VEHICLE) for p in (folder / "out" / "agents" / VEHICLE).glob("*.rise")}
    seeds = SPLITS["validation"] + np.arange(12)
    measured = {}
    for path, agent in agents.items():
        episodes = [rollout(agent, VEHICLE, seeds, noise_level=level)[0] for level in (0.0, 1.0)]
        rates = [rate for e in episodes for rate in (e.safe.mean(), e.reached.mean())]
        measured[agent.seed, json.dumps([agent.config.frame, agent.config.learning_rate])] = rates
        assert agent.config.transitions == 700 and agent.config.updates == 30
        assert not path.with_suffix(".training").exists()
    for path in results:
        found = json.loads(path.read_text())
        config = vars(make_config(PCBC, VEHICLE, found["settings"]))
        key = found["seed"], json.dumps([config["frame"], config["learning_rate"]])
        assert list(found["rates"].values()) == measured[key]


def test_again_it_redoes_nothing_and_fewer_workers_find_the_same(tuned, tmp_path, capfd):
    folder, command = tuned
    files = {path: path.stat().st_mtime_ns for path in (folder / "out").glob("*/*/*.*")}
    text = (folder / "out" / "tuned.toml").read_text()
    assert main([*command, "--workers", "2", "--out", str(folder / "out")]) == 0
    assert {path: path.stat().st_mtime_ns for path in files} == files
    assert "6 done already" in capfd.readouterr().err
    # Half of it is missing, as after a kill. The record of a training is written before its checkpoint.
    for path in sorted(path for path in files if path.suffix == ".rise" or path.parts[-3] == "trials")[::2]:
        path.unlink()
    assert main([*command, "--workers", "1", "--out", str(folder / "out")]) == 0
    again = (folder / "out" / "tuned.toml").read_text()
    assert tomllib.loads(again) == tomllib.loads(text)
    assert again.replace("--workers 1", "--workers 2") == text


def test_a_result_that_is_none_is_named(tuned, capsys):
    folder, command = tuned
    path = next((folder / "out" / "trials" / VEHICLE).glob("*.json"))
    content = path.read_text()
    path.write_text("{}")
    assert main([*command, "--out", str(folder / "out")]) == 1
    assert f"{path} holds no rates" in capsys.readouterr().err
    path.write_text(content)


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["--agents", "rize"], "did you mean 'rise'"),
        (["--agents", "expert"], "unknown agent 'expert'"),
        (["--agents", "pcbc-noise"], "did you mean 'pcbc-noisy'"),
        (["--agents", "rise-cbf"], "rise-cbf has demonstrations of its own: search settings of rise"),
        (["--config", "none.toml"], "cannot read the config file 'none.toml'"),
        (["--envs", "RISE-SafePnda-v0"], "did you mean 'RISE-SafePanda-v0'"),
        (["--trials", "0"], "trials must be"),
        (["--seeds", "0"], "seeds must be"),
        (["--scenarios", "0"], "episodes must be"),
        (["--episodes", "0"], "demos must be"),
        (["--transitions", "-1"], "transitions must be"),
        (["--clean-loss", "-1"], "points"),
        (["--clean-loss", "nan"], "points"),
        (["--workers", "0"], "--workers must be"),
        (["--checkpoint-every", "-1"], "--checkpoint-every"),
        (["--set", "rise.betta=1"], "did you mean 'beta'"),
        (["--set", "beta"], "AGENT.FIELD=VALUE"),
        (["--eval-env", VEHICLE], "stands in for no environment"),
        (["--eval-env", MODEL, "--envs", VEHICLE], "stands in for no environment"),
        (["--demos", "nowhere"], "does not exist"),
        (["--trial", "3"], "did you mean '--trials'"),
        (["--out", "/proc/nowhere"], "cannot write"),
    ],
)
def test_bad_arguments_end_in_one_line_and_exit_code_2(arguments, says, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(arguments) == 2
    error = capsys.readouterr().err
    assert says in error and error.count("\n") == 1
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["--envs", PANDA], "of an environment that is not searched"),
        (["--transitions", "1000000"], "record more episodes"),
    ],
)
def test_sets_that_do_not_fit_are_refused(arguments, says, tuned, capsys):
    folder, command = tuned
    assert main([*command, *arguments]) == 2
    assert says in capsys.readouterr().err
    twice = [*command, "--demos", str(folder / "set"), str(folder / "set")]
    assert main(twice) == 2
    assert "second set" in capsys.readouterr().err

"""Agents that come with the package: shipped from a run, found by name, evaluated without training."""

from __future__ import annotations

import hashlib
import json
import shutil
import subprocess
import sys
import tomllib
from fnmatch import fnmatch
from pathlib import Path

import numpy as np
import pytest

from benchmarks import configs, results
from benchmarks.jobs import check_settings, evaluation_jobs, how_it_acts
from benchmarks.protocol import make_plan
from benchmarks.run import main as run
from rise_agents import load_agent, make_agent, pretrained
from rise_agents.checkpoint import CheckpointError
from rise_agents.filters.kalman import KalmanFilter
from rise_agents.pretrained.__main__ import main as ship
from rise_agents.rollout import rollout

VEHICLE, PANDA = "RISE-GroundVehicle-v0", "RISE-SafePanda-v0"
PACKAGE = pretrained.FOLDER
BRIEF = {"pcbc": {"updates": 20}, "rise": {"updates": 20, "vae_updates": 20}}


def record(folder: Path, **changes) -> None:
    """A ``run.json`` as far as the command reads it."""
    paths = {f"{name}-seed{seed}": f"agents/{name}-{seed}.rise" for name in BRIEF for seed in (0, 1)}
    run = {"command": "python -m benchmarks.run", "agents": {VEHICLE: paths}}
    run["demonstrations"] = {VEHICLE: {"expert": "cbf", "episodes": 40}}
    (folder / "run.json").write_text(json.dumps(run | changes))


@pytest.fixture(scope="module")
def finished(tmp_path_factory, vehicle_demonstrations):
    """A run folder with two agents, two training seeds each."""
    folder = tmp_path_factory.mktemp("run")
    for name, config in BRIEF.items():
        for seed in (0, 1):
            agent = make_agent(name, VEHICLE, config, seed).learn(vehicle_demonstrations)
            agent.save(folder / "agents" / f"{name}-{seed}.rise")
    record(folder)
    return folder


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    """Where weights lie in these tests: empty at first, and never the package's own."""
    monkeypatch.setattr(pretrained, "FOLDER", tmp_path / "weights")
    return tmp_path / "weights"


@pytest.fixture
def shipped(finished, folder):
    assert ship([str(finished), "--into", str(folder)]) == 0
    return folder


def test_shipped_files_are_the_run_s_own_with_a_card(shipped, finished, vehicle_demonstrations):
    assert pretrained.available() == [("pcbc", VEHICLE), ("rise", VEHICLE)]
    card = json.loads((shipped / "card.json").read_text())
    assert set(card) == {f"pcbc-{VEHICLE}.rise", f"rise-{VEHICLE}.rise"}
    for name in BRIEF:
        content = (shipped / f"{name}-{VEHICLE}.rise").read_bytes()
        assert content == (finished / "agents" / f"{name}-0.rise").read_bytes()
        told = card[f"{name}-{VEHICLE}.rise"]
        assert told["sha256"] == hashlib.sha256(content).hexdigest() and told["bytes"] == len(content)
        assert told["agent"] == name and told["env"] == VEHICLE and told["seed"] == 0
        assert told["config"]["updates"] == 20
        assert told["run"] == "python -m benchmarks.run"
        assert told["demonstrations"] == {"expert": "cbf", "episodes": 40}
        agent = load_agent(name, env=VEHICLE)
        batch = vehicle_demonstrations.subsample(16)
        np.testing.assert_array_equal(
            agent.predict(batch, deterministic=True)[0],
            load_agent(finished / "agents" / f"{name}-0.rise").predict(batch, deterministic=True)[0],
        )


def test_a_row_that_acts_otherwise_is_shipped_as_it_acted(finished, folder, tmp_path, vehicle_demonstrations):
    run = tmp_path / "run"
    shutil.copytree(finished, run)
    paths = {
        f"{name}-seed0": "agents/rise-0.rise" for name in ("rise", "rise-mean", "rise-beta0.1", "rise+kalman")
    }
    stored = load_agent(run / "agents" / "rise-0.rise").config
    record(
        run,
        agents={VEHICLE: paths},
        settings={f"rise-mean@{VEHICLE}": {"posterior": "mean", "average": stored.average, "updates": 20}},
        plan={"variants": {"rise-beta0.1": {"agent": "rise", "expert": "mpc"}}},
        demonstrations={VEHICLE: {"expert": "cbf"}, f"{VEHICLE} by mpc": {"expert": "mpc"}},
    )
    assert ship([str(run), "--into", str(folder)]) == 0
    assert [name for name, _ in pretrained.available()] == ["rise", "rise-beta0.1", "rise-mean"]
    card = json.loads((folder / "card.json").read_text())
    source = (run / "agents" / "rise-0.rise").read_bytes()
    for name in ("rise", "rise-beta0.1"):
        assert pretrained.find(name, VEHICLE).read_bytes() == source
    mean, told = pretrained.find("rise-mean", VEHICLE), card[f"rise-mean-{VEHICLE}.rise"]
    assert (
        told["sha256"] == hashlib.sha256(mean.read_bytes()).hexdigest() != hashlib.sha256(source).hexdigest()
    )
    assert told["config"]["posterior"] == "mean" and told["demonstrations"] == {"expert": "cbf"}
    assert card[f"rise-beta0.1-{VEHICLE}.rise"]["demonstrations"] == {"expert": "mpc"}
    batch = vehicle_demonstrations.subsample(8)
    for name, settings in (("rise", None), ("rise-beta0.1", None), ("rise-mean", {"posterior": "mean"})):
        expected = load_agent(run / "agents" / "rise-0.rise", settings=settings)
        agent = load_agent(name, env=VEHICLE)
        assert agent.config == expected.config
        np.testing.assert_array_equal(agent.predict(batch)[0], expected.predict(batch)[0])
    asked = load_agent("rise", VEHICLE, "cpu", {"posterior": "mean", "average": 3}).config
    assert (asked.posterior, asked.average) == ("mean", 3)


def test_shipping_more_keeps_what_is_there(shipped, finished, capsys):
    before = json.loads((shipped / "card.json").read_text())
    arguments = ["--agents", "rise", "--seed", "1", "--note", "at commit 0123abc", "--into", str(shipped)]
    assert ship([str(finished), *arguments]) == 0
    after = json.loads((shipped / "card.json").read_text())
    assert load_agent("rise", VEHICLE).seed == 1 and load_agent("pcbc", VEHICLE).seed == 0
    assert after[f"rise-{VEHICLE}.rise"]["note"] == "at commit 0123abc"
    assert after[f"pcbc-{VEHICLE}.rise"] == before[f"pcbc-{VEHICLE}.rise"]
    assert f"rise-{VEHICLE}.rise" in capsys.readouterr().out


def test_a_name_is_looked_up_by_its_file(shipped):
    shutil.copy(shipped / f"rise-{VEHICLE}.rise", shipped / f"rise-my-own-{VEHICLE}.rise")
    assert ("rise-my-own", VEHICLE) in pretrained.available()
    assert load_agent("rise-my-own", env=VEHICLE).name == "rise"
    with pytest.raises(ValueError, match="name that, too"):
        load_agent("rise-my-own")


def test_a_file_goes_before_a_name(shipped, finished, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    shutil.copy(finished / "agents" / "pcbc-1.rise", "rise")
    assert load_agent("rise", env=VEHICLE).name == "pcbc"
    assert load_agent("./rise").name == "pcbc"


def test_weights_of_another_environment_are_refused_though_the_file_says_otherwise(shipped):
    shutil.copy(shipped / f"rise-{VEHICLE}.rise", shipped / f"rise-{PANDA}.rise")
    with pytest.raises(CheckpointError, match=f"trained on '{VEHICLE}'"):
        load_agent("rise", env=PANDA)


def test_what_is_missing_is_told_with_what_is_there(shipped, folder):
    there = f"there are: pcbc for {VEHICLE}, rise for {VEHICLE}"
    for name, env in (("rise", PANDA), ("cppo", VEHICLE), ("risse", VEHICLE), ("rise", "nowhere")):
        with pytest.raises(ValueError, match=f"no weights of '{name}' for '{env}'.*{there}"):
            load_agent(name, env=env)
    with pytest.raises(ValueError, match=rf"name that, too \(env=, --env\); {there}"):
        load_agent("rise")
    shutil.rmtree(folder)
    with pytest.raises(ValueError, match="there are: none in this package"):
        load_agent("rise", env=VEHICLE)


@pytest.mark.parametrize("path", ["nowhere", "nowhere.rise", "no/where", "", Path("rise"), Path("nowhere")])
def test_what_can_be_no_name_is_a_path(path):
    with pytest.raises(CheckpointError, match=r"does not exist|no regular file"):
        load_agent(path)


def test_the_package_s_own_files_are_what_their_card_says(monkeypatch):
    monkeypatch.setattr(pretrained, "FOLDER", PACKAGE)
    card = PACKAGE / pretrained.CARD
    told = json.loads(card.read_text()) if card.exists() else {}
    assert {path.name for path in PACKAGE.glob("*.rise")} == set(told)
    for name, env in pretrained.available():
        path = pretrained.find(name, env)
        assert told[path.name]["sha256"] == hashlib.sha256(path.read_bytes()).hexdigest()
        assert path.stat().st_size < 2_000_000
        assert load_agent(name, env=env).env_id == env


def test_a_wheel_carries_them():
    project = tomllib.loads((Path(__file__).parents[1] / "pyproject.toml").read_text())
    patterns = project["tool"]["setuptools"]["package-data"]["rise_agents.pretrained"]
    for name in (f"rise-{VEHICLE}.rise", pretrained.CARD):
        assert any(fnmatch(name, pattern) for pattern in patterns)


def test_looking_a_name_up_imports_no_torch():
    code = (
        "import sys\nfrom rise_agents import load_agent\ntry:\n    load_agent('risse', env='x')\n"
        "except ValueError:\n    print(*{'torch', 'stable_baselines3'} & set(sys.modules))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "\n"


# --- shipping: what can be wrong ---------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["--agents", "rize"], "did you mean 'rise'"),
        (["--envs", "RISE-GroundVehicl-v0"], f"did you mean '{VEHICLE}'"),
        (["--seed", "7"], "no agent of training seed 7"),
        (["--seed", "x"], "invalid int"),
        (["--int", "x"], "did you mean '--into'"),
    ],
)
def test_bad_arguments_of_shipping(arguments, says, finished, folder, capsys):
    assert ship([str(finished), "--into", str(folder), *arguments]) == 2
    error = capsys.readouterr().err
    assert says in error and error.count("\n") == 1
    assert not folder.exists()


@pytest.mark.parametrize("text", [None, "", "[]", "{}", '{"command": 1, "agents": {}, "demonstrations": {}}',
                                  '{"command": "", "agents": {}, "demonstrations": {}, "settings": {"x": 1}}',
                                  '{"command": "", "agents": {}, "demonstrations": {}, "plan": []}',
                                  '{"command": "", "agents": {"x": {"y": 1}}, "demonstrations": {}}'])  # fmt: skip
def test_a_folder_that_is_no_run_is_refused(text, tmp_path, folder, capsys):
    if text is not None:
        (tmp_path / "run.json").write_text(text)
    assert ship([str(tmp_path), "--into", str(folder)]) == 2
    assert "no record of a benchmark run" in capsys.readouterr().err


@pytest.mark.parametrize(
    "paths", [{"../up-seed0": "agents/rise-0.rise"}, {"a/b-seed0": "agents/rise-0.rise"}], ids=["up", "down"]
)
def test_names_of_a_foreign_record_lead_nowhere_else(paths, finished, tmp_path, folder, capsys):
    shutil.copytree(finished, tmp_path / "run")
    record(tmp_path / "run", agents={VEHICLE: paths})
    assert ship([str(tmp_path / "run"), "--into", str(folder)]) == 2
    record(tmp_path / "run", agents={"../x": {"rise-seed0": "agents/rise-0.rise"}})
    assert ship([str(tmp_path / "run"), "--into", str(folder)]) == 2
    assert not folder.exists()


def test_a_damaged_checkpoint_is_not_shipped(finished, tmp_path, folder, capsys):
    shutil.copytree(finished, tmp_path / "run")
    with (tmp_path / "run" / "agents" / "rise-0.rise").open("r+b") as file:
        file.seek(200)
        file.write(b"!!")
    assert ship([str(tmp_path / "run"), "--into", str(folder)]) == 1
    assert "damaged" in capsys.readouterr().err
    assert not folder.exists()


# --- the benchmark -------------------------------------------------------------------------------------------------

COMMAND = ["--pretrained", "--envs", VEHICLE, "--preset", "smoke", "--episodes", "6", "--workers", "1"]


def test_a_run_evaluates_them_and_trains_nobody(shipped, tmp_path):
    out = tmp_path / "out"
    assert run([*COMMAND, "--agents", "rise", "pcbc", "--no-videos", "--out", str(out)]) == 0
    assert not (out / "agents").exists() and not (out / "demonstrations").exists()
    rows = results.read_rows(out / "episodes.parquet").to_pylist()
    assert [(row["agent"], row["train_seed"]) for row in rows] == [
        (n, 0) for n in ("pcbc", "rise") for _ in range(6)
    ]
    told = json.loads((out / "run.json").read_text())
    assert told["plan"]["pretrained"] is True and told["demonstrations"] == {}
    assert told["settings"][f"rise@{VEHICLE}"]["updates"] == 20
    digest = hashlib.sha256((shipped / f"rise-{VEHICLE}.rise").read_bytes()).hexdigest()
    assert digest in told["agents"][VEHICLE]["rise-seed0"]
    assert "come with the package" in (out / "summary.md").read_text()


def plan(*agents, settings=None, **chosen):
    chosen = {"envs": (VEHICLE,), "noise_models": ("step",), "pretrained": True, **chosen}
    return make_plan("smoke", settings or {}, agents=agents, **chosen)


def test_rows_of_all_kinds_are_run_with_shipped_weights(shipped, tmp_path):
    """A variant of how an agent acts has its weights; behind a filter, on true readings, under every noise model."""
    out = tmp_path / "out"
    rows = ["--agents", "rise-mean", "rise-mean+true", "pcbc+kalman", "expert+true", "--no-videos"]
    noise = ["--noise-model", "step", "episode", "--noise-levels", "0", "1"]
    assert run([*COMMAND, *rows, *noise, "--out", str(out)]) == 0
    assert {path.name for path in out.iterdir()}.isdisjoint({"agents", "demonstrations"})
    table = results.read_rows(out / "episodes.parquet").to_pylist()
    seeds = sorted({row["env_seed"] for row in table})
    mean = load_agent(shipped / f"rise-{VEHICLE}.rise", settings={"posterior": "mean"})
    kalman = KalmanFilter(load_agent("pcbc", VEHICLE), mean.task, 1.0)
    for name, policy, level in (
        ("rise-mean", mean, 1.0),
        ("rise-mean+true", mean, 0.0),
        ("pcbc+kalman", kalman, 1.0),
    ):
        for model in ("step", "episode"):
            condition = (name, model, 1.0)
            measured = [
                row["episode_return"]
                for row in table
                if (row["agent"], row["noise_model"], row["noise_level"]) == condition
            ]
            episodes, _ = rollout(policy, VEHICLE, seeds, noise=model, noise_level=level, deterministic=False)
            np.testing.assert_allclose(measured, episodes.episode_return, rtol=1e-6)
    told = json.loads((out / "run.json").read_text())
    assert told["settings"][f"rise-mean@{VEHICLE}"]["posterior"] == "mean"
    digest = hashlib.sha256((shipped / f"rise-{VEHICLE}.rise").read_bytes()).hexdigest()
    assert digest in told["agents"][VEHICLE]["rise-mean-seed0"]
    assert "RISE, z = μ" in (out / "summary.md").read_text()


def test_a_variant_has_its_own_file_or_that_of_its_agent(shipped, folder):
    run = plan("rise-mean", "rise-body")
    assert run.shipped("rise-mean+kalman", VEHICLE) == folder / f"rise-{VEHICLE}.rise"
    with pytest.raises(
        ValueError, match=r"settings of rise-z2: rise-.*\.rise was trained with latent = 5, not 2"
    ):
        check_settings(plan("rise-z2"))
    shutil.copy(folder / f"rise-{VEHICLE}.rise", folder / f"rise-mean-{VEHICLE}.rise")
    assert run.shipped("rise-mean", VEHICLE) == folder / f"rise-mean-{VEHICLE}.rise"
    check_settings(plan("rise-mean", "rise-body"))  # body is what it was trained with


def test_acting_settings_are_laid_over_shipped_weights(shipped, tmp_path):
    run = plan("rise", "rise-mean", settings={"rise": {"average": 3}, f"rise-mean@{VEHICLE}": {"average": 4}})
    assert how_it_acts(run, VEHICLE, "rise") == {"average": 3, "posterior": "sample"}
    assert how_it_acts(run, VEHICLE, "rise-mean") == {"average": 4, "posterior": "mean"}
    acting, as_shipped = evaluation_jobs(run, tmp_path)[0], evaluation_jobs(plan("rise"), tmp_path)[0]
    assert acting.arguments["settings"]["average"] == 3 and acting.output != as_shipped.output


def test_settings_of_presets_and_of_tuning_are_not_those_of_shipped_weights(shipped, tmp_path, monkeypatch):
    tuned = tmp_path / "tuned.toml"
    tuned.write_text("[rise]\nbeta = 0.3\n")
    monkeypatch.setattr(configs, "TUNED", tuned)
    run = make_plan("paper", {}, agents=("rise",), envs=(VEHICLE,), noise_models=("step",), pretrained=True)
    assert run.settings == {} and run.seeds == 1
    check_settings(run)


def test_new_weights_do_not_meet_old_results(shipped, finished, tmp_path):
    (before,) = evaluation_jobs(plan("rise"), tmp_path)
    assert ship([str(finished), "--seed", "1", "--into", str(shipped)]) == 0
    (after,) = evaluation_jobs(plan("rise"), tmp_path)
    assert before.output != after.output


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["--agents", "rise", "cppo"], "no weights of 'cppo'"),
        (["--agents", "rise", "--envs", PANDA], f"no weights of 'rise' for '{PANDA}'"),
        (["--agents", "rise", "--seeds", "2"], "leave out"),
        (["--agents", "rise", "--demos", "2"], "leave out"),
        (
            ["--agents", "rise", "--set", "rise.updates=2"],
            "was trained with updates = 20, not 2: only average, post",
        ),
        (["--agents", "pcbc", "--set", "pcbc.updates=2"], "was trained with updates = 20, not 2: none can"),
        (["--agents", "rise", "--set", "rise.posterior=mode"], "posterior must be one of"),
        (
            ["--agents", "rise-m1"],
            "settings of rise-m1: rise-RISE-GroundVehicle-v0.rise was trained with n_samples",
        ),
        (["--agents", "rise-cbf"], f"no weights of 'rise-cbf' for '{VEHICLE}'"),
        (["--agents", "rise+kalmann"], "did you mean 'kalman'"),
    ],
)
def test_what_cannot_be_evaluated_is_told_at_once(arguments, says, shipped, tmp_path, capsys):
    assert run([*COMMAND, *arguments, "--out", str(tmp_path / "out")]) == 2
    error = capsys.readouterr().err
    assert says in error and error.count("\n") == 1
    assert not (tmp_path / "out").exists()


def test_a_damaged_file_of_the_package_is_told_at_once(shipped, tmp_path, capsys):
    with (shipped / f"rise-{VEHICLE}.rise").open("r+b") as file:
        file.seek(200)
        file.write(b"!!")
    assert run([*COMMAND, "--agents", "rise", "--out", str(tmp_path / "out")]) == 2
    assert "damaged" in capsys.readouterr().err


def test_the_experts_need_no_weights(folder, tmp_path):
    assert run([*COMMAND, "--agents", "random", "--no-videos", "--out", str(tmp_path / "out")]) == 0


@pytest.mark.parametrize("given", [["--seeds", "2"], ["--expert", "cbf"], ["--tensorboard", "events"]])
def test_who_trains_nobody_is_not_told_how_to(given, capsys):
    assert run([*COMMAND, *given]) == 2
    assert f"--pretrained trains nobody: leave out {given[0]}\n" in capsys.readouterr().err

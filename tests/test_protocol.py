"""What a plan says will be run: rows, who trains for them, who demonstrates, under which noise."""

from __future__ import annotations

import json
from dataclasses import asdict

import pytest

from benchmarks.labels import agent_label, is_reference, name_rows, split_row
from benchmarks.protocol import make_plan, with_filters

VEHICLE, PANDA = "RISE-GroundVehicle-v0", "RISE-SafePanda-v0"


def plan(*agents, settings=None, files=(), **chosen):
    chosen = {"envs": (VEHICLE, PANDA), "noise_models": ("step",), "seeds": 2, **chosen}
    return make_plan("quick", settings or {}, files, agents=agents, **chosen)


def test_rows_of_variants_filters_and_references():
    run = plan("rise-mean", "pcbc+kalman", "expert+true", "random", "expert+kalman")
    assert run.rows(VEHICLE) == [
        *[("rise-mean", 0), ("rise-mean", 1), ("pcbc+kalman", 0), ("pcbc+kalman", 1)],
        *[("expert-cbf+true", 0), ("expert-mpc+true", 0), ("expert-mixture+true", 0), ("random", 0)],
        *[("expert-cbf+kalman", 0), ("expert-mpc+kalman", 0), ("expert-mixture+kalman", 0)],
    ]
    agents = [run.agent_of(row) for row in ("rise-mean", "pcbc+kalman", "random", "expert-cbf+true")]
    assert agents == ["rise", "pcbc", "", ""]


def test_only_the_variants_of_a_run_are_stored_with_it():
    run = plan("rise", "rise-mean+kalman", settings={"pcbc-noisy": {"train_noise": 2.0}})
    assert set(run.variants) == {"rise-mean"}
    assert run.settings == {"rise-mean": {"posterior": "mean"}}
    assert json.loads(json.dumps(asdict(run)))["variants"]["rise-mean"]["label"] == "RISE, z = μ"


def test_a_filter_adds_a_row_to_every_row_that_reads():
    assert with_filters(("rise", "random", "pcbc+kalman", "pcbc", "expert"), ("kalman",)) == (
        *("rise", "rise+kalman", "random", "pcbc+kalman", "pcbc", "expert", "expert+kalman"),
    )
    assert with_filters(("rise", "rise"), ()) == ("rise",)


def test_level_0_is_measured_once():
    run = plan("rise", noise_models=("episode", "step"), noise_levels=(0.0, 1.0))
    assert run.conditions() == [("episode", 0.0), ("episode", 1.0), ("step", 1.0)]
    assert plan("rise", noise_levels=(0.0, 1.0)).conditions() == [("step", 0.0), ("step", 1.0)]


def test_experts_that_demonstrate():
    assert plan("rise", "pcbc").experts(VEHICLE) == ["mixture"]
    run = plan("rise-cbf", "rise-mpc+kalman", "rise-mean", "cppo", "expert")
    assert run.experts(VEHICLE) == ["cbf", "mpc", "mixture"]
    assert [run.expert_of(row) for row in ("rise-cbf+kalman", "rise-mean", "cppo")] == [
        "cbf",
        "mixture",
        "mixture",
    ]
    assert plan("cppo", "expert", "random").experts(VEHICLE) == []


def test_variants_stay_in_their_environments(tmp_path):
    path = tmp_path / "mine.toml"
    path.write_text(f'[variants.here]\nagent = "pcbc"\nenvs = ["{VEHICLE}"]\nexpert = "cbf"\n')
    run = plan("here+kalman", "rise", files=[path])
    assert [row for row, _ in run.rows(PANDA)] == ["rise", "rise"]
    assert run.experts(VEHICLE) == ["cbf", "mixture"] and run.experts(PANDA) == ["mixture"]
    with pytest.raises(ValueError, match=f"variant 'here' is for {VEHICLE} only"):
        plan("here", files=[path], envs=(PANDA,))


@pytest.mark.parametrize(
    ("agents", "settings", "says"),
    [
        (("rise-meen",), {}, "unknown agent 'rise-meen': did you mean 'rise-mean'"),
        (("rise+kalmann",), {}, "unknown filter 'kalmann': did you mean 'kalman'"),
        (("rise+",), {}, "unknown filter ''"),
        (("rise+kalman+true",), {}, "unknown filter 'kalman\\+true'"),
        (("rise",), {"rise-meen": {"beta": 1}}, "did you mean 'rise-mean'"),
        (("rise",), {"rise-mean@x": {"beta": 1}}, "unknown environment 'x'"),
        (("rise",), {"random": {"beta": 1}}, "unknown agent 'random'"),
    ],
)
def test_unknown_names_are_told_with_the_nearest_one(agents, settings, says):
    with pytest.raises(ValueError, match=says):
        plan(*agents, settings=settings)


def test_rows_are_called_as_people_say():
    assert split_row("pcbc+kalman") == ("pcbc", "kalman") and split_row("pcbc") == ("pcbc", "")
    assert agent_label("pcbc+kalman") == "PC-BC behind a Kalman filter"
    assert agent_label("expert-cbf+true") == "Expert (cbf) on true readings"
    assert agent_label("mine+other") == "mine+other"
    name_rows({"my-own-row": "My own"})
    assert agent_label("my-own-row") == "My own"
    assert agent_label("my-own-row+kalman") == "My own behind a Kalman filter"
    assert is_reference("expert+true") and is_reference("expert-mpc+kalman") and is_reference("random")
    assert not is_reference("rise+kalman")

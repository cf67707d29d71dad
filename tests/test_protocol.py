"""What a plan says will be run: rows, who trains for them, who demonstrates, under which noise."""

from __future__ import annotations

import json
from dataclasses import asdict

import pytest

from benchmarks.labels import agent_label, is_reference, name_rows, split_row
from benchmarks.presets import PRESETS, Block
from benchmarks.protocol import make_plan, with_filters
from rise_agents import agent_class

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
    assert run.conditions(VEHICLE, "rise", 1) == [("episode", 0.0), ("episode", 1.0), ("step", 1.0)]
    alone = plan("rise", noise_levels=(0.0, 1.0))
    assert alone.conditions(PANDA, "rise", 0) == [("step", 0.0), ("step", 1.0)]


def test_a_block_adds_rows_and_conditions_of_its_own():
    blocks = (
        Block("drift", ("pcbc", "rise-mean", "random"), ("drift:0.3",), (0.0, 1.0), 3),
        Block("here", ("expert-cbf+kalman", "expert"), ("step",), (2.0,), 2, (VEHICLE,)),
    )
    run = plan("rise", "pcbc", noise_levels=(0.0, 1.0), blocks=blocks)
    own, drift = [("step", 0.0), ("step", 1.0)], [("step", 0.0), ("drift:0.3", 1.0)]
    met = {row: run.conditions(PANDA, *row) for row in run.rows(PANDA)}
    assert met == {  # level 0 is the same for every model, and is measured under the first
        **dict.fromkeys((("rise", 0), ("rise", 1)), own),
        **{key: [*own, drift[1]] for key in (("pcbc", 0), ("pcbc", 1))},
        ("pcbc", 2): drift,
        **dict.fromkeys((("rise-mean", 0), ("rise-mean", 1), ("rise-mean", 2), ("random", 0)), drift),
    }
    experts = ["expert-cbf+kalman", "expert-cbf", "expert-mpc", "expert-mixture"]
    assert run.rows(VEHICLE) == [*run.rows(PANDA), *((row, 0) for row in experts)]
    names = [["rise", "pcbc"], ["pcbc", "rise-mean", "random"], experts]
    assert [block["rows"] for block in run.described()] == names
    assert set(run.variants) == {"rise-mean"}
    assert len(plan("rise", envs=(PANDA,), blocks=blocks[1:]).described()) == 1  # which is not of this run


@pytest.mark.parametrize(
    ("block", "says"),
    [
        (Block("x", ("rise-meen",), ("step",), (1.0,), 1), "unknown agent 'rise-meen'"),
        (Block("x", ("expert-cfb",), ("step",), (1.0,), 1), "did you mean 'expert-cbf'"),
        (Block("x", ("rise",), ("stp",), (1.0,), 1), "did you mean 'step'"),
        (Block("x", ("rise",), ("step",), (-1.0,), 1), "noise levels must be finite"),
        (Block("x", ("rise",), ("step",), (1.0,), 0), "seeds must be a whole number"),
        (Block("x", ("rise",), ("step",), (1.0,), 1, ("RISE-Moon-v0",)), "unknown environment"),
        (Block("x", (), ("step",), (1.0,), 1), "at least one agent"),
    ],
)
def test_what_is_wrong_with_a_block_is_told(block, says):
    with pytest.raises(ValueError, match=says):
        plan("rise", blocks=(block,))


def test_the_rows_of_a_preset_are_those_of_its_blocks_unless_one_names_some():
    chosen = {"envs": (VEHICLE, PANDA)}
    paper = make_plan("paper", {}, **chosen)
    assert paper.agents == PRESETS["paper"].agents and paper.noise_models == ("step", "episode")
    assert len(paper.described()) == 1 + len(PRESETS["paper"].blocks)
    rows = {row for row, _ in paper.rows(VEHICLE)}
    assert rows >= {"expert-cbf", "expert-mpc", "rise-z2", "rise+kalman", "random"}
    assert {seed for row, seed in paper.rows(PANDA) if row == "rise"} == set(range(5))
    assert {seed for row, seed in paper.rows(PANDA) if row == "rise-mean"} == set(range(3))
    assert make_plan("paper", {}, agents=("pcbc",), **chosen).blocks == ()


def test_smoke_trains_every_agent_as_briefly_as_it_says():
    run = make_plan("smoke", {"rise": {"updates": 7}}, agents=("rise-beta1", "rise-belief"), envs=(VEHICLE,))
    assert run.config("rise-belief", VEHICLE) == agent_class("rise-belief").BRIEF
    assert run.config("rise-beta1", VEHICLE) == {**agent_class("rise").BRIEF, "updates": 7, "beta": 1.0}


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

"""Config files: what they say, which layer wins, and one line for whatever is wrong with them."""

from __future__ import annotations

import re
from dataclasses import fields

import pytest

from benchmarks import configs
from benchmarks.configs import SHIPPED, Variant, laid_over, read
from benchmarks.protocol import make_plan
from rise_agents import agent_class
from rise_agents.agent import make_config
from rise_agents.cloning import CloningConfig
from rise_agents.experts import expert_names
from rise_envs import ENVS

VEHICLE, PANDA = "RISE-GroundVehicle-v0", "RISE-SafePanda-v0"
EXAMPLE = f"""
[rise]
beta = 0.2
hidden = [64, 64]

["rise@{VEHICLE}"]
beta = 0.3

[variants.rise-large]
agent = "rise"
label = "RISE, large"
hidden = [512, 512]

["rise-large@{PANDA}"]
latent = 9

[variants."pcbc0.5"]
agent = "pcbc"
envs = ["{VEHICLE}"]
expert = "cbf"
train_noise = 0.5
search.train_noise = [0.25, 1]
"""


@pytest.fixture
def file(tmp_path):
    path = tmp_path / "mine.toml"
    path.write_text(EXAMPLE)
    return path


def plan(agents, settings=None, files=(), preset="quick", **chosen):
    chosen = {"envs": (VEHICLE, PANDA), "noise_models": ("step",), **chosen}
    return make_plan(preset, settings or {}, files, agents=agents, **chosen)


def test_a_file_says_variants_and_settings(file):
    found = read([file])
    assert found.variants == {
        "rise-large": Variant("rise", "RISE, large"),
        "pcbc0.5": Variant("pcbc", envs=(VEHICLE,), expert="cbf"),
    }
    assert found.layers == (
        {
            "rise": {"beta": 0.2, "hidden": [64, 64]},
            f"rise@{VEHICLE}": {"beta": 0.3},
            "rise-large": {"hidden": [512, 512]},
            f"rise-large@{PANDA}": {"latent": 9},
            "pcbc0.5": {"train_noise": 0.5},
        },
    )
    assert found.searches == {"pcbc0.5": {"train_noise": [0.25, 1]}}


def test_settings_lie_over_each_other_in_order(file):
    """Agent < preset < file < --set; a variant over its agent; one environment over all of the same source."""
    run = plan(("rise", "rise-large"), {"rise-large": {"beta": 0.7}}, [file], preset="smoke")
    assert run.config("rise", VEHICLE)["beta"] == 0.3 and run.config("rise", PANDA)["beta"] == 0.2
    assert run.config("rise", PANDA)["updates"] == 300  # of the preset
    large = run.config("rise-large", PANDA)
    assert (large["hidden"], large["beta"], large["latent"], large["updates"]) == ([512, 512], 0.7, 9, 300)
    assert "latent" not in run.config("rise-large", VEHICLE)
    # What is said later of an agent holds also where somebody before spoke of one environment alone.
    over = plan(("rise",), {"rise": {"beta": 0.9}}, [file])
    assert over.config("rise", VEHICLE)["beta"] == over.config("rise", PANDA)["beta"] == 0.9
    # A variant's own setting is what it is: its agent's does not change it.
    assert plan(("rise-beta0.1",), {"rise": {"beta": 0.9}}).config("rise-beta0.1", VEHICLE)["beta"] == 0.1


def test_later_files_win(file, tmp_path):
    other = tmp_path / "other.toml"
    other.write_text(f'[rise]\nbeta = 0.4\n["rise-large@{VEHICLE}"]\nlatent = 3\n')
    run = plan(("rise", "rise-large"), {}, [file, other])
    assert run.config("rise", VEHICLE) == {"beta": 0.4, "hidden": [64, 64]}
    assert run.config("rise-large", VEHICLE)["latent"] == 3


def test_laying_over_changes_no_layer():
    layers = [{"a@x": {"k": 1, "l": 2}, "a": {"k": 0}}, {"a": {"k": 5}}]
    assert laid_over(layers) == {"a": {"k": 5}, "a@x": {"l": 2}}
    assert layers == [{"a@x": {"k": 1, "l": 2}, "a": {"k": 0}}, {"a": {"k": 5}}]


def test_tuned_settings_belong_to_preset_paper_alone(tmp_path, monkeypatch):
    tuned = tmp_path / "tuned.toml"
    monkeypatch.setattr(configs, "TUNED", tuned)
    assert "beta" not in plan(("rise",), preset="paper").config("rise", VEHICLE)  # absent: nothing happens
    tuned.write_text(f'["rise@{VEHICLE}"]\nbeta = 0.123\n')
    run = plan(("rise", "rise-beta1"), preset="paper")
    assert run.config("rise", VEHICLE) == {"beta": 0.123}
    assert "beta" not in run.config("rise", PANDA)
    assert run.config("rise-beta1", VEHICLE)["beta"] == 1.0
    assert "beta" not in plan(("rise",)).config("rise", VEHICLE)
    mine = tmp_path / "mine.toml"
    mine.write_text("[rise]\nbeta = 0.5\n")
    assert plan(("rise",), {}, [mine], preset="paper").config("rise", VEHICLE)["beta"] == 0.5


def test_every_shipped_variant_is_sound():
    """Its settings are valid where it is run, differ from its agent's, and its label is its own."""
    found = read([SHIPPED])
    labels = [variant.label for variant in found.variants.values()]
    assert all(labels) and len(set(labels)) == len(labels)
    for name, variant in found.variants.items():
        kind, settings = agent_class(variant.agent), found.layers[0][name]
        assert settings or variant.expert, name
        for env in variant.envs or ENVS:
            make_config(kind, env, settings)
            assert not variant.expert or variant.expert in expert_names(env)
    # At the same budget of samples as RISE, which is the point of this control.
    samples = make_config(agent_class("rise"), VEHICLE, {}).n_samples
    assert found.layers[0]["pcbc-noisy"] == {"train_noise": 1.0, "n_samples": samples}


def test_pcbc_as_rise_is_rise_without_its_encoder():
    """Whatever the search chose for RISE: all that both have is the same."""
    run = plan(("rise", "pcbc-as-rise"), preset="paper")
    for env in run.envs:
        rise, pcbc = (
            make_config(agent_class(agent), env, run.config(row, env))
            for row, agent in (("rise", "rise"), ("pcbc-as-rise", "pcbc"))
        )
        for each in fields(CloningConfig):
            assert getattr(pcbc, each.name) == getattr(rise, each.name), (env, each.name)
        assert pcbc.train_noise == 0


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("[rise", "is no TOML"),
        ("[rize]\nbeta = 1", "table 'rize': names no agent and no variant: did you mean 'rise'"),
        ("rise = 3", "table 'rise': must be a table of settings, got 3"),
        ("variants = 3", "holds tables, as in [variants.NAME]"),
        ("[rise]\nbetta = 1", "table 'rise': unknown setting 'betta' of rise.Config: did you mean 'beta'"),
        ("[rise]\nlatent = 1.5", "table 'rise': rise.Config.latent must be a whole number"),
        ('["rise@RISE-SafePnda-v0"]\nbeta = 1', "names no environment 'RISE-SafePnda-v0': did you mean"),
        ('["rise@"]\nbeta = 1', "names no environment ''"),
        ("[variants.mine]\nbeta = 1", "table 'variants.mine': agent must name an agent, got None"),
        ("[variants.mine]\nagent = 'rize'", "agent must name an agent, got 'rize': did you mean 'rise'"),
        ("[variants.mine]\nagent = ['rise']", "agent must name an agent"),
        ("[variants]\nmine = 'rise'", "agent must name an agent, got 'rise'"),
        ("[variants.mine]\nagent = 'rise'\nbetta = 1", "'variants.mine': unknown setting 'betta'"),
        ("[variants.mine]\nagent = 'rise'\nlabel = 1", "label must be a str"),
        ("[variants.mine]\nagent = 'rise'\nenvs = 'x'", "envs must be a tuple"),
        ("[variants.mine]\nagent = 'rise'\nenvs = ['RISE-GroundVehicl-v0']", "did you mean 'RISE-GroundVeh"),
        ("[variants.mine]\nagent = 'rise'\nexpert = 'cbff'", "expert 'cbff' is unknown: did you mean 'cbf'"),
        ("[variants.mine]\nagent = 'cppo'\nexpert = 'cbf'", "cppo learns from no expert"),
        ("[variants.rise]\nagent = 'rise'", "needs a name"),
        ("[variants.expert-x]\nagent = 'rise'", "needs a name"),
        ("[variants.'a+b']\nagent = 'rise'", "needs a name"),
        ("[variants.'a/b']\nagent = 'rise'", "needs a name"),
        ('[variants."a\\nb"]\nagent = "rise"', "needs a name"),
        ("[variants.rise-mean]\nagent = 'rise'", "'variants.rise-mean': is there already"),
        ('["rise-men@RISE-SafePanda-v0"]\nbeta = 1', "no variant: did you mean 'rise-mean'"),
        ('["rise-mean@RISE-SafePanda-v0"]\nlabel = "x"', "unknown setting 'label'"),
        ('[variants."rise@RISE-SafePanda-v0"]\nagent = "rise"', "needs a name"),
        ("[variants.mine]\nagent = 'rise'\nsearch = 3", "search must hold lists of values"),
        ("[variants.mine]\nagent = 'rise'\nsearch.beta = []", "search must hold lists of values"),
        ("[variants.mine]\nagent = 'rise'\nsearch.latent = [4, 1.5]", "latent must be a whole number"),
    ],
)
def test_what_is_wrong_is_said_in_one_line_that_names_the_file(tmp_path, text, says):
    path = tmp_path / "wrong.toml"
    path.write_text(text)
    with pytest.raises(ValueError, match=re.escape(says)) as caught:
        read([SHIPPED, path])
    assert "wrong.toml" in str(caught.value) and "\n" not in str(caught.value)


def test_files_that_cannot_be_read(tmp_path):
    (tmp_path / "bytes.toml").write_bytes(b"\xff\xfe")
    for name, says in (("none.toml", "No such file"), (".", "cannot read"), ("bytes.toml", "is no TOML")):
        with pytest.raises(ValueError, match=says) as caught:
            read([tmp_path / name])
        assert "\n" not in str(caught.value)
    with pytest.raises(ValueError, match="null"):
        read([tmp_path / "a\0b"])

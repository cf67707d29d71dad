"""The site of the documentation: pages that follow from the registries, and links that lead somewhere."""

from __future__ import annotations

import importlib.util
import os
import re
import runpy
import subprocess
import sys
from dataclasses import fields
from pathlib import Path

import pytest

from rise_agents import AGENTS, agent_class
from rise_agents.experts import EXPERTS
from rise_agents.filters import FILTERS
from rise_agents.plugins import import_modules
from rise_envs import ENVS, NOISE_MODELS, STAND_INS
from rise_envs.task import env_class

DOCS = Path(__file__).resolve().parents[1] / "docs"


@pytest.fixture(scope="module")
def catalogue():
    spec = importlib.util.spec_from_file_location("catalogue", DOCS / "catalogue.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def row(page: str, name: str) -> list[str]:
    """The cells of the row of a table that begins with a name."""
    (found,) = re.findall(rf"^\| {re.escape(name)} \|(.*)\|$", page, re.MULTILINE)
    return [cell.strip() for cell in found.split(" | ")]


# --- registries ------------------------------------------------------------------------------------------------


def test_all_that_is_registered_is_there(catalogue):
    environments, agents, experts, noise = (
        *(catalogue.environments(), catalogue.agents()),
        *(catalogue.experts()["experts.md"], catalogue.noise()["noise.md"]),
    )
    assert set(environments) == {"environments.md", *(f"environments/{env_id}.md" for env_id in ENVS)}
    assert set(agents) == {"agents.md", *(f"agents/{name}.md" for name in AGENTS)}
    assert all(f"environments/{env_id}.md" in environments["environments.md"] for env_id in ENVS)
    assert all(f"agents/{name}.md" in agents["agents.md"] for name in AGENTS)
    for entry in (*EXPERTS.values(), *FILTERS.values()):
        assert f"### {entry.partition(':')[2]}" in experts
    assert all(row(noise, f"`{name}`") for name in NOISE_MODELS)


def test_a_line_in_a_registry_is_enough(catalogue, own_names):
    examples = ("omni_base", "calm_pendulum", "neighbours", "coloured", "smoothing")
    import_modules([str(DOCS / "examples" / f"{name}.py") for name in examples])
    environments, agents = catalogue.environments(), catalogue.agents()
    omni, pendulum = (
        environments["environments/OmniBase-v0.md"],
        environments["environments/CalmPendulum-v0.md"],
    )
    assert row(omni, "[experts](../experts.md)") == ["`barrier`"]
    assert "(2,)" in row(omni, "action")[0] and "# CalmPendulum-v0" in pendulum
    assert row(agents["agents/neighbours.md"], "`neighbours`") == ["`8`", "k."]
    assert row(catalogue.noise()["noise.md"], "`coloured`") and b"PNG" in catalogue.noise_picture()[:8]
    assert "Smoothing" in catalogue.experts()["experts.md"] or "smooth" in catalogue.experts()["experts.md"]


@pytest.mark.parametrize("name", AGENTS)
def test_every_setting_of_an_agent_is_explained(catalogue, name):
    page, config = catalogue.agent(name), agent_class(name).Config
    for field in fields(config):
        default, words = row(page, f"`{field.name}`")
        assert default.strip("`") == catalogue.value(field.default) and words, field.name


@pytest.mark.parametrize("env_id", ENVS)
def test_what_a_page_says_of_an_environment_is_so(catalogue, env_id):
    page, env = catalogue.environment(env_id), env_class(env_id)()
    assert row(page, "steps per episode") == [str(ENVS[env_id][2])]
    for key, space in env.observation_space.items():
        assert f"| `{key}` | {space.shape}, float64, from " in page
    assert ("stands in for" in page) == (env_id in STAND_INS)
    assert all(f"## {title}" in page for title in ("Description", "Reward", "Start", "Constants"))
    assert "| |\n" not in page.partition("## Constants")[2]  # each is explained
    env.close()


@pytest.mark.parametrize("env_id", [name for name in ENVS if name not in STAND_INS])
def test_environments_have_a_picture(catalogue, env_id):
    assert f"/images/envs/{env_id}.gif" in catalogue.environment(env_id)


def test_pictures_are_small():
    pictures = [*DOCS.glob("images/**/*.gif"), *DOCS.glob("images/*.png")]
    assert len(pictures) > 5
    assert {path.name: path.stat().st_size for path in pictures if path.stat().st_size > 500_000} == {}


# --- text ------------------------------------------------------------------------------------------------------


def test_roles_are_those_of_myst(catalogue):
    assert catalogue.in_markdown("see :class:`a.b.C`") == "see {py:class}`a.b.C`"
    assert catalogue.in_markdown("see :func:`f`, ``x``", "m") == "see {py:func}`f <m.f>`, `x`"


def test_the_api_has_what_pages_link_to_and_snippets_import(catalogue):
    known = catalogue.api_modules()
    assert {
        "rise_envs",
        "rise_envs.noise",
        "rise_agents.rise",
        "benchmarks.stats",
        "rise_agents.resume",
    } <= set(known)
    assert known["rise_agents.rise"] == {"_fit_policy", "_fit_vae"}  # the map of the paper names them
    assert not any("__main__" in name or name.startswith("tests") for name in known)
    page = catalogue.module_page("rise_envs")
    assert row(page, "`make_noise`") == ["{py:obj}`make_noise <rise_envs.noise.make_noise>`"]


def test_pages_are_written_once_and_removed_when_they_are_none(catalogue, tmp_path, monkeypatch):
    pages = {"agents/a.md": "a\n", "b.md": "b\n"}
    for name in ("agents", "experts", "noise", "api", "beside"):
        monkeypatch.setattr(catalogue, name, dict)
    monkeypatch.setattr(catalogue, "environments", lambda: dict(pages))
    catalogue.write(tmp_path)
    then = (tmp_path / "b.md").stat().st_mtime_ns
    pages.pop("agents/a.md")
    catalogue.write(tmp_path)
    assert (tmp_path / "b.md").stat().st_mtime_ns == then  # else all pages would be built again
    assert [path.name for path in tmp_path.rglob("*.md")] == ["b.md"]


def test_results_are_on_the_site_once_there_are_some(tmp_path, monkeypatch):
    monkeypatch.setattr(sys, "path", list(sys.path))
    prepared = runpy.run_path(str(DOCS / "conf.py"))["only_what_is_there"]
    prepared.__globals__["HERE"] = tmp_path
    index = (DOCS / "index.md").read_text()
    before, after = [index], [index]
    prepared(None, "index", before)
    (tmp_path / "results").mkdir()
    (tmp_path / "results" / "README.md").write_text("# Results\n")
    prepared(None, "index", after)
    assert "results/README" not in before[0] and after == [index] and "\nresults/README\n" in index


# --- links, on a site of three pages ---------------------------------------------------------------------------

CONF = """
import runpy, sys
sys.path.insert(0, {docs!r})
import catalogue
catalogue.write = lambda folder: None  # of the pages that are made, none
globals().update(runpy.run_path({docs!r} + "/conf.py"))
exclude_patterns = []
"""
GOOD = """# Site

[`make_noise`](ROOT/rise_envs/noise.py), [`Part.name`](ROOT/rise_envs/noise.py), [the file](ROOT/rise_envs/noise.py),
[security](ROOT/SECURITY.md)

```{toctree}
api
reference/security
```
"""
API = """# API

```{eval-rst}
.. automodule:: rise_envs.noise
   :members:
   :ignore-module-all:
```
"""


def build(folder: Path, index: str) -> subprocess.CompletedProcess[str]:
    """A site of these pages, as ``make docs`` builds ours."""
    (folder / "reference").mkdir(exist_ok=True)
    (folder / "conf.py").write_text(CONF.format(docs=str(DOCS)))
    (folder / "api.md").write_text(API)
    (folder / "reference" / "security.md").write_text("# Security\n")
    (folder / "index.md").write_text(index.replace("ROOT", os.path.relpath(DOCS.parent, folder)))
    command = [sys.executable, "-m", "sphinx", "--fail-on-warning", "--keep-going", "--nitpicky", "--quiet"]
    return subprocess.run(
        [*command, str(folder), str(folder / "out")], capture_output=True, text=True, check=False
    )


def test_links_to_files_lead_to_pages_of_the_site(tmp_path):
    done = build(tmp_path, GOOD)
    assert (done.returncode, done.stderr) == (0, "")
    html = (tmp_path / "out" / "index.html").read_text()
    targets = [each.split("#") for each in re.findall(r'<a class="reference[^>]*href="([^"]*)"', html)]
    assert ["api.html", "rise_envs.noise.make_noise"] in targets
    assert ["api.html", "rise_envs.noise.Part"] in targets  # a field is told by what holds it
    assert ["api.html", "module-rise_envs.noise"] in targets
    assert ["reference/security.html"] in targets
    assert "_downloads" not in html
    stored = (tmp_path / "out" / ".doctrees" / "api.doctree").read_bytes()
    assert b"BuildEnvironment" not in stored  # which is large


def test_links_to_what_is_not_there_are_errors(tmp_path):
    bad = "\n[`no_such`](ROOT/rise_envs/noise.py) {py:func}`rise_envs.nothing` [page](nowhere.md)\n"
    done = build(tmp_path, GOOD + bad)
    assert done.returncode != 0
    assert all(name in done.stderr for name in ("rise_envs.noise.no_such", "rise_envs.nothing", "nowhere.md"))

"""What a wheel holds, and that it works where nothing else of the project is."""

import shutil
import subprocess
import sys
import venv
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGES = ("rise_envs", "rise_agents", "benchmarks")


def build(folder: Path) -> Path:
    """The wheel of a copy of the sources: a build leaves files beside them."""
    source = folder / "source"
    source.mkdir(parents=True)
    for name in PACKAGES:
        shutil.copytree(ROOT / name, source / name, ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, source)
    command = [sys.executable, "-m", "build", "--wheel", "--no-isolation", "--outdir", folder, source]
    subprocess.run([*map(str, command)], check=True, capture_output=True)
    [wheel] = folder.glob("*.whl")
    return wheel


def test_a_wheel_holds_all_that_the_packages_hold(tmp_path):
    with zipfile.ZipFile(build(tmp_path)) as file:
        held = {name for name in file.namelist() if ".dist-info/" not in name}
        entries = next(name for name in file.namelist() if name.endswith("entry_points.txt"))
        assert "rise-bench = benchmarks.cli:main" in file.read(entries).decode()
    there = {
        path.relative_to(ROOT).as_posix()
        for name in PACKAGES
        for path in (ROOT / name).rglob("*")
        if path.is_file() and "__pycache__" not in path.parts
    }
    assert held == there


@pytest.mark.slow
def test_in_an_empty_environment_it_installs_and_runs_the_benchmark(tmp_path, monkeypatch):
    wheel = build(tmp_path / "built")
    monkeypatch.delenv("PYTHONPATH", raising=False)  # else it may be the sources that run
    venv.create(tmp_path / "venv", with_pip=True)
    run = tmp_path / "venv" / "bin"
    pip = [run / "python", "-m", "pip", "install", "--quiet", "--disable-pip-version-check"]
    constraints = ["-c", ROOT / "constraints.txt"]
    for what in ("torch", wheel):  # torch first: the pinned one is the CPU build where there is one
        subprocess.run([*map(str, [*pip, *constraints, what])], check=True, cwd=tmp_path)
    arguments = [run / "rise-bench", "run", "--preset", "smoke", "--no-videos", "--out", "smoke"]
    subprocess.run([*map(str, arguments)], check=True, cwd=tmp_path)
    where = "import benchmarks, rise_agents, rise_envs; print(benchmarks.__file__)"
    said = subprocess.run(
        [run / "python", "-c", where], check=True, cwd=tmp_path, capture_output=True, text=True
    )
    assert said.stdout.startswith(str(tmp_path / "venv"))
    assert {"summary.csv", "episodes.parquet", "report.html"} <= {
        p.name for p in (tmp_path / "smoke").iterdir()
    }

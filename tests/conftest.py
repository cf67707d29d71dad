"""Settings of the whole test suite."""

from __future__ import annotations

import os
import sys
import tempfile
from collections.abc import Iterator
from typing import TYPE_CHECKING

import pytest
from hypothesis import settings

if TYPE_CHECKING:
    from rise_agents.demonstrations import Demonstrations

# A loaded machine must not fail a test, and a failure must come again in the next run.
settings.register_profile("suite", deadline=None, derandomize=True)
settings.load_profile("suite")

# Windows of the environments under test open on no screen; pygame's greeting would litter the output.
os.environ.setdefault("SDL_VIDEODRIVER", "dummy")
os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")


@pytest.fixture(autouse=True, scope="session")
def temporary_files() -> Iterator[None]:
    """What libraries and killed processes leave among temporary files goes with the tests.

    The folder's name is short, as names of sockets must be.
    """
    with (
        tempfile.TemporaryDirectory(prefix="rise-", ignore_cleanup_errors=True) as folder,
        pytest.MonkeyPatch.context() as patch,
    ):
        patch.setenv("TMPDIR", folder)
        patch.setattr(tempfile, "tempdir", None)
        yield


@pytest.fixture
def own_names(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """What a test registers and imports is gone after it."""
    import gymnasium as gym

    from rise_agents import AGENTS, plugins
    from rise_agents.experts import EXPERTS
    from rise_agents.filters import FILTERS
    from rise_envs import ENVS, NOISE_MODELS, STAND_INS

    registries: list[dict] = [ENVS, STAND_INS, AGENTS, EXPERTS, FILTERS, NOISE_MODELS, gym.registry]
    before = [(known, dict(known)) for known in [*registries, plugins._IMPORTED]]
    modules = set(sys.modules)
    monkeypatch.setattr(sys, "path", list(sys.path))
    yield
    for name in {module.__name__ for module in plugins._IMPORTED.values()} - modules:
        sys.modules.pop(name, None)
    for known, then in before:
        known.clear()
        known.update(then)


@pytest.fixture(scope="session")
def vehicle_demonstrations() -> Demonstrations:
    """Forty real episodes of the vehicle's barrier expert (a second's work)."""
    from rise_agents.demonstrations import generate

    return generate("RISE-GroundVehicle-v0", "cbf", 40)

"""Settings of the whole test suite."""

from __future__ import annotations

import os
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


@pytest.fixture(scope="session")
def vehicle_demonstrations() -> Demonstrations:
    """Forty real episodes of the vehicle's barrier expert (a second's work)."""
    from rise_agents.demonstrations import generate

    return generate("RISE-GroundVehicle-v0", "cbf", 40)

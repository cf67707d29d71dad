"""Settings of the whole test suite."""

from __future__ import annotations

import os

from hypothesis import settings

# A loaded machine must not fail a test, and a failure must come again in the next run.
settings.register_profile("suite", deadline=None, derandomize=True)
settings.load_profile("suite")

# Windows of the environments under test open on no screen; pygame's greeting would litter the output.
os.environ.setdefault("SDL_VIDEODRIVER", "dummy")
os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")

"""Demonstrations: an expert's safe and successful episodes, generated, checked, stored and loaded.

``python -m rise_agents.demonstrations --env RISE-GroundVehicle-v0 --expert mixture --episodes 10000 --out DIR``
"""

from rise_agents.demonstrations.dataset import CARD, DATA, DatasetError, Demonstrations, load
from rise_agents.demonstrations.recording import generate

__all__ = ["CARD", "DATA", "DatasetError", "Demonstrations", "generate", "load"]

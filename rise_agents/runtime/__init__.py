"""A fixed-rate control loop between a robot and a stream of readings: ``python -m rise_agents.runtime``.

:mod:`.loop` keeps time and order, :mod:`.watchdog` decides when to stop and holds actions to their limits,
:mod:`.robots` and :mod:`.streams` say what a robot and a stream of readings are, :mod:`.udp` receives readings from
another process (``python -m rise_agents.runtime.send`` sends them), :mod:`.log` keeps what happened
(``python -m rise_agents.runtime.replay`` plays it).
"""

from rise_agents.runtime.loop import ControlLoop, Monotonic
from rise_agents.runtime.robots import EnvRobot, Observed, Robot
from rise_agents.runtime.streams import Reading, ReadingStream
from rise_agents.runtime.watchdog import Limits, Rules

__all__ = [
    "ControlLoop",
    "EnvRobot",
    "Limits",
    "Monotonic",
    "Observed",
    "Reading",
    "ReadingStream",
    "Robot",
    "Rules",
]

"""A look at one configured loop over its bus: whether it answers, and in what state it is. Nothing is written."""

from __future__ import annotations

from dataclasses import dataclass

from loopwright.protocol.station import Station
from loopwright.service.inputs.config import LoopConfig
from loopwright.service.loops.bus_connection import BusConnection
from loopwright.service.states.loop_state import LoopState
from loopwright.tuning.reasons import Ended


@dataclass(frozen=True, slots=True)
class LoopCheck:
    """What was found of a loop.

    state: its present state; None where it could not be read.
    problem: why it could not be read, and what to do.
    """

    state: LoopState | None
    problem: str | None


def check_loop(config: LoopConfig, station: Station) -> LoopCheck:
    """Reads a loop as a test would before it begins: both nodes, their versions and sample times, and the channel."""
    connection = BusConnection(config.bus, config.controller_node, config.plant_node, config.channel, station)
    try:
        with connection.tuner() as tuner:
            reading = connection.reading(tuner)
            reading.identify()
            reading.compare_times()
            return LoopCheck(reading.state(), None)
    except Ended as ended:
        return LoopCheck(None, f"{ended.detail}. {ended.advice}")
    finally:
        connection.close()

"""Calls of a database that may be unreachable for some time."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

from sqlalchemy.exc import SQLAlchemyError

from loopwright.service.jobs.journal import temporary
from loopwright.service.jobs.machine import Machine
from loopwright.service.jobs.registry import Registry

T = TypeVar("T")

STOP_PATIENCE_S = 20.0
"""Wall time for which a call is repeated while the service stops, s."""
_AGAIN_S = 0.5


class DatabaseRetries:
    """Repeats a call of the database until it answers; while the service stops, only for STOP_PATIENCE_S."""

    def __init__(self, machine: Machine, registry: Registry) -> None:
        self._machine = machine
        self._registry = registry

    def __call__(self, ask: Callable[[], T]) -> T:
        since = self._machine.monotonic()
        while True:
            try:
                return ask()
            except SQLAlchemyError as error:
                stopping = self._registry.stopping
                if not temporary(error) or (stopping and self._machine.monotonic() - since > STOP_PATIENCE_S):
                    raise
                self._machine.sleep(_AGAIN_S)

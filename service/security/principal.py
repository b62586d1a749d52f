"""Who is asking, for the whole of a request: set at the door, read where a change is written down."""

from __future__ import annotations

from contextvars import ContextVar
from dataclasses import dataclass

from loopwright.service.security.keys import Scope


@dataclass(frozen=True)
class Principal:
    """name: the key's, or what stands for callers without one.  address: of the network, where there is one."""

    name: str
    scope: Scope
    key_id: str | None = None
    address: str | None = None


SERVICE = Principal("service", Scope.ADMIN)
"""What the service does by itself, and what is done in its threads."""
LOCAL = "local"
"""Name of callers on this machine where no keys are asked for."""

current: ContextVar[Principal] = ContextVar("principal", default=SERVICE)

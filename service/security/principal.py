"""The caller of a request: set when the request arrives, read where a change is stored."""

from __future__ import annotations

from contextvars import ContextVar
from dataclasses import dataclass

from loopwright.service.security.keys import Scope


@dataclass(frozen=True)
class Principal:
    """A caller.

    name: the name of the key, or a general name for callers without one.
    address: the network address, where there is one.
    session: id of the browser's session, where the caller has signed in.
    gateway: name of the gateway at which it asks, where several share a database.
    """

    name: str
    scope: Scope
    key_id: str | None = None
    address: str | None = None
    session: str | None = None
    gateway: str | None = None


SERVICE = Principal("service", Scope.ADMIN)
"""The principal of actions of the service itself and of its threads."""
LOCAL = "local"
"""The name of callers on this machine where no keys are required."""

current: ContextVar[Principal] = ContextVar("principal", default=SERVICE)


def signed(name: str | None) -> str:
    """The name under which a change is noted: the person's as given, else that of the caller's key."""
    return (name or "").strip() or current.get().name

"""A computation that somebody waits for at the other end of a connection: it ends when that one goes away."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Callable
from typing import Any

from fastapi import Request

from loopwright.service.errors import Stopping
from loopwright.service.execution.computing.limits import ComputationKind
from loopwright.service.execution.computing.pool import NotWanted, Pool

Work = Callable[[], dict[str, Any]]


async def computed(pool: Pool, work: Work, http: Request, stopping: Callable[[], bool]) -> dict[str, Any]:
    """The result of the work, in a process of its own. Raises what it raises, NotWanted when the client is gone, and
    Stopping."""
    gone = threading.Event()
    listening = asyncio.create_task(_until_gone(http, gone))
    try:
        future = pool.submit(ComputationKind.TUNING, work, lambda: gone.is_set() or stopping())
        found: dict[str, Any] = await asyncio.wrap_future(future)
    except NotWanted:
        if gone.is_set():
            raise
        raise Stopping("the service is shutting down") from None
    finally:
        gone.set()
        listening.cancel()
    return found


async def _until_gone(http: Request, gone: threading.Event) -> None:
    while (await http.receive())["type"] != "http.disconnect":
        pass
    gone.set()

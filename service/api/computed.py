"""Computations for a client that waits for the answer; they are cancelled when the client disconnects."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Callable
from typing import TypeVar

from fastapi import Request

from loopwright.service.errors import Stopping
from loopwright.service.execution.computing.limits import ComputationKind
from loopwright.service.execution.computing.pool import NotWanted, Pool

T = TypeVar("T")


async def computed(pool: Pool, work: Callable[[], T], http: Request, stopping: Callable[[], bool]) -> T:
    """The result of the work, which runs in a process of the pool.

    Raises what the work raises, NotWanted when the client has disconnected, Stopping when the service shuts down.
    """
    gone = threading.Event()
    listening = asyncio.create_task(_until_gone(http, gone))
    try:
        future = pool.submit(ComputationKind.TUNING, work, lambda: gone.is_set() or stopping())
        found: T = await asyncio.wrap_future(future)
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

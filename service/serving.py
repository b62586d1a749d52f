"""The live service put together: configuration, store, jobs on the bus, HTTP server."""

from __future__ import annotations

import logging
import socket
from pathlib import Path
from types import FrameType

import uvicorn

from service.api.app import create_app
from service.config import LoopConfig, load_loops
from service.jobs import Jobs
from service.loop import Loop
from service.store.store import Store
from service.work import rehearse, tune

_GRACE_S = 10


class _Server(uvicorn.Server):
    """Tells the jobs at once when a signal asks the server to end: open event streams end with their jobs, and the
    server, which waits for its connections, does not wait for nothing."""

    def __init__(self, config: uvicorn.Config, jobs: Jobs) -> None:
        super().__init__(config)
        self._jobs = jobs

    def handle_exit(self, sig: int, frame: FrameType | None) -> None:
        self._jobs.request_stop()
        super().handle_exit(sig, frame)

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        await super().startup(sockets)
        if self.started and sockets:
            host, port = sockets[0].getsockname()[:2]
            print(f"ready http://{host}:{port}", flush=True)


def open_bus_loop(config: LoopConfig) -> Loop:
    """The live loop of a configuration."""
    from service.bus_loop import BusLoop

    return BusLoop(config.bus, config.controller_node, config.plant_node, channel=config.channel)


def serve(loops_file: Path, data: Path, host: str, port: int) -> None:
    """Serves until SIGTERM or SIGINT; every loop is restored before it returns.

    Raises ConfigError, FolderInUse, OSError (the address cannot be had).
    """
    # python-can's socketcand client warns of every frame that TCP splits, which is what TCP does.
    logging.getLogger("can").setLevel(logging.ERROR)
    loops = load_loops(loops_file)
    # Bound before anything is started, so that a busy port is an error and not half a service.
    listener = socket.create_server((host, port), reuse_port=False)
    store = Store(data)
    jobs = Jobs(loops, store, open_bus_loop, tune, rehearse)
    config = uvicorn.Config(create_app(jobs), log_level="warning", timeout_graceful_shutdown=_GRACE_S)
    try:
        _Server(config, jobs).run(sockets=[listener])
    finally:
        jobs.stop()
        store.close()
        listener.close()

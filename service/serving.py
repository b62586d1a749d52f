"""The live service put together: configuration, store, jobs on the bus, HTTP server."""

from __future__ import annotations

import logging
import socket
from dataclasses import dataclass
from pathlib import Path
from types import FrameType

import uvicorn

from service.api.app import create_app
from service.config import LoopConfig, load_site
from service.engine.durable import POLL_S, DurableEngine
from service.jobs import Jobs, LoopFactory
from service.loop import Loop
from service.store.database import BadDatabase
from service.store.store import LOCAL, Store
from service.work import Tune, rehearse, tune

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


@dataclass(frozen=True)
class Setup:
    """How the service is run. database: a PostgreSQL URL, or None for a file in the data folder.

    bind: the address to listen on.  host: this host's name among those that share the database.
    resume: jobs that a dead service left go on.  poll_s: how often the engine looks for jobs, s of wall time.
    """

    loops_file: Path
    data: Path
    bind: str
    port: int
    database: str | None = None
    host: str | None = None
    resume: bool = True
    poll_s: float = POLL_S


def serve(setup: Setup, open_loop: LoopFactory = open_bus_loop, tune: Tune = tune) -> None:
    """Serves until SIGTERM or SIGINT; every loop is restored before it returns.

    Raises ConfigError, FolderInUse, ForeignLoop, BadDatabase, OSError (the address cannot be had), SQLAlchemyError (the
    database cannot be reached).
    """
    # python-can's socketcand client warns of every frame that TCP splits, which is what TCP does.
    logging.getLogger("can").setLevel(logging.ERROR)
    site = load_site(setup.loops_file)
    if setup.database is not None and setup.host is None:
        raise BadDatabase("a shared database needs --host NAME: what this host is called among the others, for ever")
    # Bound before anything is started, so that a busy port is an error and not half a service.
    with socket.create_server((setup.bind, setup.port), reuse_port=False) as listener:
        store = Store(setup.data, setup.database, setup.host or LOCAL)
        try:
            engine = DurableEngine(setup.data, store.engine if store.shared else None, store.host, setup.poll_s)
            jobs = Jobs(
                site.loops, store, open_loop, tune, rehearse, engine=engine, buses=site.buses, resume=setup.resume
            )
            config = uvicorn.Config(create_app(jobs), log_level="warning", timeout_graceful_shutdown=_GRACE_S)
            try:
                jobs.boot()
                _Server(config, jobs).run(sockets=[listener])
            finally:
                jobs.stop()
        finally:
            store.close()

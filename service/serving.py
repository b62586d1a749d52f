"""The live service put together: configuration, store, jobs on the bus, HTTP server."""

from __future__ import annotations

import logging
import socket
from pathlib import Path
from types import FrameType

import uvicorn

from service import logs
from service.api.app import create_app
from service.config import LoopConfig, load_loops
from service.jobs import Jobs
from service.logs import LogFormat
from service.loop import Loop
from service.security.gate import Policy, is_loopback
from service.security.keyring import Keyring
from service.security.limits import RequestLimits
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
            print(f"ready http://{f'[{host}]' if ':' in host else host}:{port}", flush=True)


def open_bus_loop(config: LoopConfig) -> Loop:
    """The live loop of a configuration."""
    from service.bus_loop import BusLoop

    return BusLoop(config.bus, config.controller_node, config.plant_node, channel=config.channel)


class NotSafe(Exception):
    """What was asked for would open the plant to the network; the text says what to do instead."""


def serve(
    loops_file: Path,
    data: Path,
    bind: str,
    port: int,
    *,
    auth: bool | None = None,
    limits: RequestLimits | None = None,
    log_format: LogFormat = "text",
) -> None:
    """Serves until SIGTERM or SIGINT; every loop is restored before it returns.

    auth None: keys are asked for unless the address is this machine's own.
    Raises ConfigError, FolderInUse, NotSafe, OSError (the address cannot be had).
    """
    logs.configure(log_format)
    # python-can's socketcand client warns of every frame that TCP splits, which is what TCP does.
    logging.getLogger("can").setLevel(logging.ERROR)
    local = is_loopback(bind)
    if auth is False and not local:
        raise NotSafe(f"without keys only this machine is served: leave out --no-auth, or --bind {bind}")
    loops = load_loops(loops_file)
    # Bound before anything is started, so that a busy port is an error and not half a service.
    listener = socket.create_server((bind, port), family=_family(bind), reuse_port=False)
    try:
        store = Store(data)
    except BaseException:
        listener.close()
        raise
    jobs: Jobs | None = None
    try:
        keyring = Keyring(store.engine) if auth or not local else None
        if keyring is not None and not keyring.any_valid():
            raise NotSafe(
                f"keys are asked for on {bind} and there is none; make one with: "
                f"loopwright key create NAME --scope admin --data {data}"
            )
        policy = Policy(keyring, limits or RequestLimits(), local_only=True)
        jobs = Jobs(loops, store, open_bus_loop, tune, rehearse)
        config = uvicorn.Config(
            create_app(jobs, policy),
            log_config=None,
            log_level="warning",
            access_log=False,
            server_header=False,
            timeout_graceful_shutdown=_GRACE_S,
        )
        _Server(config, jobs).run(sockets=[listener])
    finally:
        if jobs is not None:
            jobs.stop()
        store.close()
        listener.close()


def _family(bind: str) -> socket.AddressFamily:
    return socket.AF_INET6 if ":" in bind else socket.AF_INET

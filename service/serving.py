"""The live service put together: configuration, store, jobs on the bus, HTTP server."""

from __future__ import annotations

import asyncio
import logging
import os
import signal
import socket
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import BrokenExecutor
from contextlib import ExitStack, closing, suppress
from dataclasses import dataclass, field
from functools import partial
from ipaddress import IPv4Network, IPv6Network, ip_address
from pathlib import Path
from types import FrameType
from typing import Any, Self, cast

import uvicorn
from fastapi import FastAPI

from protocol.profile import TUNER_NODE
from protocol.station import Station
from service import logs
from service.api.app import create_app
from service.api.connections import Connection, Connections, Listener, OnceAMinute, raise_descriptor_limit
from service.computing import Workers
from service.config import LoopConfig, load_site
from service.engine.durable import POLL_S, DurableEngine
from service.jobs import Jobs, LoopFactory
from service.logs import LogFormat
from service.loop import Loop
from service.retention import Keep, Retention
from service.security.gate import Policy, is_loopback
from service.security.keyring import Keyring
from service.security.limits import RequestLimits
from service.store.database import BadDatabase
from service.store.store import LOCAL, Store
from service.work import Tune, rehearse
from service.work import tune as live

_GRACE_S = 10
_ONCE_A_MINUTE = OnceAMinute()
_log = logging.getLogger(__name__)


class _Server(uvicorn.Server):
    """Tells the jobs at once when a signal asks the server to end: open event streams end with their jobs, and the
    server, which waits for its connections, does not wait for nothing."""

    def __init__(self, config: uvicorn.Config, jobs: Jobs) -> None:
        super().__init__(config)
        self._jobs = jobs

    async def serve(self, sockets: list[socket.socket] | None = None) -> None:
        with self.capture_signals():
            # One that came before they are captured here has told the jobs only.
            self.should_exit = self.should_exit or self._jobs.stopping
            await self._serve(sockets)

    def handle_exit(self, sig: int, frame: FrameType | None) -> None:
        tell_systemd("STOPPING=1")
        self._jobs.request_stop()
        super().handle_exit(sig, frame)

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        await super().startup(sockets)
        if self.started and sockets:
            host, port = sockets[0].getsockname()[:2]
            print(f"ready http://{f'[{host}]' if ':' in host else host}:{port}", flush=True)
            tell_systemd("READY=1")


def tell_systemd(state: str) -> None:
    """sd_notify: says where we are to a unit of Type=notify; nothing where there is none."""
    address = os.environ.get("NOTIFY_SOCKET")
    if address:
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as notify, suppress(OSError):
            notify.sendto(state.encode(), "\0" + address[1:] if address.startswith("@") else address)


def open_bus_loop(station: Station, config: LoopConfig) -> Loop:
    """The live loop of a configuration."""
    from service.bus_loop import BusLoop

    return BusLoop(
        config.bus,
        config.controller_node,
        config.plant_node,
        channel=config.channel,
        station=station,
        pv_limits=(config.pv_limits.low, config.pv_limits.high),
    )


class Signals:
    """SIGTERM and SIGINT from the start of the service to its end: whoever is told of them first is told at once.

    While requests are served the server hears them itself, and says them again when it is through.
    """

    def __init__(self) -> None:
        self._asked = False
        self._end: Callable[[], None] = lambda: None

    def __enter__(self) -> Self:
        self._before: dict[int, Any] = {}
        if threading.current_thread() is threading.main_thread():
            self._before = {each: signal.signal(each, self._hear) for each in (signal.SIGTERM, signal.SIGINT)}
        return self

    def __exit__(self, *_: object) -> None:
        for each, handler in self._before.items():
            signal.signal(each, handler)

    def tell(self, end: Callable[[], None]) -> None:
        """Calls `end` when a signal comes, or has come."""
        self._end = end
        if self._asked:
            end()

    def _hear(self, _signal: int, _frame: FrameType | None) -> None:
        self._asked = True
        self._end()


class NotSafe(Exception):
    """What was asked for would open the plant to the network; the text says what to do instead."""


@dataclass(frozen=True)
class Setup:
    """How the service is run. database: a PostgreSQL URL, or None for a file in the data folder.

    bind: the address to listen on.  host: this host's name among those that share the database.
    resume: jobs that a dead service left go on.  poll_s: how often the engine looks for jobs, s of wall time.
    keep: whose samples are kept.
    node: our node-ID on every bus, another one than any other gateway's.
    auth: whether keys are asked for; None: unless the address is this machine's own.
    trusted_proxies: addresses and networks whose word on whom they ask for is taken (X-Forwarded-For, -Proto).
    """

    loops_file: Path
    data: Path
    bind: str
    port: int
    database: str | None = None
    host: str | None = None
    resume: bool = True
    poll_s: float = POLL_S
    node: int = TUNER_NODE
    auth: bool | None = None
    limits: RequestLimits = field(default_factory=RequestLimits)
    log_format: LogFormat = "text"
    keep: Keep = field(default_factory=Keep)
    trusted_proxies: tuple[IPv4Network | IPv6Network, ...] = ()


def serve(setup: Setup, open_loop: LoopFactory | None = None, tune: Tune | None = None) -> None:
    """Serves until SIGTERM or SIGINT; every loop is restored before it returns. tune: by default with workers.

    Raises ConfigError, FolderInUse, ForeignLoop, BadDatabase, NotSafe, OSError (the address cannot be had),
    SQLAlchemyError (the database cannot be reached).
    """
    logs.configure(setup.log_format)
    # python-can's socketcand client warns of every frame that TCP splits, which is what TCP does.
    logging.getLogger("can").setLevel(logging.ERROR)
    site = load_site(setup.loops_file)
    site.check_own_node(setup.node, str(setup.loops_file))
    if setup.database is not None and setup.host is None:
        raise BadDatabase("a shared database needs --host NAME: what this host is called among the others, for ever")
    local = is_loopback(setup.bind)
    if setup.auth is False and not local:
        raise NotSafe(f"without keys only this machine is served: leave out --no-auth, or --bind {setup.bind}")
    descriptors = raise_descriptor_limit()
    with ExitStack() as stack:
        if tune is None:  # forked before there is anything that a child should not have
            tune = partial(live, workers=_workers(stack))
        signals = stack.enter_context(Signals())
        # Bound before anything is started, so that a busy port is an error and not half a service.
        listener = stack.enter_context(listen(setup.bind, setup.port))
        store = Store(setup.data, setup.database, setup.host or LOCAL)
        try:
            keyring = Keyring(store.engine) if setup.auth or not local else None
            if keyring is not None and not keyring.any_valid():
                where = f"--data {setup.data}" if setup.database is None else "with LOOPWRIGHT_DATABASE set"
                raise NotSafe(
                    f"keys are asked for on {setup.bind} and there is none; make one with: "
                    f"loopwright key create NAME --scope admin {where}"
                )
            policy = Policy(keyring, setup.limits, local_only=True)
            engine = DurableEngine(setup.data, store.engine if store.shared else None, store.host, setup.poll_s)
            jobs = Jobs(
                site.loops,
                store,
                open_loop or partial(open_bus_loop, Station(setup.node)),
                tune,
                rehearse,
                engine=engine,
                buses=site.buses,
                resume=setup.resume,
            )
            config = server_config(create_app(jobs, policy), setup, listener, descriptors)
            retention = Retention(store, engine, setup.keep)
            signals.tell(jobs.request_stop)
            try:
                jobs.boot()
                if not jobs.stopping:
                    retention.start()
                    _Server(config, jobs).run(sockets=[listener])
            finally:
                retention.close()
                jobs.stop()
        finally:
            store.close()


def server_config(app: FastAPI, setup: Setup, listener: Listener, descriptors: int) -> uvicorn.Config:
    """The HTTP server: whose word it takes on whom it serves, and how many connections of which kind it keeps.

    descriptors: file descriptors of this process.
    """
    logging.getLogger("uvicorn.error").addFilter(_ONCE_A_MINUTE)
    connections = Connections(setup.limits, descriptors, partial(_is_of, setup.trusted_proxies))
    listener.wanted = connections.wanted
    return uvicorn.Config(
        app,
        loop="asyncio",
        http=cast(type[asyncio.Protocol], partial(Connection, connections)),
        ws="none",
        log_config=None,
        log_level="warning",
        access_log=False,
        server_header=False,
        proxy_headers=bool(setup.trusted_proxies),
        forwarded_allow_ips=[str(network) for network in setup.trusted_proxies],
        timeout_graceful_shutdown=_GRACE_S,
    )


def _is_of(networks: Sequence[IPv4Network | IPv6Network], address: str) -> bool:
    if not networks:
        return False
    try:
        found = ip_address(address)
    except ValueError:
        return False
    return any(found in network for network in networks)


def _workers(stack: ExitStack) -> Workers | None:
    """None where this machine has no room for them."""
    try:
        return stack.enter_context(closing(Workers()))
    except (OSError, BrokenExecutor) as error:
        _log.warning("no processes for long computations, the service does them itself: %s", error)
        return None


def listen(bind: str, port: int) -> Listener:
    """The listening socket. Raises OSError."""
    family = socket.AF_INET6 if ":" in bind else socket.AF_INET
    listener = Listener(socket.create_server((bind, port), family=family, reuse_port=False).detach())
    # asyncio sets it only where a socket names its protocol; without it an answer waits 40 ms for the client's ACK.
    listener.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    # The kernel hands a connection over with what its client says, or after a second in silence: those that say nothing
    # can be told from those that are about to.
    listener.setsockopt(socket.IPPROTO_TCP, socket.TCP_DEFER_ACCEPT, 1)
    return listener

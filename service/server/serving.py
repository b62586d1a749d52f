"""The live service: configuration, store, jobs on the bus, and HTTP server together."""

from __future__ import annotations

import asyncio
import gc
import logging
import os
import socket
import threading
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager, suppress
from dataclasses import dataclass, field
from functools import partial
from importlib import import_module
from ipaddress import IPv4Network, IPv6Network, ip_address
from pathlib import Path
from typing import cast

import uvicorn
from fastapi import FastAPI

from loopwright.protocol.profile import TUNER_NODE
from loopwright.protocol.station import Station
from loopwright.service.alarms.watch import AlarmWatch
from loopwright.service.api import operations
from loopwright.service.api.app import create_app
from loopwright.service.api.gate.connections import (
    Connection,
    Connections,
    Listener,
    OnceAMinute,
    raise_descriptor_limit,
)
from loopwright.service.api.gate.gate import Policy, is_loopback
from loopwright.service.api.gate.limits import RequestLimits
from loopwright.service.api.services import Services
from loopwright.service.execution.computing.limits import ComputationKind, ComputingLimits
from loopwright.service.execution.computing.pool import Pool
from loopwright.service.execution.procedures import Tune, rehearse
from loopwright.service.execution.procedures import tune as live
from loopwright.service.execution.rehearsals import rehearsed_in_pool
from loopwright.service.inputs.config import LoopConfig, load_site
from loopwright.service.jobs.dbos_engine import POLL_S, DurableEngine
from loopwright.service.jobs.history_observer import HistoryObserver
from loopwright.service.jobs.kept_figures import KeptFigures
from loopwright.service.jobs.loop_directory import LoopFactory
from loopwright.service.jobs.manager import Jobs
from loopwright.service.jobs.retention import Retention, RetentionPolicy
from loopwright.service.jobs.watching import Watching
from loopwright.service.listening.listening import Listening
from loopwright.service.live.live import Live
from loopwright.service.live.other_gateways import OtherGateways
from loopwright.service.live.own_gateway import Announcing, OwnGateway
from loopwright.service.live.webhooks.webhooks import Webhooks
from loopwright.service.loops.loop import Loop
from loopwright.service.server.arenas import limit_arenas
from loopwright.service.server.assembly import make_jobs
from loopwright.service.server.signals import Signals
from loopwright.service.server.watchdog import Watchdog, interval_s
from loopwright.service.store.database import BadDatabase
from loopwright.service.store.keyring import Keyring
from loopwright.service.store.store import LOCAL, Store
from loopwright.service.telemetry import logs
from loopwright.service.telemetry.logs import LogFormat

_GRACE_S = 10
"""Wall time from the stop until requests that are not answered yet are cancelled, s."""
STREAMS_GRACE_S = 8.0
"""Wall time from the stop until the streams of jobs that have not ended are, s: before they would be cancelled."""
_ONCE_A_MINUTE = OnceAMinute()
_log = logging.getLogger(__name__)


class _Server(uvicorn.Server):
    """An HTTP server that prints when it is ready. It does not handle signals: uvicorn would raise each signal again
    after its shutdown, and take a second SIGINT as permission to abort."""

    def __init__(
        self,
        config: uvicorn.Config,
        jobs: Jobs,
        listening: Listening,
        live: Live,
        alarms: AlarmWatch,
        streams_over: threading.Event,
    ) -> None:
        super().__init__(config)
        self._streams_over = streams_over
        self._jobs = jobs
        self._listening = listening
        self._live = live
        self._alarms = alarms

    @contextmanager
    def capture_signals(self) -> Iterator[None]:
        yield

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        self._live.close()  # nothing else ends these streams, and the server waits for its connections
        asyncio.get_running_loop().call_later(STREAMS_GRACE_S, self._streams_over.set)
        await super().shutdown(sockets)

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        await super().startup(sockets)
        if self.started and sockets:
            host, port = sockets[0].getsockname()[:2]
            print(f"ready http://{f'[{host}]' if ':' in host else host}:{port}", flush=True)
            tell_systemd("READY=1")
            self._listening.start()
            self._alarms.start()
            if (every_s := interval_s()) is not None:
                watchdog = Watchdog(self._jobs.unwatched_s, self._jobs.store.ping, tell_systemd)
                self._watchdog = asyncio.create_task(watchdog.run(every_s))


def tell_systemd(state: str) -> None:
    """Reports a state to systemd by sd_notify, for a unit of Type=notify; does nothing without one."""
    address = os.environ.get("NOTIFY_SOCKET")
    if address:
        with suppress(OSError), socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as notify:
            notify.sendto(state.encode(), "\0" + address[1:] if address.startswith("@") else address)


_OF_JOBS = (
    "encodings.idna",  # the first look-up of a host name
    "multiprocessing.popen_forkserver",
    "loopwright.service.execution.beside",
    "loopwright.service.execution.checkpoints",
    "loopwright.service.execution.guard",
    "loopwright.service.execution.result",
    "loopwright.service.execution.runner",
    "loopwright.service.loops.bus_loop",
    "loopwright.tuning.fast.known_plant.design_trial",
    "loopwright.tuning.fast.excitation_choice",
    "loopwright.tuning.fast.pulses.procedure",
    "loopwright.tuning.five_stage.procedure",
)
"""What is imported where it is used, and used by jobs."""


def load() -> None:
    """Imports all modules that jobs need and runs a full garbage collection beforehand: done in a job, either would
    block all threads and delay the loops of the others (by seconds, and by 0.1 s of processor time each)."""
    for name in _OF_JOBS:
        import_module(name)
    gc.collect()
    gc.freeze()


def open_bus_loop(station: Station, config: LoopConfig) -> Loop:
    """Returns the live loop of a configuration."""
    from loopwright.service.loops.bus_loop import BusLoop

    return BusLoop(
        config.bus,
        config.controller_node,
        config.plant_node,
        channel=config.channel,
        station=station,
        pv_limits=(config.pv_limits.low, config.pv_limits.high),
    )


class NotSafe(Exception):
    """Raised when the options would open the plant to the network; the text says what to do instead."""


@dataclass(frozen=True)
class Setup:
    """The options of the service.

    bind: the address to listen on.
    database: a PostgreSQL URL, or None for a file in the data folder.
    host: this host's name among those that share the database.
    resume: whether jobs of a dead service are resumed.
    poll_s: wall time between two queries of the engine for jobs, s.
    node: this service's node-ID on every bus, different from every other gateway's.
    auth: whether keys are required; None: unless the address is this machine's own.
    keep: which samples are kept.
    computing: the limits of one computation.
    trusted_proxies: addresses and networks whose X-Forwarded-For and -Proto headers are trusted.
    listen: whether the process data of the loops are heard and kept as history.
    url: where browsers reach this service, for the pages of the gateways that share its database.
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
    keep: RetentionPolicy = field(default_factory=RetentionPolicy)
    computing: ComputingLimits = field(default_factory=ComputingLimits)
    trusted_proxies: tuple[IPv4Network | IPv6Network, ...] = ()
    listen: bool = True
    url: str | None = None


def serve(setup: Setup, open_loop: LoopFactory | None = None, tune: Tune | None = None) -> None:
    """Serves until SIGTERM or SIGINT; every loop is restored before it returns.

    tune: runs the procedure on a loop; by default it computes in a pool.
    Raises ConfigError, BadSecret, FolderInUse, ForeignLoop, BadDatabase, NotSafe, OSError (the address cannot be used),
    SQLAlchemyError (the database cannot be reached).
    """
    limit_arenas()
    logs.configure(setup.log_format)
    site = load_site(setup.loops_file)
    site.check_own_node(setup.node, str(setup.loops_file))
    if setup.database is not None and setup.host is None:
        raise BadDatabase(
            "a shared database needs --gateway NAME: what this gateway is called among the others, for ever"
        )
    local = is_loopback(setup.bind)
    if setup.auth is False and not local:
        raise NotSafe(f"without keys only this machine is served: leave out --no-auth, or --bind {setup.bind}")
    descriptors = raise_descriptor_limit()
    with ExitStack() as stack:
        signals = stack.enter_context(Signals())
        # Bound before anything is started or opened: a port in use then gives one sentence, not a half-started service.
        listener = stack.enter_context(listen(setup.bind, setup.port))
        pool = stack.enter_context(closing(Pool(setup.computing)))
        store = stack.enter_context(closing(Store(setup.data, setup.database, setup.host or LOCAL)))
        webhooks = Webhooks(site.webhooks, setup.loops_file.parent, store, setup.url)
        keyring = Keyring(store.engine) if setup.auth or not local else None
        if keyring is not None and not keyring.any_valid():
            where = f"--data {setup.data}" if setup.database is None else "with LOOPWRIGHT_DATABASE set"
            raise NotSafe(
                f"keys are asked for on {setup.bind} and there is none; make one with: "
                f"loopwright key create NAME --scope admin {where}"
            )
        if tune is None:
            # Loads the fork server, so that the first computation of a loop does not wait. Data folder and keys come
            # first, because a start that is refused would wait for the fork server to end.
            pool.submit(ComputationKind.LIVE, os.getpid)
        policy = Policy(keyring, setup.limits, local_only=True)
        engine = DurableEngine(setup.data, store.engine if store.shared else None, store.host, setup.poll_s)
        station = Station(setup.node)
        figures = stack.enter_context(closing(KeptFigures(store, pool)))
        jobs = make_jobs(
            site.loops,
            store,
            open_loop or partial(open_bus_loop, station),
            tune or partial(live, workers=pool),
            rehearsed_in_pool(rehearse, pool),
            engine=engine,
            buses=site.buses,
            resume=setup.resume,
            ended=figures.ended,
        )
        stack.enter_context(closing(webhooks))
        stack.callback(jobs.stop)
        retention = stack.enter_context(closing(Retention(store, engine, setup.keep)))
        checks = {**operations.checks(jobs), "samples": retention.note}
        listening = Listening(site.loops, store, jobs.directory.in_effect, site.buses, setup.listen)
        stack.callback(listening.close)
        jobs.operation.connect(listening, pool)
        looking = stack.enter_context(
            closing(HistoryObserver(jobs.directory, jobs.registry, store, listening, jobs.knowledge, pool))
        )
        watching = stack.enter_context(closing(Watching(store, jobs.directory, jobs.decisions, listening, pool)))
        others = OtherGateways(store)
        alarms = stack.enter_context(closing(AlarmWatch(jobs, listening, others)))
        own = OwnGateway(jobs, listening, setup.url, alarms)
        announcing = stack.enter_context(closing(Announcing(jobs, own)))
        live_stream = Live(jobs, listening, alarms, others)
        streams_over = threading.Event()
        app = create_app(
            Services(
                jobs=jobs,
                policy=policy,
                checks=checks,
                pool=pool,
                sdo_retries=station.sdo_retries,
                listening=listening,
                live=live_stream,
                figures=figures,
                alarms=alarms,
                own=own,
                others=others,
                streams_over=streams_over.is_set,
            )
        )
        config = server_config(app, setup, listener, descriptors)
        server = _Server(config, jobs, listening, live_stream, alarms, streams_over)

        def end() -> None:
            """Ends jobs and server: the server waits for its connections, and event streams end with their jobs."""
            jobs.request_stop()
            figures.request_stop()  # else the server would cancel requests that wait for them, and log each as an error
            server.should_exit = True
            tell_systemd("STOPPING=1")

        signals.tell(end, partial(_awaited, jobs))
        load()
        jobs.boot()
        if not jobs.stopping:
            retention.start()
            announcing.start()
            watching.start()
            webhooks.start()
            if setup.listen:
                looking.start()
            server.run(sockets=[listener])


def _awaited(jobs: Jobs) -> str:
    """Returns what the end of the service waits for, in words."""
    under_test = [f"{tag} (job {job_id})" for job_id, tag in jobs.under_test().items()]
    if not under_test:
        return "no loop is under test, connections and the database are being closed"
    return f"it waits until these loops are restored and the ends of their jobs written: {', '.join(under_test)}"


def server_config(app: FastAPI, setup: Setup, listener: Listener, descriptors: int) -> uvicorn.Config:
    """Returns the configuration of the HTTP server: the proxies it trusts, and its limits of connections by kind.

    descriptors: number of file descriptors of this process.
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
        parsed = ip_address(address)
    except ValueError:
        return False
    return any(parsed in network for network in networks)


def listen(bind: str, port: int) -> Listener:
    """Returns the listening socket. Raises OSError."""
    family = socket.AF_INET6 if ":" in bind else socket.AF_INET
    listener = Listener(socket.create_server((bind, port), family=family, reuse_port=False).detach())
    # asyncio sets this only for a socket with a protocol; otherwise an answer waits 40 ms for the client's ACK.
    listener.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    # The kernel passes a connection on with the client's first data, or after a second of silence, so that silent
    # connections can be distinguished from those that are about to send.
    listener.setsockopt(socket.IPPROTO_TCP, socket.TCP_DEFER_ACCEPT, 1)
    return listener

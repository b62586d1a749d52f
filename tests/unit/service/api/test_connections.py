from __future__ import annotations

import asyncio
import logging
import os
import resource
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import AsyncExitStack, ExitStack, closing
from ipaddress import ip_network
from typing import Any

import pytest

from loopwright.service.api.gate import key_checks
from loopwright.service.api.gate.concurrency import Full, Places, RequestKind, Room, kind_of
from loopwright.service.api.gate.connections import Connections, OnceAMinute, WarningOnceAMinute
from loopwright.service.api.gate.gate import Policy
from loopwright.service.api.gate.limits import RequestLimits
from loopwright.service.loops.loop import Loop
from loopwright.service.security.keys import Scope, matches, new_key
from loopwright.service.server.serving import listen
from loopwright.service.states.loop_state import LoopState
from loopwright.service.store.keyring import Keyring
from loopwright.service.telemetry.metrics import REQUESTS
from loopwright.tuning.reasons import Failed, Reason
from tests.unit.service.apps import app_of
from tests.unit.service.fakes import TAG, FakeLoop, Service
from tests.unit.service.processes import until
from tests.unit.service.served import PATIENCE_S, Served, rest, served

UNFINISHED = (
    f"POST /loops/{TAG}/retune HTTP/1.1\nHost: 127.0.0.1\nContent-Type: application/json\nContent-Length: 99\n\n{{"
)


@pytest.fixture
def stack() -> Iterator[ExitStack]:
    with ExitStack() as stack:
        yield stack


def open_door(stack: ExitStack, service: Service, keyring: Keyring | None = None, **limits: Any) -> Served:
    allowed = RequestLimits(**limits)
    app = app_of(service.jobs, Policy(keyring, allowed, local_only=True), {})
    return stack.enter_context(served(app, limits=allowed))


def running(service: Service, door: Served, **headers: str) -> str:
    service.tune.hold.clear()
    status, more, _ = door.ask("POST", f"/loops/{TAG}/retune", '{"by": "me"}', **headers)
    assert status == 202
    assert service.tune.inside.wait(PATIENCE_S)
    return more["location"]


# what one kind of work does is no other's business


class SilentLoop(FakeLoop):
    """Its node takes its time to be found silent."""

    def __init__(self, service: Service, asked: list[int], over: threading.Event) -> None:
        super().__init__(service.controller)
        self._asked, self._over = asked, over

    def read(self, beside_tests: bool = False) -> LoopState:
        self._asked.append(1)
        assert self._over.wait(PATIENCE_S)
        raise Failed(Reason.NODE_LOST, "node 32 does not answer")


def test_readers_of_a_silent_node_keep_nobody_waiting(service: Service, stack: ExitStack) -> None:
    """More of them than the web framework has threads. They are answered together, when the node was found silent."""
    over, asked = threading.Event(), list[int]()
    stack.callback(over.set)

    def open_loop(config: Any) -> Loop:
        return FakeLoop(service.controller) if config.tag == TAG else SilentLoop(service, asked, over)

    service.jobs.directory.open_loop = open_loop
    door = open_door(stack, service)
    job = running(service, door)
    ask = "GET /loops/FIC-2 HTTP/1.1\nHost: 127.0.0.1\n\n"
    reads = [stack.enter_context(closing(door.begun(ask))) for _ in range(60)]
    until(lambda: asked)
    assert door.ask("GET", "/healthz")[0] == 200
    assert door.ask("POST", f"{job}/abort")[0] == 202
    service.wait(job.rpartition("/")[2])
    assert service.store.get(job.rpartition("/")[2]).reason == "operator"
    for path in ("/loops", "/jobs", job, "/metrics"):
        assert door.ask("GET", path)[0] == 200, path
    over.set()
    answers = []
    for read in reads:
        read.settimeout(PATIENCE_S)
        answers.append(read.recv(4096).decode())
    statuses = [int(answer.split()[1]) for answer in answers]
    others = [answer for answer, status in zip(answers, statuses, strict=True) if status not in (200, 429)]
    assert not others and statuses.count(429), others
    assert statuses.count(200) >= 16  # the node is silent; this client has its share
    assert len(asked) <= 3


def test_bodies_that_do_not_come_take_no_place(service: Service, stack: ExitStack) -> None:
    door = open_door(stack, service)
    job = running(service, door)
    for _ in range(100):
        stack.enter_context(closing(door.begun(UNFINISHED)))
    for path in ("/healthz", "/loops", f"/loops/{TAG}", job):
        assert door.ask("GET", path)[0] == 200, path
    assert door.ask("POST", f"{job}/abort", '{"by": "me"}')[0] == 202
    assert door.ask("POST", "/loops/FIC-2/retune", '{"by": "me"}')[0] == 202


def test_a_body_that_does_not_come_is_waited_for_so_long(service: Service, stack: ExitStack) -> None:
    door = open_door(stack, service, body_s=0.2)
    answer = rest(stack.enter_context(closing(door.begun(UNFINISHED))))
    assert answer.startswith(b"HTTP/1.1 408 ") and b"1 bytes of the body came in 0.2 s" in answer
    assert b"connection: close" in answer.lower()
    assert service.store.recent() == []


def test_bodies_take_no_more_memory_than_permitted(service: Service, stack: ExitStack) -> None:
    door = open_door(stack, service, bodies_bytes=100_000)
    long = UNFINISHED.replace("Content-Length: 99", "Content-Length: 900000") + 90_000 * " "
    answer = rest(stack.enter_context(closing(door.begun(long))))
    assert answer.startswith(b"HTTP/1.1 429 ") and b"bodies of 50000 bytes of this client" in answer
    assert door.ask("POST", f"/loops/{TAG}/retune", '{"by": "me"}')[0] == 202


def test_an_abort_goes_before_the_rate_of_reading(service: Service, stack: ExitStack) -> None:
    door = open_door(stack, service, rate_per_s=0.001, burst=1)
    job = running(service, door)
    assert door.ask("GET", "/loops")[0] == 429
    assert door.ask("POST", f"{job}/abort")[0] == 202


@pytest.mark.parametrize(
    ("method", "path", "kind"),
    [
        ("GET", "/healthz", None),
        ("GET", "/readyz", RequestKind.WATCH),
        ("GET", "/metrics", RequestKind.WATCH),
        ("POST", "/jobs/4f0c2a9be113/abort", RequestKind.ABORT),
        ("POST", "/batches/4f0c2a9be113/abort", RequestKind.ABORT),
        ("POST", "/loops/TIC-101/acknowledge", RequestKind.ABORT),
        ("POST", "/jobs/4f0c2a9be113/accept", RequestKind.DECISION),
        ("POST", "/jobs/4f0c2a9be113/rollback", RequestKind.DECISION),
        ("POST", "/loops/TIC-101/retune", RequestKind.COMMAND),
        ("POST", "/batches", RequestKind.COMMAND),
        ("GET", "/loops", RequestKind.READ),
        ("GET", "/loops/TIC-101", RequestKind.BUS),
        ("GET", "/loops/TIC-101/jobs", RequestKind.READ),
        ("GET", "/jobs/4f0c2a9be113/abort", RequestKind.READ),
        ("GET", "/jobs/4f0c2a9be113/events", RequestKind.STREAM),
        ("GET", "/jobs/4f0c2a9be113/record", RequestKind.FIGURES),
        ("GET", "/jobs/4f0c2a9be113/designs", RequestKind.FIGURES),
        ("GET", "/jobs/4f0c2a9be113/report", RequestKind.FIGURES),
        ("GET", "/loops/report", RequestKind.BUS),
        ("GET", "/jobs/4f0c2a9be113/alternatives", RequestKind.COMPUTATION),
        ("POST", "/tunings", RequestKind.COMPUTATION),
    ],
)
def test_kinds_of_work(method: str, path: str, kind: RequestKind | None) -> None:
    assert kind_of(method, path) is kind


def test_places_and_turns() -> None:
    limits = RequestLimits(wait_s=0.01)

    async def tried() -> None:
        places = Places(limits, {RequestKind.READ: Room(places=6, turns=2)})
        async with ExitStackOf(places, "a") as first:
            await first.take()
            with pytest.raises(Full, match=r"no turn in 0\.01 s") as late:  # one of the two turns is for the others
                await first.take()
            assert late.value.status == 503
            waiting = [asyncio.ensure_future(places.taken(RequestKind.READ, "a").__aenter__()) for _ in range(2)]
            await asyncio.sleep(0)
            with pytest.raises(Full, match="3 reads of the database of this client") as full:
                places.check(RequestKind.READ, "a")
            assert full.value.status == 429
            async with places.taken(RequestKind.READ, "b"):  # goes before those who wait: its turn is not theirs
                places.check(RequestKind.READ, "b")
            for each in waiting:
                each.cancel()
            await asyncio.gather(*waiting, return_exceptions=True)
            async with places.taken(RequestKind.READ, "c"):
                first.turns[0].over()
                async with places.taken(RequestKind.READ, "a"):
                    pass
        places.check(RequestKind.READ, "a")

    asyncio.run(tried())


class ExitStackOf:
    """Places of one client, all left at the end."""

    def __init__(self, places: Places, client: str) -> None:
        self._stack, self._places, self._client = AsyncExitStack(), places, client
        self.turns: list[Any] = []

    async def take(self) -> None:
        self.turns.append(await self._stack.enter_async_context(self._places.taken(RequestKind.READ, self._client)))

    async def __aenter__(self) -> ExitStackOf:
        return self

    async def __aexit__(self, *_: object) -> None:
        await self._stack.aclose()


# keys


def bearer(key: str) -> dict[str, str]:
    return {"Authorization": f"Bearer {key}"}


def wrong_secret(key: str) -> str:
    return f"{key[:16]}{new_key()[1][16:]}"


def test_guesses_at_a_key_are_counted_as_they_begin_and_keep_nobody_waiting(
    service: Service, stack: ExitStack, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The hash of the first guess does not come to its end: nothing may depend on it."""
    keyring = Keyring(service.store.engine)
    (_, known), (_, guessed) = (keyring.create(name, Scope.ADMIN) for name in ("known", "guessed"))
    door = open_door(stack, service, keyring, bad_keys_burst=3, bad_keys_per_s=0.001)
    assert door.ask("GET", "/loops", **bearer(known))[0] == 200
    over, hashed = threading.Event(), list[str]()
    stack.callback(over.set)

    def hashing(key: str, kept: str) -> bool:
        hashed.append(key)
        assert over.wait(PATIENCE_S)
        return matches(key, kept)

    monkeypatch.setattr("loopwright.service.store.keyring.matches", hashing)
    head = "GET /loops HTTP/1.1\nHost: 127.0.0.1\nAuthorization: Bearer {}\n\n"
    guesses = [stack.enter_context(closing(door.begun(head.format(wrong_secret(guessed))))) for _ in range(50)]
    until(lambda: hashed)
    assert door.ask("GET", "/loops", **bearer(known))[0] == 200
    job = running(service, door, **bearer(known))
    assert door.ask("POST", f"{job}/abort", **bearer(known))[0] == 202
    over.set()
    statuses = []
    for guess in guesses:
        guess.settimeout(PATIENCE_S)
        statuses.append(int(guess.recv(12).split()[1]))
    assert statuses.count(401) == 3 and statuses.count(429) == 47 and len(hashed) == 3


def test_who_comes_from_another_address_waits_behind_one_guess_of_each(
    service: Service, monkeypatch: pytest.MonkeyPatch
) -> None:
    keyring = Keyring(service.store.engine)
    _, key = keyring.create("a", Scope.READ)
    order: list[str] = []

    def hashing(guess: str, kept: str) -> bool:
        order.append("right" if guess == key else "wrong")
        return guess == key

    monkeypatch.setattr("loopwright.service.store.keyring.matches", hashing)

    async def tried() -> None:
        checks = key_checks.KeyChecks(keyring, RequestLimits())
        guesses = [asyncio.ensure_future(checks.row(wrong_secret(key), f"10.0.0.{n % 3}")) for n in range(60)]
        await asyncio.sleep(0)
        found = await checks.row(key, "10.0.0.9")
        assert found is not None and found.name == "a"
        answers = await asyncio.gather(*guesses, return_exceptions=True)
        assert sum(isinstance(answer, key_checks.TooOften) for answer in answers) >= 30
        with pytest.raises(key_checks.TooOften, match="this address"):
            await checks.row(wrong_secret(key), "10.0.0.1")
        assert await checks.row(key, "10.0.0.1") is found  # in use: not a guess

    asyncio.run(tried())
    assert order.index("right") <= 3
    assert order.count("wrong") <= 3  # once the right one is known no other of its id is hashed


def test_the_id_of_a_key_does_not_refuse_its_owner(service: Service, monkeypatch: pytest.MonkeyPatch) -> None:
    """Whoever guesses from many addresses finds the id's guesses used up; the owner has guessed nothing."""
    keyring = Keyring(service.store.engine)
    _, key = keyring.create("a", Scope.READ)
    monkeypatch.setattr("loopwright.service.store.keyring.matches", lambda guess, kept: guess == key)

    async def tried() -> None:
        checks = key_checks.KeyChecks(keyring, RequestLimits(bad_keys_burst=2, bad_keys_per_s=0.001))
        for n in range(2):
            assert await checks.row(wrong_secret(key), f"10.0.0.{n}") is None
        with pytest.raises(key_checks.TooOften, match="with the id"):
            await checks.row(wrong_secret(key), "10.0.0.1")
        assert await checks.row(key, "10.0.0.9") is not None

    asyncio.run(tried())


def test_a_revocation_empties_what_is_known(service: Service) -> None:
    keyring = Keyring(service.store.engine)
    row, key = keyring.create("a", Scope.READ)
    assert keyring.check(key) is not None and keyring.known(key) is not None and keyring.was_right(key)
    keyring.revoke(row.id)
    assert keyring.known(key) is None and not keyring.was_right(key) and keyring.check(key) is None


# connections


def test_those_who_say_nothing_give_way(service: Service, stack: ExitStack, caplog: pytest.LogCaptureFixture) -> None:
    door = open_door(stack, service, connections=20, connections_of_address=10)
    events = f"GET {running(service, door)}/events HTTP/1.1\nHost: 127.0.0.1\n\n"
    stream = stack.enter_context(closing(door.begun(events)))
    assert stream.recv(12) == b"HTTP/1.1 200"
    silent = [stack.enter_context(closing(door.begun(text))) for text in 15 * ["", "", "GET / HTTP", "GET / HTTP"]]
    assert door.ask("GET", "/healthz")[0] == 200
    until(lambda: sum(map(is_closed, silent)) >= 45)
    stream.settimeout(PATIENCE_S)
    assert stream.recv(100)  # who is answered stays
    lines = [record for record in caplog.records if "since the last such line" in record.getMessage()]
    assert len(lines) == 1 and "10 of one address" in lines[0].getMessage()


def test_where_nobody_can_give_way_one_is_refused_in_words(service: Service, stack: ExitStack) -> None:
    door = open_door(stack, service, connections=4, connections_of_address=2, streams_at_once=10)
    job = running(service, door)
    streams = []
    for _ in range(2):
        streams.append(stack.enter_context(closing(door.begun(f"GET {job}/events HTTP/1.1\nHost: 127.0.0.1\n\n"))))
        assert streams[-1].recv(12) == b"HTTP/1.1 200"
    assert rest(stack.enter_context(closing(door.begun()))) == b""
    answer = rest(stack.enter_context(closing(door.begun("GET /healthz HTTP/1.1\nHost: 127.0.0.1\n\n"))))
    assert answer.startswith(b"HTTP/1.1 503 ") and b"Retry-After: 1" in answer and b"as many connections" in answer
    streams[0].close()
    until(lambda: not rest_is_refusal(door))


def is_closed(connection: socket.socket) -> bool:
    connection.setblocking(False)
    try:
        return connection.recv(1) == b""
    except BlockingIOError:
        return False
    except ConnectionResetError:
        return True


def rest_is_refusal(door: Served) -> bool:
    try:
        return door.ask("GET", "/healthz")[0] == 503
    except OSError:
        return True


def test_a_head_that_does_not_come_is_waited_for_so_long(service: Service, stack: ExitStack) -> None:
    door = open_door(stack, service, headers_s=1.0)
    for begun in ("", "GET /loops HTTP/1.1\nHost: 127"):
        assert rest(stack.enter_context(closing(door.begun(begun)))) == b""
    kept = stack.enter_context(closing(door.begun("GET /healthz HTTP/1.1\nHost: 127.0.0.1\n\nGET /")))
    assert rest(kept).startswith(b"HTTP/1.1 200 ")  # and nothing after it


class Waiting:
    """A connection that waits for a request."""

    def __init__(self, among: Connections, address: str) -> None:
        self.address, self._among = address, among
        self.gave_way = False

    def give_way(self) -> None:
        self.gave_way = True
        self._among.gone(self)  # type: ignore[arg-type]


def admitted(connections: Connections, *addresses: str) -> list[Waiting]:
    found = [Waiting(connections, address) for address in addresses]
    assert all(connections.admit(each) for each in found)  # type: ignore[arg-type]
    return found


def test_a_proxys_address_is_nobodys_own() -> None:
    limits = RequestLimits(connections=8, connections_of_address=2)
    connections = Connections(limits, 1000, lambda address: address == "10.0.0.1")
    assert not any(each.gave_way for each in admitted(connections, *6 * ["10.0.0.1"]))
    assert [each.gave_way for each in admitted(connections, *3 * ["10.0.0.2"])] == [True, False, False]


def test_half_of_the_descriptors_are_not_for_connections() -> None:
    connections = Connections(RequestLimits(connections=500), 100)
    found = admitted(connections, *(f"10.0.0.{n}" for n in range(200)))
    assert sum(not each.gave_way for each in found) == 50


def test_who_has_most_gives_way_first() -> None:
    connections = Connections(RequestLimits(connections=4), 100)
    one, *many = admitted(connections, "10.0.0.1", *3 * ["10.0.0.2"])
    admitted(connections, "10.0.0.3")
    assert [each.gave_way for each in (one, *many)] == [False, True, False, False]


def test_without_descriptors_connections_are_turned_away(caplog: pytest.LogCaptureFixture) -> None:
    """With one line of the log, and each accepted and closed rather than left to be asked for again and again."""
    with closing(listen("127.0.0.1", 0)) as listener, ExitStack() as stack:
        listener.setblocking(False)
        clients = [stack.enter_context(closing(socket.create_connection(listener.getsockname()))) for _ in range(40)]
        for client in clients:
            client.sendall(b"G")
        soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
        with open(os.devnull) as free:
            lowest = free.fileno()
        resource.setrlimit(resource.RLIMIT_NOFILE, (lowest, hard))
        try:
            for _ in range(60):
                with pytest.raises(BlockingIOError):
                    listener.accept()
        finally:
            resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))
        for client in clients:
            client.settimeout(PATIENCE_S)
            assert rest(client) == b""
    assert [record.getMessage() for record in caplog.records] == [
        "a connection was turned away, all file descriptors are taken "
        "(1 since the last such line, of which there is one a minute)"
    ]


def test_one_line_a_minute(caplog: pytest.LogCaptureFixture) -> None:
    now = [0.0]
    warning, once = WarningOnceAMinute(lambda: now[0]), OnceAMinute(lambda: now[0])
    passed = []
    for second in range(121):
        now[0] = float(second)
        warning.happened("refused")
        passed.append(once.filter(logging.makeLogRecord({"msg": "Invalid HTTP request received.", "levelno": 30})))
        assert once.filter(logging.makeLogRecord({"msg": "a defect", "levelno": 40}))
    assert len(caplog.records) == 3 == sum(passed)
    assert "60 since the last" in caplog.records[1].getMessage()


# whose word is taken


@pytest.mark.parametrize(
    ("trusted", "address"), [((), "127.0.0.1"), (("127.0.0.0/8",), "203.0.113.9"), (("10.0.0.0/8",), "127.0.0.1")]
)
def test_who_asks_is_believed_of_trusted_proxies_only(
    service: Service, stack: ExitStack, trusted: tuple[str, ...], address: str
) -> None:
    app = app_of(service.jobs, Policy(local_only=True), {})
    door = stack.enter_context(served(app, trusted_proxies=tuple(map(ip_network, trusted))))
    forwarded = {"X_Forwarded_For": "198.51.100.1, 203.0.113.9", "X_Forwarded_Proto": "https"}
    assert door.ask("POST", f"/loops/{TAG}/retune", '{"by": "me"}', **forwarded)[0] == 202
    _, _, body = door.ask("GET", "/audit")
    assert f'"address":"{address}"'.encode() in body


# the log


def test_refusals_are_logged_once_a_second_for_each_address(
    service: Service, stack: ExitStack, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO)
    door = open_door(stack, service, rate_per_s=0.001, burst=1)
    began = time.monotonic()
    statuses = [door.ask("GET", "/loops")[0] for _ in range(30)]
    assert statuses == [200] + 29 * [429]
    lines = [record for record in caplog.records if getattr(record, "status", None) == 429]
    assert 1 <= len(lines) <= 1 + time.monotonic() - began


def counted(status: str) -> float:
    """Requests that were answered so, as the metrics count them."""
    (metric,) = REQUESTS.collect()
    return sum(
        each.value for each in metric.samples if each.name.endswith("_total") and each.labels["status"] == status
    )


def test_so_are_bodies_that_end_with_their_connection(
    service: Service, stack: ExitStack, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO)
    door = open_door(stack, service)
    began, before = time.monotonic(), counted("400")
    for _ in range(30):
        door.begun(UNFINISHED).close()
    until(lambda: counted("400") >= before + 30)
    lines = [record for record in caplog.records if getattr(record, "status", None) == 400]
    assert 1 <= len(lines) <= 1 + time.monotonic() - began

"""Limits of concurrent requests by kind, so that one kind of request cannot block another.

A request has a place from its arrival until its answer is sent, and a turn while it is worked on, which ends when the
answer begins. Requests without a turn wait for one. Waiting takes no thread, and turns are few, so that the 40 threads
that the web framework shares among all requests are never all taken.
"""

from __future__ import annotations

import asyncio
import re
from collections import Counter
from collections.abc import AsyncIterator, Mapping
from contextlib import asynccontextmanager
from dataclasses import dataclass
from enum import StrEnum

from loopwright.service.api.gate.limits import RequestLimits

SAFE_METHODS = ("GET", "HEAD", "OPTIONS")
_ABORT = re.compile(r"/(?:jobs|batches)/[^/]+/abort")
_PREVIEW = re.compile(r"/loops/[^/]+/retune/preview|/batches/preview")


class RequestKind(StrEnum):
    """The kind of a request; the value is how a refusal names it."""

    ABORT = "aborts and acknowledgements"
    DECISION = "acceptances and rollbacks"
    COMMAND = "commands"
    READ = "reads of the database"
    FIGURES = "records, designs and reports of jobs"
    BUS = "reads of the bus"
    COMPUTATION = "computations"
    STREAM = "event streams"
    WATCH = "requests of /readyz and /metrics"
    PAGE = "files of the page"
    SIGN_IN = "sign-ins"


DECIDES = (RequestKind.ABORT, RequestKind.DECISION)
_LAST_WORDS = {
    "abort": RequestKind.ABORT, "acknowledge": RequestKind.ABORT,
    "accept": RequestKind.DECISION, "rollback": RequestKind.DECISION,
}  # fmt: skip
_OF_FIGURES = ("record", "designs", "report")
_WATCHED = ("/readyz", "/metrics")


def changes_nothing(path: str) -> bool:
    """Whether a POST to this path changes nothing."""
    return path == "/tunings" or _PREVIEW.fullmatch(path) is not None


def stops_a_test(method: str, path: str) -> bool:
    """Whether the request is the abort of a job or of a batch."""
    return method == "POST" and _ABORT.fullmatch(path) is not None


def is_page(path: str) -> bool:
    """Whether the path is one of the operators' page, whose files say nothing of the installation."""
    return path in ("/", "/ui") or path.startswith("/ui/")


def kind_of(method: str, path: str) -> RequestKind | None:
    """The kind of a request; None for /healthz, which costs nothing and is always answered."""
    if path == "/healthz":
        return None
    if is_page(path):
        return RequestKind.PAGE
    if path == "/session" and method not in SAFE_METHODS:
        return RequestKind.SIGN_IN
    last = path.rpartition("/")[2]
    if path == "/tunings" or last in ("alternatives", "observation"):
        return RequestKind.COMPUTATION
    if last == "preview":
        return RequestKind.BUS
    if method not in SAFE_METHODS:
        return _LAST_WORDS.get(last, RequestKind.COMMAND)
    if path in _WATCHED:
        return RequestKind.WATCH
    if last == "events" or path == "/live":
        return RequestKind.STREAM
    if last in _OF_FIGURES and path.startswith("/jobs/"):
        return RequestKind.FIGURES
    return RequestKind.BUS if path.startswith("/loops/") and path.count("/") == 2 else RequestKind.READ


@dataclass(frozen=True)
class Room:
    """places: requests of a kind that wait or are answered.  turns: requests of the kind that are worked on."""

    places: int
    turns: int

    @property
    def places_of_client(self) -> int:
        return max(1, self.places // 2)

    @property
    def turns_of_client(self) -> int:
        """All turns but one, which is left for other clients."""
        return max(1, self.turns - 1)


def rooms(limits: RequestLimits) -> dict[RequestKind, Room]:
    """The places and turns of each kind. Turns are few: threads that read the database contend for the interpreter
    lock with the threads of the loops and with the event loop. Threads that wait for a bus hardly need the lock. Who
    waits for the figures of a job that has just ended takes no thread, and must not keep others from reading."""
    return {
        RequestKind.ABORT: Room(64, 4),
        RequestKind.DECISION: Room(32, 8),
        RequestKind.COMMAND: Room(32, 2),
        RequestKind.READ: Room(limits.at_once, 2),
        RequestKind.FIGURES: Room(64, 32),
        RequestKind.BUS: Room(32, 4),
        RequestKind.COMPUTATION: Room(limits.computations_at_once, limits.computations_at_once),
        RequestKind.STREAM: Room(limits.streams_at_once, 2),
        RequestKind.WATCH: Room(16, 2),
        RequestKind.PAGE: Room(64, 4),
        RequestKind.SIGN_IN: Room(32, 8),
    }


class Full(Exception):
    """There is no place: the client has its share (429), or all places are taken (503)."""

    def __init__(self, status: int, why: str) -> None:
        super().__init__(why)
        self.status = status


class Turn:
    """The turn of a request, which it has while it is worked on. `over` may be called more than once."""

    def __init__(self, place: _Places, client: str) -> None:
        self._place, self._client = place, client
        self._over = False

    def over(self) -> None:
        if not self._over:
            self._over = True
            self._place.leave(self._client)


class _Places:
    """The places of one kind. An object belongs to one event loop."""

    def __init__(self, kind: RequestKind, room: Room) -> None:
        self._kind, self._room = kind, room
        self.taken: Counter[str] = Counter()
        self._working: Counter[str] = Counter()
        self._waiting: list[tuple[str, asyncio.Future[None]]] = []

    def check(self, client: str) -> None:
        """Raises Full when the client would get no place."""
        everybodys, its = self.taken.total(), self.taken[client]
        if everybodys >= self._room.places:
            raise Full(503, f"{everybodys} {self._kind} are under way already, no more are taken")
        if its >= self._room.places_of_client:
            raise Full(429, f"{its} {self._kind} of this client are under way already, which is its share")

    def take(self, client: str) -> None:
        self.check(client)
        self.taken[client] += 1

    def free(self, client: str) -> None:
        _less(self.taken, client)

    async def turn(self, client: str, wait_s: float) -> Turn:
        """Waits for a turn. Raises Full when none is free within `wait_s` seconds."""
        if not self._may(client):
            mine = asyncio.get_running_loop().create_future()
            self._waiting.append((client, mine))
            try:
                await asyncio.wait_for(asyncio.shield(mine), wait_s)
            except BaseException as error:
                if mine.done():  # the turn was given at the moment of the timeout
                    self.leave(client)
                else:
                    self._waiting.remove((client, mine))
                if isinstance(error, TimeoutError):
                    raise Full(503, f"there was no turn in {wait_s:g} s, too many {self._kind} are under way") from None
                raise
        else:
            self._working[client] += 1
        return Turn(self, client)

    def leave(self, client: str) -> None:
        """Ends a turn, and gives it to the first waiting request that may have it."""
        _less(self._working, client)
        for each in self._waiting:
            if self._may(each[0]):
                self._waiting.remove(each)
                self._working[each[0]] += 1
                each[1].set_result(None)
                return

    def _may(self, client: str) -> bool:
        return self._working.total() < self._room.turns and self._working[client] < self._room.turns_of_client


class Places:
    """The places of every kind."""

    def __init__(self, limits: RequestLimits, of: Mapping[RequestKind, Room] | None = None) -> None:
        self._wait_s = limits.wait_s
        self._of = {kind: _Places(kind, room) for kind, room in (of or rooms(limits)).items()}

    def check(self, kind: RequestKind, client: str) -> None:
        """Raises Full when the client would get no place."""
        self._of[kind].check(client)

    @asynccontextmanager
    async def taken(self, kind: RequestKind, client: str) -> AsyncIterator[Turn]:
        """Takes a place, waits for its turn, and gives both back at the end. Raises Full."""
        places = self._of[kind]
        places.take(client)
        try:
            turn = await places.turn(client, self._wait_s)
            try:
                yield turn
            finally:
                turn.over()
        finally:
            places.free(client)


def _less(counts: Counter[str], client: str) -> None:
    counts[client] -= 1
    if not counts[client]:
        del counts[client]

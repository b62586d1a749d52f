"""Kinds of work, and the places that each kind has: what one kind does, and how long it takes, is no other's business.

A request has a place from the moment in which it has arrived whole until its answer is sent, and a turn from its
beginning until its answer begins: so many are worked on at a time, the rest wait for their turn. Waiting takes no
thread, and turns are few, so that the threads of the web framework (40, shared by all) are never all taken.
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
_PREVIEW = re.compile(r"/loops/[^/]+/retune/preview|/retunes/preview")


class RequestKind(StrEnum):
    """What a request asks for, in the words of a refusal."""

    ABORT = "aborts and dismissals"
    DECISION = "acceptances and rollbacks"
    COMMAND = "commands"
    READ = "reads of the database"
    BUS = "reads of the bus"
    COMPUTATION = "computations"
    STREAM = "event streams"
    WATCH = "looks at /readyz and /metrics"


DECIDES = (RequestKind.ABORT, RequestKind.DECISION)
_LAST_WORDS = {
    "abort": RequestKind.ABORT, "dismiss": RequestKind.ABORT,
    "accept": RequestKind.DECISION, "rollback": RequestKind.DECISION,
}  # fmt: skip
_WATCHED = ("/readyz", "/metrics")


def changes_nothing(path: str) -> bool:
    """Whether a POST to this path only answers."""
    return path == "/tunings" or _PREVIEW.fullmatch(path) is not None


def kind_of(method: str, path: str) -> RequestKind | None:
    """The kind of a request; None: it costs nothing, and is always answered."""
    if path == "/healthz":
        return None
    last = path.rpartition("/")[2]
    if path == "/tunings" or last == "alternatives":
        return RequestKind.COMPUTATION
    if last == "preview":
        return RequestKind.BUS
    if method not in SAFE_METHODS:
        return _LAST_WORDS.get(last, RequestKind.COMMAND)
    if path in _WATCHED:
        return RequestKind.WATCH
    if last == "events":
        return RequestKind.STREAM
    return RequestKind.BUS if path.startswith("/loops/") and path.count("/") == 2 else RequestKind.READ


@dataclass(frozen=True)
class Room:
    """places: requests that wait or are answered.  turns: those that are worked on."""

    places: int
    turns: int

    @property
    def places_of_client(self) -> int:
        return max(1, self.places // 2)

    @property
    def turns_of_client(self) -> int:
        """One is left for the others."""
        return max(1, self.turns - 1)


def rooms(limits: RequestLimits) -> dict[RequestKind, Room]:
    """Threads that read, and show what they read, contend for one interpreter with those that pump the loops and with
    the event loop, which gives it away in each system call: few turns. Those who wait for a bus need hardly any."""
    return {
        RequestKind.ABORT: Room(64, 4),
        RequestKind.DECISION: Room(32, 8),
        RequestKind.COMMAND: Room(32, 2),
        RequestKind.READ: Room(limits.at_once, 2),
        RequestKind.BUS: Room(32, 4),
        RequestKind.COMPUTATION: Room(limits.computations_at_once, limits.computations_at_once),
        RequestKind.STREAM: Room(limits.streams_at_once, 2),
        RequestKind.WATCH: Room(16, 2),
    }


class Full(Exception):
    """There is no place: the client has its share (429), or all are taken (503). The text says how many."""

    def __init__(self, status: int, why: str) -> None:
        super().__init__(why)
        self.status = status


class Turn:
    """What a request has while it is worked on. `over` may be called more than once."""

    def __init__(self, place: _Places, client: str) -> None:
        self._place, self._client = place, client
        self._over = False

    def over(self) -> None:
        if not self._over:
            self._over = True
            self._place.leave(self._client)


class _Places:
    """Those of one kind. For one event loop."""

    def __init__(self, kind: RequestKind, room: Room) -> None:
        self._kind, self._room = kind, room
        self.taken: Counter[str] = Counter()
        self._working: Counter[str] = Counter()
        self._waiting: list[tuple[str, asyncio.Future[None]]] = []

    def check(self, client: str) -> None:
        """Raises Full."""
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
        """Raises Full when it is not had in that time."""
        if not self._may(client):
            mine = asyncio.get_running_loop().create_future()
            self._waiting.append((client, mine))
            try:
                await asyncio.wait_for(asyncio.shield(mine), wait_s)
            except BaseException as error:
                if mine.done():  # it came in the very moment
                    self.leave(client)
                else:
                    self._waiting.remove((client, mine))
                if isinstance(error, TimeoutError):
                    raise Full(503, f"{self._kind}: no turn in {wait_s:g} s, so many are before it") from None
                raise
        else:
            self._working[client] += 1
        return Turn(self, client)

    def leave(self, client: str) -> None:
        """Hands the turn on, in the order in which they came."""
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
    """Those of every kind."""

    def __init__(self, limits: RequestLimits, of: Mapping[RequestKind, Room] | None = None) -> None:
        self._wait_s = limits.wait_s
        self._of = {kind: _Places(kind, room) for kind, room in (of or rooms(limits)).items()}

    def check(self, kind: RequestKind, client: str) -> None:
        """Whether there would be a place. Raises Full."""
        self._of[kind].check(client)

    @asynccontextmanager
    async def taken(self, kind: RequestKind, client: str) -> AsyncIterator[Turn]:
        """A place, and the turn in it. Raises Full."""
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

"""Retunes of many loops: jobs are started with limits per bus and per area, and no more when too many fail.

Requests and their states are in the store: a restarted service continues where the previous one stopped.
"""

from __future__ import annotations

import logging
import sys
import threading
from collections import Counter
from collections.abc import Collection, Sequence
from contextlib import suppress
from fnmatch import fnmatchcase
from typing import Annotated, Any, Self

from pydantic import BaseModel, Field, TypeAdapter, ValidationError, model_validator
from sqlalchemy.exc import SQLAlchemyError
from sqlalchemy.orm import Session

from loopwright.service.errors import Locked, NotKnown, RemoteSetpoint, Stopping, UnknownLoop
from loopwright.service.inputs.config import BusConfig, LoopConfig
from loopwright.service.inputs.request import (
    AnyRetune,
    BadLimits,
    FastRetune,
    FiveStageRetune,
    RuleRetune,
    SetpointRetune,
    by_method,
    retune_request,
    within,
)
from loopwright.service.inputs.validation import Whole, branch, lines
from loopwright.service.jobs.journal import temporary
from loopwright.service.jobs.manager import Jobs
from loopwright.service.security.principal import signed
from loopwright.service.states.job_state import IllegalMove
from loopwright.service.store import batches
from loopwright.service.store.batches import BatchOver, Part, StopReason
from loopwright.service.store.clock import now
from loopwright.service.store.journal_writes import as_asked
from loopwright.service.store.lock import FolderInUse
from loopwright.service.store.store import Busy
from loopwright.service.store.tables import BatchRow
from loopwright.tuning.reasons import Reason

log = logging.getLogger(__name__)

POLL_S = 0.5
"""Wall time between two rounds, s."""
_OWN = ("loops", "pattern", "at_once_per_bus", "at_once_per_area", "stop_after_failures")
AtOnce = Annotated[Whole, Field(ge=1, le=1000)]


class _Loops(BaseModel):
    """Which loops, and how many of them at once."""

    loops: list[Annotated[str, Field(max_length=64)]] | None = Field(
        default=None, min_length=1, max_length=10_000, description="Tags, in the order in which they are to be begun",
        examples=[["TIC-101", "TIC-102"]],
    )  # fmt: skip
    pattern: str | None = Field(
        default=None, min_length=1, max_length=200, examples=["TIC-*"],
        description="Every loop whose tag is so, by tag: * stands for anything, ? for one character; instead of loops",
    )  # fmt: skip
    at_once_per_bus: AtOnce | None = Field(
        default=None,
        description="Most loops of one bus under test at once; at most, and by default, what the bus allows",
    )
    at_once_per_area: AtOnce | None = Field(
        default=None, description="Most loops of one area under test at once; loops without an area do not count"
    )
    stop_after_failures: AtOnce | None = Field(
        default=None,
        description="Begin no more loops once so many ended without a proposal; those under test go on. "
        "What an operator aborts does not count, and no_gain is a good end",
    )

    @model_validator(mode="after")
    def _which(self) -> Self:
        if (self.loops is None) == (self.pattern is None):
            raise ValueError("either loops or pattern must be given, and not both")
        return self

    def each(self) -> AnyRetune:
        """Returns the request for each loop."""
        return retune_request(**self.model_dump(exclude=set(_OWN), exclude_none=True))


class FastRetunes(_Loops, FastRetune):
    """Which loops, how many of them at once, and the options of the retune of each, by fast."""


class SetpointRetunes(_Loops, SetpointRetune):
    """Which loops, how many of them at once, and the options of the retune of each, by setpoint."""


class FiveStageRetunes(_Loops, FiveStageRetune):
    """Which loops, how many of them at once, and the options of the retune of each, by five-stage."""


class RuleRetunes(_Loops, RuleRetune):
    """Which loops, how many of them at once, and the options of the retune of each, by a rule of GET /methods."""


FleetRequest = Annotated[
    Annotated[FastRetunes, branch(FastRetunes)]
    | Annotated[SetpointRetunes, branch(SetpointRetunes)]
    | Annotated[FiveStageRetunes, branch(FiveStageRetunes)]
    | Annotated[RuleRetunes, branch(RuleRetunes)],
    by_method(FastRetunes, SetpointRetunes, FiveStageRetunes, RuleRetunes),
]
_ADAPTER: TypeAdapter[FastRetunes | SetpointRetunes | FiveStageRetunes | RuleRetunes] = TypeAdapter(FleetRequest)


def fleet_request(**options: Any) -> FleetRequest:
    """Returns the request with these options, in the names and values of its JSON object.

    Raises pydantic.ValidationError.
    """
    return _ADAPTER.validate_python(options)


class BadFleet(ValueError):
    """Raised when the request cannot be started on all of its loops; the text names them."""


class Fleet:
    """Runs the batches that were requested from this host."""

    def __init__(self, jobs: Jobs) -> None:
        self._jobs = jobs
        self._directory = jobs.directory
        self._store = jobs.store
        self._wake = threading.Event()
        self._over = threading.Event()
        self._aborted: set[str] = set()
        """Ids of the retunes whose abort the database did not take at once."""
        self._unanswered: dict[str, bool] = {}
        """Ids of the retunes whose request is not answered yet, and whether it was answered that it has failed: the
        answer to the COMMIT alone may be lost."""
        self._looking = threading.Lock()
        self._thread = threading.Thread(target=self._run, name="fleet", daemon=True)

    # start and end
    def boot(self) -> None:
        """Continues the retunes of a previous service, in a thread, unless jobs are not to be resumed."""
        if not self._jobs.resumes:
            self._end_all("the service was started with --no-resume")
        self._thread.start()

    def close(self) -> None:
        """Starts no more jobs; waiting loops are started after the next start of the service."""
        self._over.set()
        self._wake.set()
        if self._thread.is_alive():
            self._thread.join()

    def _end_all(self, why: str) -> None:
        with self._store.writing() as session:
            for row in batches.unfinished(session, self._store.host):
                batches.stop(session, row.id, StopReason.SERVICE_STOPPED, why)

    def _run(self) -> None:
        while not self._over.is_set():
            try:
                self.poll()
            except FolderInUse as error:
                log.error("another service runs the batches: %s", error)
                return
            except SQLAlchemyError as error:
                log.warning("batches wait for the database: %s", error)
            except Exception:
                log.exception("a defect in a batch")
            self._wake.wait(POLL_S)
            self._wake.clear()

    # requests
    def start(self, request: FleetRequest) -> BatchRow:
        """Starts a batch. Raises BadFleet when one of the loops is unknown or does not permit the
        request, Stopping."""
        if self._jobs.stopping:
            raise Stopping(self._jobs.why_stopping)
        known = self._known()
        tags, options, wrong = _tags(request, known), request.each(), []
        for tag in tags:
            try:
                if tag not in known:
                    raise UnknownLoop(tag, known)
                within(known[tag][0], options)
            except (BadLimits, UnknownLoop) as error:
                wrong.append(str(error) if tag not in known else f"{tag}: {error}")
        if wrong:
            raise BadFleet("; ".join(wrong))
        by = signed(request.by)
        asked = {name: value for name, value in request.asked().items() if name != "loops"} | {"by": by}
        row: BatchRow | None = None
        try:
            with self._store.writing() as session:
                row = batches.add(session, self._store.host, asked, tags, by)
                self._unanswered[row.id] = False
        except BaseException:
            if row is not None:
                self._unanswered[row.id] = True
            raise
        del self._unanswered[row.id]
        self._wake.set()
        return row

    def asked(self, request: FleetRequest) -> list[LoopConfig]:
        """Returns the loops of the request, in their order. Raises BadFleet when one of them is unknown."""
        known = self._known()
        tags = _tags(request, known)
        wrong = [str(UnknownLoop(tag, known)) for tag in tags if tag not in known]
        if wrong:
            raise BadFleet("; ".join(wrong))
        return [known[tag][0] for tag in tags]

    def abort(self, batch_id: str, by: str) -> BatchRow:
        """Starts no more jobs, and asks the running jobs to stop: those that run here before anything is read or
        stored. While the database does not take the abort of such jobs, the abort waits in the journal. Raises
        NoSuchBatch, BatchOver, NotKnown."""
        told = self._jobs.tell_all_of(batch_id)
        try:
            with self._store.writing() as session:
                batches.stop(session, batch_id, StopReason.OPERATOR, f"aborted by {by}", by)
        except SQLAlchemyError as error:
            if not told or not temporary(error):
                raise
            return self._stop_later(batch_id, by, told)
        row, parts = self.get(batch_id)
        self._abort(row, parts)
        self._wake.set()
        return row

    def _stop_later(self, batch_id: str, by: str, told: Sequence[str]) -> BatchRow:
        """Stores an abort through the journal. Raises NotKnown. told: the jobs that have heard of it."""
        at = now()

        def write(session: Session) -> None:
            with suppress(BatchOver):  # nothing of it ran any more
                batches.stop(session, batch_id, StopReason.OPERATOR, f"aborted by {by}", by, at)

        self._aborted.add(batch_id)
        self._jobs.journal.put(as_asked(write))
        for job_id in told:
            self._jobs.record_stop(job_id, f"batch {batch_id}")
        try:
            return self.get(batch_id)[0]
        except SQLAlchemyError as error:
            raise NotKnown(
                f"the {len(told)} tests of batch {batch_id} that run at this gateway have been told to stop, and "
                "restore their loops; the database does not answer: that no more are begun is stored, and what has "
                "become of each can be seen, when it is back"
            ) from error

    # queries
    def get(self, batch_id: str) -> tuple[BatchRow, list[Part]]:
        """Returns a retune with its parts. Raises NoSuchBatch."""
        with self._store.reading() as session:
            return batches.find(session, batch_id), batches.parts(session, batch_id)

    def recent(self, limit: int, before: int | None = None) -> list[tuple[BatchRow, list[Part]]]:
        """Returns the latest batches with their parts, newest first."""
        with self._store.reading() as session:
            return [(row, batches.parts(session, row.id)) for row in batches.recent(session, limit, before)]

    # the work
    def poll(self) -> None:
        """Makes one round over the retunes of this host: starts jobs where possible, and ends retunes that are over."""
        with self._looking:
            with self._store.reading() as session:
                rows = batches.unfinished(session, self._store.host)
            for row in rows:
                if row.stop_reason is None and row.id in self._aborted:  # its abort waits in the journal
                    continue
                if not self._answered(row):
                    continue
                try:
                    self._one(*self.get(row.id))
                except (FolderInUse, SQLAlchemyError):
                    raise
                except Exception:  # the others go on
                    log.exception("a defect in the batch %s", row.id)

    def _answered(self, row: BatchRow) -> bool:
        """Whether the retune may begin: not while its request is being stored, nor where it was answered that this has
        failed, which stops it."""
        failed = self._unanswered.get(row.id)
        if failed:
            self._stop(row, StopReason.SERVICE_STOPPED, "its request was answered with an error: ask anew")
            del self._unanswered[row.id]
        return failed is None

    def _one(self, row: BatchRow, parts: list[Part]) -> None:
        if row.stop_reason is None:
            self._go_on(row, parts)
        elif row.stop_reason == StopReason.OPERATOR:
            self._abort(row, parts)
        row, parts = self.get(row.id)
        waits = row.stop_reason is None and any(part.waiting for part in parts)
        if not waits and not any(part.active for part in parts):
            with self._store.writing() as session:
                batches.end(session, row.id)

    def _go_on(self, row: BatchRow, parts: list[Part]) -> None:
        """Starts jobs where possible, unless too many have failed, or this version does not take the request that
        another has stored."""
        try:
            request = fleet_request(**row.request | {"loops": [part.loop for part in parts]} | _NO_PATTERN)
        except ValidationError as error:
            left = ", ".join(part.loop for part in parts if part.waiting)
            why = f"another version of Loopwright has stored the request, which this one does not take: {lines(error)}"
            self._stop(row, StopReason.SERVICE_STOPPED, f"{why}. Ask anew for the loops not begun: {left or 'none'}")
            return
        failures = sum(part.failed for part in parts)
        if request.stop_after_failures and failures >= request.stop_after_failures:
            named = ", ".join(part.loop for part in parts if part.failed)
            self._stop(row, StopReason.FAILURES, f"{failures} ended without a proposal: {named}")
        else:
            self.begin(row, request, parts)

    def _stop(self, row: BatchRow, reason: StopReason, why: str) -> None:
        with self._store.writing() as session:
            batches.stop(session, row.id, reason, why)

    def begin(self, row: BatchRow, request: FleetRequest, parts: Sequence[Part]) -> None:
        """Starts jobs on the waiting loops, in order, as bus and area permit; tests of other requests count too."""
        known, options = self._known(), request.each()
        under_test = {part.loop for part in parts if part.active}
        if not request.dry_run:
            under_test |= self._store.busy().keys()
        taken = Counter(place for tag in under_test if tag in known for place in _places(*known[tag]))
        for part in parts:
            if not part.waiting or part.loop in under_test:
                continue
            if part.loop not in known:
                self._give_up(row, part, str(UnknownLoop(part.loop)))
                continue
            places = _places(*known[part.loop])
            if any(taken[place] >= self._max(place, request) for place in places):
                continue
            try:
                self._jobs.start(part.loop, options, batches.begins(row.id, part.position))
            except Busy:
                continue  # another request started a job on this loop first
            except (BadLimits, UnknownLoop) as error:
                self._give_up(row, part, str(error))
                continue
            except (Locked, RemoteSetpoint) as error:
                self._give_up(row, part, error.detail, error.reason)
                continue
            except (Stopping, BatchOver):
                return
            taken.update(places)

    def _give_up(self, row: BatchRow, part: Part, detail: str, reason: Reason | None = None) -> None:
        with self._store.writing() as session:
            batches.give_up(session, row.id, part.position, detail, reason)

    def _abort(self, row: BatchRow, parts: Sequence[Part]) -> None:
        active = [part.job_id for part in parts if part.active and part.job_id is not None]
        for job_id in active:  # all jobs are asked before the first abort is stored
            self._jobs.tell_to_stop(job_id)
        for job_id in active:
            try:
                self._jobs.ask_to_stop(job_id, f"batch {row.id}")
            except IllegalMove:
                continue  # the job has just ended

    def _known(self) -> dict[str, tuple[LoopConfig, str]]:
        return {config.tag: (config, host) for config, host in self._directory.everywhere()}

    def _max(self, place: tuple[str, ...], request: FleetRequest) -> int:
        if place[0] == _AREA:
            return request.at_once_per_area or sys.maxsize
        _, host, bus = place
        allows = self._directory.at_once(bus) if host == self._store.host else BusConfig().at_once
        return min(allows, request.at_once_per_bus or allows)


def _tags(request: FleetRequest, known: Collection[str]) -> list[str]:
    """Returns the requested tags. Raises BadFleet where no loop matches the pattern."""
    if request.pattern is None:
        return list(dict.fromkeys(request.loops or ()))
    tags = sorted(tag for tag in known if fnmatchcase(tag, request.pattern))
    if not tags:
        raise BadFleet(f"no loop has a tag like {request.pattern!r}")
    return tags


_NO_PATTERN = {"pattern": None}
_AREA, _BUS = "area", "bus"


def _places(config: LoopConfig, host: str) -> list[tuple[str, ...]]:
    """Returns the places whose capacity is limited: the loop's bus and, if it has one, its area. An area may span
    hosts."""
    bus: tuple[str, ...] = (_BUS, host, config.bus)
    return [bus] if config.area is None else [bus, (_AREA, config.area)]

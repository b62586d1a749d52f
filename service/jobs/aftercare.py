"""Supervision of loops that a job could not restore: each is read again until it is restored or an operator takes it
over.

It has a thread of its own: an unreachable node takes seconds to time out, and aborts must be processed meanwhile.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass

from sqlalchemy.exc import SQLAlchemyError

from loopwright.service.jobs.loop_directory import LoopDirectory
from loopwright.service.jobs.machine import Machine
from loopwright.service.loops.restoration import Restoration, restore_loop_of
from loopwright.service.states.loop_state import state_json
from loopwright.service.store import false_pv, unconfirmed_restorations
from loopwright.service.store.jobs import Job
from loopwright.service.store.store import Store
from loopwright.service.telemetry.logs import about
from loopwright.tuning.reasons import ADVICE, Reason

log = logging.getLogger(__name__)

EVERY_S = 2.0
"""Wall time between two rounds, s."""
LONGEST_S = 30.0
"""Longest wall time between two readings of a loop that stays unreachable, s; the time doubles up to this."""
_AT_ONCE = 8
_STOP_S = 10.0
_UNREACHED = (Reason.NODE_LOST, Reason.NODE_NOT_ANSWERING, Reason.BUS_LOST, Reason.NODE_NOT_OPERATIONAL)


@dataclass(frozen=True)
class UnconfirmedRestoration:
    """A loop that is not confirmed to be in its state before a job, with that job and the reason at the last
    reading."""

    loop: str
    job_id: str
    reason: Reason | None
    detail: str

    @property
    def words(self) -> str:
        """Returns what is wrong and what to do."""
        if self.reason in _UNREACHED:
            advice = ADVICE[self.reason]
        else:
            advice = "Look at the controller; it is looked at again by itself."
        return (
            f"not confirmed to be restored after job {self.job_id}: {self.detail.removeprefix('not confirmed: ')}. "
            f"{advice} If it is as it should be, acknowledge its alarm (on a command line: "
            f"loopwright acknowledge {self.loop})"
        )


@dataclass
class _Again:
    """The next time to read a job's loop, monotonic s, and the last result."""

    at: float
    wait_s: float
    restoration: Restoration


class Aftercare:
    """Supervises the unrestored loops of one host.

    directory: the loops of the host; its lock of a loop is held during each reading.
    machine: clock and threads.
    """

    def __init__(self, store: Store, directory: LoopDirectory, machine: Machine) -> None:
        self._store, self._directory = store, directory
        self._machine = machine
        self.clock = self._machine.monotonic
        self._again: dict[str, _Again] = {}
        # Kept apart from the event, because a signal handler sets it.
        self._stopping = False
        self._over = self._machine.event()
        self._thread = self._machine.thread(self._run, "aftercare")

    def start(self) -> None:
        self._thread.start()

    @property
    def is_running(self) -> bool:
        return self._thread.is_alive()

    def request_stop(self) -> None:
        """Stops further readings; loops that are not restored are read after the next start. Returns at once."""
        self._stopping = True

    def close(self) -> None:
        """Stops further readings, and waits for the one in progress."""
        self._stopping = True
        self._over.set()
        if self._thread.is_alive():
            self._thread.join(_STOP_S)
            if self._thread.is_alive():
                log.error("a supervised loop has not answered in %.0f s, the service ends", _STOP_S)

    def unconfirmed(self, loop: str | None = None) -> list[UnconfirmedRestoration]:
        """Returns this host's supervised loops, each once; with `loop`, that loop if it is supervised, on any host."""
        by_loop: dict[str, UnconfirmedRestoration] = {}
        for row in unconfirmed_restorations.rows(self._store, loop):
            by_loop.setdefault(row.loop, self._not_home(row))
        return list(by_loop.values())

    def _not_home(self, row: Job) -> UnconfirmedRestoration:
        again = self._again.get(row.id)
        if again is not None:
            return UnconfirmedRestoration(row.loop, row.id, again.restoration.reason, again.restoration.text)
        reason = row.reason
        return UnconfirmedRestoration(row.loop, row.id, reason, row.detail or "it was not read back")

    def not_acknowledged(self, tag: str) -> str | None:
        """Returns in words which test of the loop has found PV to be false, where nobody has acknowledged that."""
        with self._store.reading() as session:
            return next(map(false_pv.words, false_pv.not_acknowledged(session, tag)), None)

    def acknowledge(self, tag: str, by: str) -> list[str]:
        """Ends the supervision of a loop, for which an operator now answers, and acknowledges that its PV was false.
        Returns the jobs for which that was so, none when it was not. Raises UnknownLoop, Busy."""
        if self.not_acknowledged(tag) is None and not unconfirmed_restorations.rows(self._store, tag):
            self._directory.owner(tag)
            return []
        if (busy := self._store.why_busy(tag)) is not None:
            raise busy
        return unconfirmed_restorations.acknowledged(self._store, tag, by)

    def check_due_loops(self) -> None:
        """Reads every loop whose time has come."""
        rows = unconfirmed_restorations.rows(self._store)
        for gone in self._again.keys() - {row.id for row in rows}:
            del self._again[gone]
        now = self.clock()
        due = [row for row in rows if row.id not in self._again or self._again[row.id].at <= now]
        if len(due) < 2:
            for row in due:
                self._one(row)
            return
        self._machine.side_by_side(self._one, due, _AT_ONCE)

    def _one(self, row: Job) -> None:
        with about(job=row.id, loop=row.loop):
            try:
                self._look_at(row)
            except Exception:  # one loop must not keep the others from being read
                log.exception("defect in the supervision of loop %s", row.loop)

    def _look_at(self, row: Job) -> None:
        with self._directory.alone_with(row.loop):
            # A running job answers for its loop: this row may have been read before that job began.
            if self._stopping or self._store.active(row.loop) is not None:
                return
            restoration = restore_loop_of(row, self._directory.loops, self._directory.open_loop)
        if restoration.state is None:
            self._not_yet(row, restoration)
        elif unconfirmed_restorations.confirmed(
            self._store, row.id, state_json(restoration.state), restoration.text, restoration.held
        ):
            log.info("the loop is not supervised any more: %s", restoration.text)

    def _not_yet(self, row: Job, restoration: Restoration) -> None:
        before = self._again.get(row.id)
        wait_s = EVERY_S if before is None else min(LONGEST_S, 2.0 * before.wait_s)
        if before is None or before.restoration.reason is not restoration.reason:
            log.warning("%s; the loop will be read again", restoration.text)
        self._again[row.id] = _Again(self.clock() + wait_s, wait_s, restoration)

    def _run(self) -> None:
        while not self._stopping:
            try:
                self.check_due_loops()
            except SQLAlchemyError as error:
                log.warning("the loops to be supervised could not be read from the database: %s", error)
            except Exception:
                log.exception("defect in the supervision of loops")
            self._over.wait(EVERY_S)

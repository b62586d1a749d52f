"""Loops looked after: what a job could not bring home is looked at again, until it is home or a person answers for it.

A thread of its own: a loop whose node is away takes seconds to say so, and aborts must be heard meanwhile.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass

from sqlalchemy.exc import SQLAlchemyError

from loopwright.service.jobs.loop_directory import LoopDirectory
from loopwright.service.jobs.machine import Machine
from loopwright.service.loop_state import state_json
from loopwright.service.loops.restoration import Restoration, look
from loopwright.service.store import looked_after
from loopwright.service.store.jobs import Job
from loopwright.service.store.store import Busy, Store
from loopwright.service.telemetry.logs import about
from loopwright.tuning.reasons import ADVICE, Reason

log = logging.getLogger(__name__)

EVERY_S = 2.0
LONGEST_S = 30.0
"""Between two looks at a loop that stays away: twice as long each time, up to this."""
_AT_ONCE = 8
_STOP_S = 10.0
_UNREACHED = (Reason.NODE_LOST, Reason.BUS_LOST, Reason.NODE_NOT_OPERATIONAL)


@dataclass(frozen=True)
class NotHome:
    """A loop that is not confirmed home: since which job, and why, as last looked."""

    loop: str
    job_id: str
    reason: Reason | None
    detail: str

    @property
    def words(self) -> str:
        """Says what is the matter, and what to do."""
        if self.reason in _UNREACHED:
            advice = ADVICE[self.reason]
        else:
            advice = "Look at the controller; it is looked at again by itself."
        return (
            f"not confirmed home after job {self.job_id}: {self.detail.removeprefix('not confirmed: ')}. {advice} "
            f"If it is as it should be: loopwright dismiss {self.loop}"
        )


@dataclass
class _Again:
    """When a job's loop is looked at again, and what was found last."""

    at: float
    wait_s: float
    found: Restoration


class Aftercare:
    """Looks after the loops of one host.

    directory: its loops; each look at one is made alone with it.  machine: its clock and threads.
    """

    def __init__(self, directory: LoopDirectory, store: Store, machine: Machine) -> None:
        self._directory, self._store = directory, store
        self._machine = machine
        self._clock = self._machine.monotonic
        self._again: dict[str, _Again] = {}
        # Apart from the event: a signal handler sets it.
        self._stopping = False
        self._over = self._machine.event()
        self._thread = self._machine.thread(self._run, "aftercare")

    def start(self) -> None:
        self._thread.start()

    def request_stop(self) -> None:
        """Looks at nothing more; what is not home is looked at after the next start. Returns at once."""
        self._stopping = True

    def close(self) -> None:
        """Looks at nothing more, and waits for the look in progress."""
        self._stopping = True
        self._over.set()
        if self._thread.is_alive():
            self._thread.join(_STOP_S)
            if self._thread.is_alive():
                log.error("a loop that is looked after has not answered in %.0f s, the service ends", _STOP_S)

    def not_home(self, loop: str | None = None) -> list[NotHome]:
        """Returns this host's loops that are looked after, or whether one is, on whatever host; a loop once."""
        found: dict[str, NotHome] = {}
        for row in looked_after.rows(self._store, loop):
            found.setdefault(row.loop, self._not_home(row))
        return list(found.values())

    def _not_home(self, row: Job) -> NotHome:
        again = self._again.get(row.id)
        if again is not None:
            return NotHome(row.loop, row.id, again.found.reason, again.found.text)
        reason = row.reason
        return NotHome(row.loop, row.id, reason, row.detail or "it was not read back")

    def dismiss(self, tag: str, by: str) -> list[str]:
        """Lets a person answer for a loop that is looked after: it is not looked at any more. Returns the jobs it was
        looked after for, none when it was not. Raises UnknownLoop, Busy."""
        if not looked_after.rows(self._store, tag):
            self._directory.owner(tag)
            return []
        active = self._store.active(tag)
        if active is not None:
            raise Busy(tag, active.id)
        return looked_after.dismissed(self._store, tag, by)

    def look(self) -> None:
        """Looks at every loop whose time has come."""
        rows = looked_after.rows(self._store)
        for gone in self._again.keys() - {row.id for row in rows}:
            del self._again[gone]
        now = self._clock()
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
            except Exception:  # one loop must not keep the others from being looked at
                log.exception("looking after loop %s", row.loop)

    def _look_at(self, row: Job) -> None:
        with self._directory.alone_with(row.loop):
            # The job that has it answers for it: the row may be older than its beginning.
            if self._stopping or self._store.active(row.loop) is not None:
                return
            found = look(row, self._directory.loops, self._directory.open_loop)
        if found.state is None:
            self._not_yet(row, found)
        elif looked_after.home_again(self._store, row.id, state_json(found.state), found.text):
            log.info("looked after no more: %s", found.text)

    def _not_yet(self, row: Job, found: Restoration) -> None:
        before = self._again.get(row.id)
        wait_s = EVERY_S if before is None else min(LONGEST_S, 2.0 * before.wait_s)
        if before is None or before.found.reason is not found.reason:
            log.warning("%s; it is looked at again", found.text)
        self._again[row.id] = _Again(self._clock() + wait_s, wait_s, found)

    def _run(self) -> None:
        while not self._stopping:
            try:
                self.look()
            except SQLAlchemyError as error:
                log.warning("the database does not say which loops are to be looked after: %s", error)
            except Exception:
                log.exception("looking after loops")
            self._over.wait(EVERY_S)

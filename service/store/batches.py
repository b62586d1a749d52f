"""Retunes of many loops in the store."""

from __future__ import annotations

import secrets
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum

from sqlalchemy import select, update
from sqlalchemy.orm import Session

from loopwright.service.states.job_state import ACTIVE, JobState
from loopwright.service.store import audit, idempotency_effects
from loopwright.service.store.clock import now
from loopwright.service.store.tables import BatchLoopRow, BatchRow, JobRow
from loopwright.tuning.reasons import Reason


class BatchState(StrEnum):
    """The value is what the API shows and the database holds."""

    RUNNING = "running"
    STOPPING = "stopping"
    DONE = "done"
    STOPPED = "stopped"
    ABORTED = "aborted"


class StopReason(StrEnum):
    """Why no more loops are begun."""

    FAILURES = "failures"
    OPERATOR = "operator"
    SERVICE_STOPPED = "service_stopped"


OPEN = (BatchState.RUNNING, BatchState.STOPPING)
WAITING, SKIPPED = "waiting", "skipped"
_FAILURES = frozenset({JobState.REFUSED, JobState.FAILED, JobState.INTERRUPTED})
_NOBODYS_FAULT = frozenset({Reason.OPERATOR.value, Reason.SERVICE_STOPPED.value})
_CLOSED = (Reason.LOCKED.value, Reason.NOT_ACKNOWLEDGED.value)


class NoSuchBatch(Exception):
    """No retune of that id."""

    def __init__(self, batch_id: str) -> None:
        super().__init__(f"there is no batch {batch_id}")


class BatchOver(Exception):
    """The retune begins no more jobs, or has ended."""


@dataclass(frozen=True)
class Part:
    """One loop of a retune with its latest job, as far as there is one.

    given_up: whether it will have no other job; reason and detail then say why.
    """

    position: int
    loop: str
    job_id: str | None
    job_state: JobState | None
    reason: str | None
    detail: str | None
    given_up: bool = False

    @property
    def active(self) -> bool:
        return self.job_state in ACTIVE

    @property
    def waiting(self) -> bool:
        """A job that the end of the service cut short is made up for."""
        if self.given_up:
            return False
        if self.job_state is None:
            return True
        return self.job_state is JobState.ABORTED and self.reason == Reason.SERVICE_STOPPED.value

    @property
    def failed(self) -> bool:
        """Ended without an answer, and not because somebody or the end of the service stopped it, or because no test
        may begin on the loop."""
        if self.reason in _CLOSED:
            return False
        if self.given_up:
            return True
        if self.job_state is JobState.ABORTED:
            return self.reason not in _NOBODYS_FAULT
        return self.job_state in _FAILURES

    def state(self, is_open: bool) -> str:
        """`waiting`, `skipped`, or the state of its job. is_open: whether the retune may still begin it."""
        if self.waiting and is_open:
            return WAITING
        return SKIPPED if self.given_up or self.job_state is None else self.job_state.value


def add(session: Session, host: str, request: Mapping[str, object], loops: Sequence[str], by: str) -> BatchRow:
    """A new retune of these loops, in this order."""
    row = BatchRow(
        id=secrets.token_hex(6),
        host=host,
        state=BatchState.RUNNING.value,
        request=request,
        by=by,
        created_at=now(),
    )
    session.add(row)
    session.flush()
    session.add_all(BatchLoopRow(batch_id=row.id, position=n, loop=loop) for n, loop in enumerate(loops))
    after = {"request": request, "loops": list(loops)}
    audit.record(session, "batch", row.id, after=after, by=by)
    idempotency_effects.made(session, f"/batches/{row.id}")
    return row


def find(session: Session, batch_id: str, lock: bool = False) -> BatchRow:
    """Raises NoSuchBatch. lock: nobody else, on whatever host, changes it before this transaction ends."""
    wanted = select(BatchRow).where(BatchRow.id == batch_id)
    row = session.scalars(wanted.with_for_update() if lock else wanted).one_or_none()
    if row is None:
        raise NoSuchBatch(batch_id)
    return row


def parts(session: Session, batch_id: str) -> list[Part]:
    """Its loops in order."""
    wanted = (
        select(BatchLoopRow, JobRow.state, JobRow.reason, JobRow.detail)
        .outerjoin(JobRow, JobRow.id == BatchLoopRow.job_id)
        .where(BatchLoopRow.batch_id == batch_id)
        .order_by(BatchLoopRow.position)
    )
    return [
        Part(
            row.position,
            row.loop,
            row.job_id,
            JobState(state) if state else None,
            reason if row.detail is None else row.reason,
            detail if row.detail is None else row.detail,
            given_up=row.detail is not None,
        )
        for row, state, reason, detail in session.execute(wanted)
    ]


def of_job(session: Session, job_id: str) -> str | None:
    """Id of the retune that has begun the job; None: there is none."""
    return session.scalar(select(BatchLoopRow.batch_id).where(BatchLoopRow.job_id == job_id).limit(1))


def unfinished(session: Session, host: str) -> list[BatchRow]:
    """Those that the host has to drive, the oldest first."""
    mine = (BatchRow.host == host, BatchRow.ended_at.is_(None))
    return list(session.scalars(select(BatchRow).where(*mine).order_by(BatchRow.number)))


def recent(session: Session, limit: int, before: int | None) -> Sequence[BatchRow]:
    """The latest first; before: only those with a smaller number."""
    wanted = select(BatchRow).order_by(BatchRow.number.desc()).limit(limit)
    if before is not None:
        wanted = wanted.where(BatchRow.number < before)
    return session.scalars(wanted).all()


def begins(batch_id: str, position: int) -> Callable[[Session, JobRow], None]:
    """Notes the job that a loop gets, in the transaction that makes it: raises BatchOver, and there is no job, when
    the retune was stopped meanwhile."""

    def write(session: Session, job: JobRow) -> None:
        if find(session, batch_id, lock=True).state != BatchState.RUNNING:
            raise BatchOver(batch_id)
        _set(session, batch_id, position, job_id=job.id)

    return write


def give_up(session: Session, batch_id: str, position: int, detail: str, reason: Reason | None = None) -> None:
    """Notes why a loop will have no job, or no other than that which was cut short."""
    _set(session, batch_id, position, detail=detail, reason=None if reason is None else reason.value)


def stop(
    session: Session, batch_id: str, reason: StopReason, detail: str, by: str | None = None, at: str | None = None
) -> bool:
    """From now on it begins no more jobs. False when that was so already.

    by: who asked for it, for the audit log; at: when, None for now.

    Raises NoSuchBatch, and BatchOver when it has ended.
    """
    row = find(session, batch_id, lock=True)
    if row.state not in OPEN:
        raise BatchOver(
            f"batch {batch_id} ended at {row.ended_at} as {row.state}: nothing of it is left to stop. "
            f"GET /batches/{batch_id} says what became of each loop"
        )
    idempotency_effects.changed(session, f"/batches/{batch_id}")
    if row.stop_reason == StopReason.OPERATOR or row.stop_reason == reason:
        return False
    row.state, row.stop_reason, row.detail = BatchState.STOPPING.value, reason.value, detail
    if by is not None:
        audit.record(session, "batch_abort", batch_id, after={"reason": reason.value}, by=by, at=at)
    return True


def end(session: Session, batch_id: str) -> None:
    """Notes that nothing of it runs any more."""
    row = find(session, batch_id, lock=True)
    if row.stop_reason is None:
        row.state = BatchState.DONE.value
    else:
        aborted = row.stop_reason == StopReason.OPERATOR
        row.state = (BatchState.ABORTED if aborted else BatchState.STOPPED).value
    row.ended_at = now()


def _set(session: Session, batch_id: str, position: int, **columns: str | None) -> None:
    one = (BatchLoopRow.batch_id == batch_id, BatchLoopRow.position == position)
    session.execute(update(BatchLoopRow).where(*one).values(**columns))

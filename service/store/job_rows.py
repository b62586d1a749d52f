"""The row of a job and its events, within a transaction: found, moved as the table of states allows, appended to."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict

from sqlalchemy import func, insert, select
from sqlalchemy.orm import Session

from loopwright.service.jsonable import JsonObject, json_object, to_jsonable
from loopwright.service.states.job_state import ACTIVE, MOVES, JobState
from loopwright.service.states.loop_state import gains_of, same_gains
from loopwright.service.store import audit, false_pv, idempotency_effects, illegal_moves, loop_locks
from loopwright.service.store.clock import now
from loopwright.service.store.jobs import JobColumns
from loopwright.service.store.tables import ChunkRow, EventRow, JobRow
from loopwright.tuning.reasons import Reason

DECISIONS = {JobState.ACCEPTED: "accept", JobState.ROLLED_BACK: "rollback"}
"""What the audit log calls the moves that somebody decides."""
BEGUN = "decision_begun"
"""The event that a decision writes before it writes to the controller: only without it is a proposal known to have
left the previous gains in effect. Its decision is `unknown` where the database may be older than the last decision."""
_LOCKED = "jobs whose rows are locked"
_CUT_SHORT = (JobState.ABORTED, JobState.FAILED)
"""Ends of a job that was told to stop; `failed` where its loop could not be restored."""


class NoSuchJob(Exception):
    """No job of that id."""

    def __init__(self, job_id: str) -> None:
        super().__init__(f"there is no job {job_id}")
        self.job_id = job_id


def find(session: Session, job_id: str, lock: bool = False) -> JobRow:
    """lock: nobody else, on whatever host, changes the job or appends to it before this transaction ends."""
    locked: dict[str, JobRow] = session.info.setdefault(_LOCKED, {})
    if job_id in locked:  # by this transaction, whose session is closed with it: the row is as it has it
        return locked[job_id]
    wanted = select(JobRow).where(JobRow.id == job_id)
    row = session.scalars(wanted.with_for_update() if lock else wanted).one_or_none()
    if row is None:
        raise NoSuchJob(job_id)
    if lock:
        locked[job_id] = row
    return row


def set_columns(row: JobRow, columns: JobColumns) -> None:
    for name, value in columns.items():
        setattr(row, name, to_jsonable(value))


def check(session: Session, row: JobRow, wanted: JobState) -> None:
    """Raises IllegalMove, with words for who asks for it, unless the job may become so."""
    present = row.state
    if wanted not in MOVES[present]:
        raise illegal_moves.too_late(row, present, wanted, decided(session, row))


def may_begin(session: Session, row: JobRow) -> None:
    """Raises Locked, NotAcknowledged."""
    if not row.dry_run:
        loop_locks.check(session, row.loop)
        false_pv.check(session, row.loop)


def move(session: Session, row: JobRow, wanted: JobState, by: str, columns: JobColumns) -> JobRow:
    previous = row.state
    check(session, row, wanted)
    if wanted is JobState.RUNNING:
        may_begin(session, row)
    row.state = wanted
    set_columns(row, columns)
    if wanted is JobState.RUNNING:
        row.started_at = now()
    elif previous in ACTIVE:
        row.ended_at = now()
    details = {"state": wanted.value, "from": previous.value, "by": by}
    details |= {key: columns[key] for key in ("reason", "detail") if columns.get(key)}
    append(session, row.id, "state", details, row.plant_time_s)
    if wanted in DECISIONS:
        idempotency_effects.changed(session, f"/jobs/{row.id}")
        held = (row.restored or {}).get("gains") if "restored" in columns else None
        _audit_decision(session, row, previous, wanted, by, held if isinstance(held, dict) else None)
    return row


def append(
    session: Session, job_id: str, kind: str, data: Mapping[str, object], plant_time_s: float, at: str | None = None
) -> int:
    """The next event of a job whose row this transaction has locked. Returns its number."""
    values = {"at": at or now(), "plant_time_s": plant_time_s, "kind": kind, "data": json_object(data)}
    return add_next(session, EventRow, job_id, values)


def add_next(session: Session, table: type[EventRow | ChunkRow], job_id: str, values: Mapping[str, object]) -> int:
    """Adds the next row of a job, whose row this transaction has locked or which no other writes. Returns its
    number."""
    last = select(func.max(table.seq)).where(table.job_id == job_id).scalar_subquery()
    row = insert(table).values(job_id=job_id, seq=1 + func.coalesce(last, 0), **values)
    with session.no_autoflush:  # a change of the job is stored once, at the end of the transaction
        return session.scalars(row.returning(table.seq)).one()


def note_stop(session: Session, job_id: str, reason: Reason, by: str, heard: bool, at: str | None = None) -> JobRow:
    """at: when it was asked; None for now. Raises IllegalMove when the job is over, unless it may be so for this."""
    row = find(session, job_id, lock=True)
    if not (heard and row.stop_reason is None and row.state in _CUT_SHORT):
        check(session, row, JobState.ABORTED)
    idempotency_effects.changed(session, f"/jobs/{job_id}")
    if row.stop_reason is None:
        row.stop_reason = reason
        append(session, job_id, "abort_requested", {"by": by}, row.plant_time_s, at)
        before = row.state if row.state in ACTIVE else JobState.RUNNING
        audit.record(session, "abort", job_id, before={"state": before}, loop=row.loop, by=by, at=at)
    return row


def decided(session: Session, row: JobRow) -> illegal_moves.Decided | None:
    """Who has decided the job last; None: nobody has."""
    if row.state not in DECISIONS:
        return None
    mine = (EventRow.job_id == row.id, EventRow.kind == "state")
    event = session.scalars(select(EventRow).where(*mine).order_by(EventRow.seq.desc()).limit(1)).one_or_none()
    return None if event is None else illegal_moves.Decided(str(event.data.get("by", "")), event.at)


def last_begun(session: Session, job_id: str) -> str | None:
    """What the last decision that was about to write to the controller wanted, as in DECISIONS."""
    mine = (EventRow.job_id == job_id, EventRow.kind == BEGUN)
    event = session.scalars(select(EventRow).where(*mine).order_by(EventRow.seq.desc()).limit(1)).one_or_none()
    return None if event is None else str(event.data["decision"])


def doubt_proposals(session: Session, why: str) -> None:
    begun = select(EventRow.seq).where(EventRow.job_id == JobRow.id, EventRow.kind == BEGUN).exists()
    proposals = (JobRow.state == JobState.PROPOSED, JobRow.dry_run.is_(False), ~begun)
    for row in session.scalars(select(JobRow).where(*proposals).order_by(JobRow.number).with_for_update()).all():
        append(session, row.id, BEGUN, {"decision": "unknown", "by": "service", "detail": why}, row.plant_time_s)


def _audit_decision(
    session: Session, row: JobRow, previous: JobState, wanted: JobState, by: str, held: JsonObject | None
) -> None:
    """held: the gains read back after the decision, where it went to the controller."""
    proposed = None if row.result is None else row.result.new_gains
    old, new = row.previous_gains, None if proposed is None else asdict(proposed.gains())
    has = new if wanted is JobState.ACCEPTED else old
    # A rollback that had to write found the new gains, of an acceptance that had ended in an error too.
    had = new if wanted is JobState.ROLLED_BACK and last_begun(session, row.id) == DECISIONS[wanted] else old
    if held and not any(same_gains(gains_of(held), gains_of(one)) for one in (old, new) if one):
        had = has = held  # somebody else's: found, and left
    audit.record(
        session,
        DECISIONS[wanted],
        row.id,
        before={"state": previous.value, "gains": had},
        after={"state": wanted.value, "gains": has},
        loop=row.loop,
        by=by,
    )

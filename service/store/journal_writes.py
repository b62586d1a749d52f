"""What the journal writes, made when it happens and stored later, once: also where the answer to a COMMIT was lost."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from contextvars import Context

from sqlalchemy.orm import Session

from loopwright.service.jsonable import json_object
from loopwright.service.security.principal import current as principal
from loopwright.service.states.job_state import IllegalMove
from loopwright.service.store import idempotency_effects, sample_blocks
from loopwright.service.store.clock import now
from loopwright.service.store.job_rows import add_next, append, find, note_stop
from loopwright.service.store.tables import ChunkRow, EventRow
from loopwright.tuning.plan import Sample
from loopwright.tuning.reasons import Reason

Write = Callable[[Session], None]
"""A piece of a transaction, for the journal."""


def event_of(
    job_id: str, kind: str, data: Mapping[str, object], plant_time_s: float, stage: str | None = None
) -> Write:
    """An event, at the time it happened, stored once. stage: the one that the job has entered with it."""
    at, details = now(), json_object(data)
    seq = 0

    def write(session: Session) -> None:
        nonlocal seq
        row = find(session, job_id, lock=True)
        stored = session.get(EventRow, (job_id, seq)) if seq else None
        if stored is not None and (stored.at, stored.kind, stored.data) == (at, kind, details):
            return  # only the answer to the COMMIT was lost
        row.plant_time_s = plant_time_s
        if stage is not None:
            row.stage = stage
        seq = append(session, job_id, kind, details, plant_time_s, at)

    return write


def block_of(job_id: str, stage: str, samples: Sequence[Sample]) -> Write:
    """A block of samples of one stage, stored once, packed now: a database that is away does not fill the memory."""
    first_t_s, count, data = samples[0].t, len(samples), sample_blocks.pack(samples)
    seq = 0

    def write(session: Session) -> None:
        nonlocal seq
        stored = session.get(ChunkRow, (job_id, seq)) if seq else None
        if stored is not None and (stored.first_t_s, stored.data) == (first_t_s, data):
            return  # only the answer to the COMMIT was lost
        values = {"stage": stage, "first_t_s": first_t_s, "count": count, "data": data}
        seq = add_next(session, ChunkRow, job_id, values)

    return write


def stop_of(job_id: str, reason: Reason, by: str) -> Write:
    """What `request_stop` notes of a request that its job has heard: by the present principal, at this time."""
    at = now()

    def write(session: Session) -> None:
        with suppress(IllegalMove):  # the job had come to its own end when it heard
            note_stop(session, job_id, reason, by, heard=True, at=at)

    return as_asked(write)


def as_asked(write: Write) -> Write:
    """The same write for the journal's thread: by the present principal, and with the present idempotency key."""
    request = Context()
    request.run(principal.set, principal.get())
    request.run(idempotency_effects.current.set, idempotency_effects.current.get())
    return lambda session: request.run(write, session)

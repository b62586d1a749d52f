"""The events of a job as server-sent events.

The id of an event is its number in the job, so a client that was disconnected resumes with Last-Event-ID and misses
nothing. A `progress` event is not stored, and has the id of the latest event that is. The key of a stream is checked
again while the stream is open; a revoked or expired key ends the stream.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import AsyncIterator, Callable

from sqlalchemy.exc import SQLAlchemyError

from loopwright.service.api.event_views import ProgressEvent, Stored, event_view, progress_view
from loopwright.service.jobs.journal import temporary
from loopwright.service.jobs.manager import Jobs
from loopwright.service.live.messages import RETRY_MS
from loopwright.service.live.snapshot import JobProgress, progress_of
from loopwright.service.security.principal import Principal
from loopwright.service.security.sessions import BrowserSessions
from loopwright.service.states.job_state import ACTIVE, JobState
from loopwright.service.store.jobs import Job
from loopwright.service.store.keyring import REVOKED_WITHIN_S, Keyring

_POLL_S = 0.2
_AWAY_S = 1.0
_EVENTS_AT_ONCE = 200
_KEEP_ALIVE_POLLS = 75  # 15 s: proxies close a silent connection after 30 s or more


def still_permitted(keyring: Keyring | None, sessions: BrowserSessions, who: Principal) -> Callable[[], bool]:
    """A function that tells whether the key of a request is still valid, and its session, which counts as used then;
    always true without keys."""
    key_id, session = who.key_id, who.session
    if keyring is None or key_id is None:
        return lambda: True
    if session is None:
        return lambda: keyring.still_valid(key_id)
    return lambda: sessions.use(session) is not None and keyring.still_valid(key_id)


async def event_stream(
    jobs: Jobs,
    job_id: str,
    after: int,
    permitted: Callable[[], bool] = lambda: True,
    elsewhere: Callable[[Job], JobProgress | None] = lambda row: None,
    over: Callable[[], bool] = lambda: False,
) -> AsyncIterator[str]:
    """The events after number `after` as text/event-stream, until the job ends, `permitted` returns false, or `over`
    returns true.

    elsewhere: how far a job of another gateway has come; None where it has not said so.
    over: whether the service ends its streams; whoever resumes the stream at the next start misses nothing.
    """
    yield f"retry: {RETRY_MS}\n\n"
    sent: JobProgress | None = None
    silent = 0
    asked = time.monotonic()
    while not over():
        try:
            if time.monotonic() - asked > REVOKED_WITHIN_S:
                if not await asyncio.to_thread(permitted):
                    yield ": the key of this stream was revoked or has expired\n\n"
                    return
                asked = time.monotonic()
            # The state is read before the events, so an event written in between is sent in the next round.
            row = await asyncio.to_thread(jobs.store.get, job_id)
            events = await asyncio.to_thread(jobs.store.events, job_id, after, _EVENTS_AT_ONCE)
        except SQLAlchemyError as error:
            if not temporary(error):
                raise
            yield ": the database does not answer\n\n"
            await asyncio.sleep(_AWAY_S)
            continue
        more = len(events) == _EVENTS_AT_ONCE
        ended = JobState(row.state) not in ACTIVE and not more
        for event in events:
            after, silent = event.seq, 0
            yield _said(event_view(event).root)
        if ended:
            return
        if more:
            continue
        running = jobs.running(job_id)
        progress = await _progress_elsewhere(row, elsewhere) if running is None else progress_of(running)
        if progress is not None and progress != sent:
            sent, silent = progress, 0
            yield _said(progress_view(progress, after))
        silent += 1
        if silent % _KEEP_ALIVE_POLLS == 0:
            yield ": alive\n\n"
        await asyncio.sleep(_POLL_S)
    yield ": the service ends, and the job has not ended yet\n\n"


async def _progress_elsewhere(row: Job, elsewhere: Callable[[Job], JobProgress | None]) -> JobProgress | None:
    try:
        return await asyncio.to_thread(elsewhere, row)
    except SQLAlchemyError:  # the next look says that the database does not answer
        return None


def _said(event: Stored | ProgressEvent) -> str:
    return f"id: {event.id}\nevent: {event.kind}\ndata: {event.model_dump_json(by_alias=True)}\n\n"

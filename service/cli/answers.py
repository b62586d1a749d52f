"""Models of the service's answers, for the answers whose views in the API cannot be imported without its server."""

from __future__ import annotations

from pydantic import BaseModel, JsonValue

from loopwright.service.api.job_views import LockView
from loopwright.service.states.job_state import JobState


class ProgressShown(BaseModel):
    """How far a job is: the fraction done, and the expected plant time to the end, s (None: not known)."""

    stage: str | None
    progress: float
    remaining_plant_time_s: float | None


class StageDoneShown(BaseModel):
    """A stage has ended with a result. plant_time_s: the plant time of the job so far, s."""

    stage: str
    plant_time_s: float
    result: dict[str, JsonValue] | None


class NoteShown(BaseModel):
    """A note for the user."""

    text: str


class StateShown(BaseModel):
    """The job has a new state."""

    state: str


ShownEvent = ProgressShown | StageDoneShown | NoteShown | StateShown
SHOWN_EVENTS: dict[str, type[ShownEvent]] = {
    "progress": ProgressShown,
    "stage_done": StageDoneShown,
    "note": NoteShown,
    "state": StateShown,
}
"""The events of GET /jobs/{id}/events that the commands show, by kind."""


class JobAnswer(BaseModel):
    """As much of a job as tells whether it is over."""

    state: JobState


class LockAnswer(BaseModel):
    """The answer to POST /loops/{tag}/lock."""

    locked: LockView
    note: str | None


class UnlockAnswer(BaseModel):
    """The answer to POST /loops/{tag}/unlock; was_locked is None where the loop was not locked."""

    was_locked: LockView | None


class FleetLoop(BaseModel):
    """One loop of a batch."""

    loop: str
    state: str
    job: str | None
    reason: str | None


class BatchSummaryShown(BaseModel):
    """A batch, as GET /batches returns it. counts: the number of loops in each state."""

    id: str
    url: str
    state: str
    detail: str | None
    counts: dict[str, int]
    by: str
    created_at: str


class BatchShown(BatchSummaryShown):
    """A batch, as GET /batches/{id} returns it."""

    loops: list[FleetLoop]

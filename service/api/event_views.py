"""The events of a job: one form for each kind, the same in the stream and in the list."""

from __future__ import annotations

import json
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, JsonValue, RootModel, ValidationError

from loopwright.service.api.openapi_document import Schema, schemas_of
from loopwright.service.live.snapshot import JobProgress
from loopwright.service.states.job_state import JobState
from loopwright.service.store.clock import now
from loopwright.service.store.jobs import JobEvent
from loopwright.tuning.reasons import Reason


class _Event(BaseModel):
    model_config = ConfigDict(populate_by_name=True)

    id: int = Field(description="Number of the event in its job, from 1", examples=[7])
    at: str = Field(description="UTC, ISO 8601, wall time", examples=["2026-01-31T12:00:00.000Z"])
    plant_time_s: float = Field(description="Plant time of the job so far, s", examples=[22.7])


class StateEvent(_Event):
    """The job has another state."""

    kind: Literal["state"]
    state: JobState
    previous: JobState | None = Field(default=None, alias="from", description="The state before; null: it was made")
    by: str = Field(description="Who did it, as given in the request, or service", examples=["night shift"])
    reason: Reason | None = Field(default=None, description="Why there is no proposal; from the closed list")
    detail: str | None = Field(default=None, description="The numbers behind the reason")


class StageStartedEvent(_Event):
    """A stage has begun."""

    kind: Literal["stage_started"]
    stage: str = Field(examples=["relay"])
    expected_plant_time_s: float = Field(description="Expected plant time of this stage, s", examples=[20.0])
    remaining_plant_time_s: float = Field(
        description="Expected plant time from here to the end of the job, s", examples=[50.0]
    )


class StageDoneEvent(_Event):
    """A stage has ended with a result."""

    kind: Literal["stage_done"]
    stage: str = Field(examples=["relay"])
    stage_time_s: float | None = Field(default=None, description="Plant time that it took, s; null: not stored")
    result: dict[str, JsonValue] | None = Field(description="Result of the stage; times in s, gains in ISA form")


class NoteEvent(_Event):
    """A note for the operator."""

    kind: Literal["note"]
    stage: str | None = Field(default=None, description="The stage in which it was made")
    text: str


class ResumedEvent(_Event):
    """The job goes on after the service that ran it had ended."""

    kind: Literal["resumed"]
    attempt: int = Field(description="Number of this attempt", examples=[2])
    text: str


class LoopFoundEvent(_Event):
    """How the loop was found after an attempt that was cut off, or whose restoration was not confirmed."""

    kind: Literal["loop_found"]
    text: str


class AbortRequestedEvent(_Event):
    """Somebody has stopped the job, or the service has."""

    kind: Literal["abort_requested"]
    by: str = Field(examples=["operator A"])


class DecisionBegunEvent(_Event):
    """A decision is about to write to the controller."""

    kind: Literal["decision_begun"]
    decision: Literal["accept", "rollback", "unknown"] = Field(
        description="unknown: the database was restored, and a decision may have been made that is not in it"
    )
    by: str = Field(examples=["operator A"])
    detail: str | None = None


class AcknowledgedEvent(_Event):
    """Somebody answers for a loop whose restoration is not confirmed."""

    kind: Literal["acknowledged"]
    by: str = Field(examples=["operator A"])


class SamplesDeletedEvent(_Event):
    """The samples of the job were deleted; its result stays."""

    kind: Literal["samples_deleted"]
    text: str


class ProgressEvent(_Event):
    """How far the job has come. It is not stored, and therefore in the stream alone."""

    id: int = Field(description="Number of the latest stored event before it, 0 where there is none", examples=[7])
    kind: Literal["progress"]
    stage: str | None = Field(description="The present stage", examples=["relay"])
    progress: float = Field(ge=0, le=1, description="Fraction of the expected plant time, 0 to 1", examples=[0.42])
    remaining_plant_time_s: float | None = Field(
        description="Expected plant time to the end, s; null: not known", examples=[31.2]
    )
    remaining_wall_time_s: float | None = Field(
        description="The same in wall time, s, at the pace that the plant had so far; null: not known", examples=[31.2]
    )


Stored = (
    StateEvent | StageStartedEvent | StageDoneEvent | NoteEvent | ResumedEvent | LoopFoundEvent | AbortRequestedEvent
    | DecisionBegunEvent | AcknowledgedEvent | SamplesDeletedEvent
)  # fmt: skip


class StoredEventView(RootModel[Annotated[Stored, Field(discriminator="kind")]]):
    """An event of a job that is stored."""


class JobEventView(RootModel[Annotated[Stored | ProgressEvent, Field(discriminator="kind")]]):
    """An event of a job, as the stream has it."""


STREAMED_EVENT: dict[str, object] = {
    "type": "object",
    "properties": {
        "id": {"type": "string"},
        "event": {"type": "string"},
        "data": {
            "type": "string",
            "contentMediaType": "application/json",
            "contentSchema": {"$ref": "#/components/schemas/JobEventView"},
        },
    },
}
"""An event of the stream, as server-sent events have it."""


def event_view(event: JobEvent) -> StoredEventView:
    """The view of a stored event. One that an older or a newer version has stored in a form of its own is a note."""
    common = {"id": event.seq, "at": event.at, "plant_time_s": event.plant_time_s}
    try:
        return StoredEventView.model_validate(event.shown() | common | {"kind": event.kind})
    except ValidationError:
        text = f"{event.kind}: {json.dumps(event.data)}"
        return StoredEventView.model_validate(common | {"kind": "note", "text": text})


def progress_view(found: JobProgress, after: int) -> ProgressEvent:
    """How far a job has come now. after: number of its latest stored event."""
    return ProgressEvent(
        id=after,
        kind="progress",
        at=now(),
        plant_time_s=found.plant_time_s,
        stage=found.stage,
        progress=found.progress,
        remaining_plant_time_s=found.remaining_plant_time_s,
        remaining_wall_time_s=found.remaining_wall_time_s,
    )


def schemas() -> dict[str, Schema]:
    """The schemas of the events of a stream by name, which FastAPI does not know of."""
    return schemas_of(JobEventView)

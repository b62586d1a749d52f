"""The messages of the live stream. What is not known is null, never 0. Times of day are seconds since 1970 UTC."""

from __future__ import annotations

from collections.abc import Mapping

from pydantic import BaseModel, Field, JsonValue

from loopwright.service.states.job_state import JobState

RETRY_MS = 2000
"""Time after which a client whose stream was cut off connects again, ms."""


class Hello(BaseModel):
    """The first message."""

    gateway: str = Field(description="Name of the gateway that answers")
    version: str
    now_s: float = Field(description="Wall time of the service, s")
    loops: list[str] = Field(description="The loops whose samples and events are sent")
    back_s: float = Field(description="How far the first samples go back, s")


class LastJob(BaseModel):
    """The latest job of a loop; dry runs do not count."""

    url: str
    state: JobState


class OldValues(BaseModel):
    """Values of a loop that are not present ones."""

    pv: float | None = Field(description="PV units")
    sp: float | None = Field(description="PV units")
    mv: float | None = Field(description="Percent")
    mode: str | None = Field(description="off, manual, automatic or experiment")


class LoopValues(BaseModel):
    """What was heard of a loop last."""

    tag: str
    pv: float | None = Field(
        description="PV units; null, as set-point, MV and mode, where the last sample is old: then `last` has it"
    )
    sp: float | None = Field(description="PV units")
    mv: float | None = Field(description="Percent")
    mode: str | None = Field(description="off, manual, automatic or experiment")
    age_s: float | None = Field(description="Age of the last sample, s; null: no sample came")
    under_test: bool | None = Field(description="Whether a tuner, this service or another, has a session open")
    on_trial: bool | None = Field(description="Whether gains are on trial")
    no_data: str | None = Field(description="Why there are no values; null: there are")
    last: OldValues | None = Field(
        default=None,
        description="The last values, `age_s` ago, where no values are present; null: they are, or none came",
    )


class LiveLoopRow(LoopValues):
    """The present state of a loop."""

    gateway: str = Field(description="The gateway that has the loop")
    job: str | None = Field(description="URL of the job that has the loop")
    last_job: LastJob | None
    locked_since: str | None = Field(
        default=None, description="Since when the loop is locked: UTC, ISO 8601, wall time; null: it is not"
    )


class Loops(BaseModel):
    """The present state of all loops, once a second."""

    now_s: float
    loops: list[LiveLoopRow]


class BusView(BaseModel):
    """A bus of a gateway. up: null where the bus is not listened to, or not yet, or is of a gateway that does not
    answer."""

    gateway: str
    bus: str
    up: bool | None
    why: str | None = Field(description="Why there is no data of the bus; null: there is")


class Buses(BaseModel):
    """The buses, when something has changed."""

    buses: list[BusView]


class Samples(BaseModel):
    """Samples of a loop, as columns of equal length.

    past: whether these are the samples from before the stream began; else they follow those sent before.
    gap_before: positions, from 0, of the samples before which samples are missing.
    """

    tag: str
    past: bool
    n: list[int] = Field(description="Number of the sample on the bus")
    at_s: list[float] = Field(description="Wall time, s")
    sp: list[float | None] = Field(description="PV units")
    pv: list[float | None] = Field(description="PV units")
    mv: list[float | None] = Field(description="Percent")
    mode: list[int | None] = Field(description="0 off, 1 manual, 2 automatic, 3 experiment")
    gap_before: list[int]


class LiveJob(BaseModel):
    """A job that is queued or running. The progress of another gateway's is a second old."""

    id: str
    url: str
    loop: str
    gateway: str
    state: JobState
    dry_run: bool
    by: str
    stage: str | None
    progress: float | None = Field(description="Fraction of the expected plant time, 0 to 1")
    remaining_plant_time_s: float | None
    remaining_wall_time_s: float | None
    plant_time_s: float
    stopping: bool = Field(description="Whether somebody has asked the job to stop")


class LiveJobs(BaseModel):
    """The live jobs of every gateway, when something has changed."""

    jobs: list[LiveJob]


class JobHappening(BaseModel):
    """An event of a job, as GET /jobs/{id}/events has it."""

    job: str
    loop: str
    seq: int = Field(description="Number of the event in the job")
    kind: str
    at: str = Field(description="UTC, ISO 8601")
    plant_time_s: float
    data: Mapping[str, JsonValue]


def event(name: str, message: BaseModel, id_: str | None = None) -> str:
    """Returns a message as a server-sent event."""
    head = "" if id_ is None else f"id: {id_}\n"
    return f"{head}event: {name}\ndata: {message.model_dump_json()}\n\n"

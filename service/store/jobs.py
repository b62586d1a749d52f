"""Jobs and their events as the store hands them out: frozen, and typed to the edges."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from enum import StrEnum
from typing import TYPE_CHECKING, NamedTuple, TypedDict, TypeVar

from loopwright.service.jsonable import JsonObject, number
from loopwright.service.results import FastResult, FiveStageResult
from loopwright.service.states.job_state import JobState
from loopwright.tuning.reasons import Reason

if TYPE_CHECKING:  # computations and commands know jobs, and have no store
    from loopwright.service.store.tables import JobRow

Word = TypeVar("Word", bound=StrEnum)


class JobColumns(TypedDict, total=False):
    """What a transaction may set of a job's row, besides what the store keeps itself."""

    attempt: int
    detail: str
    false_pv: bool
    found: Mapping[str, object]
    restore_unconfirmed: bool
    previous_gains: Mapping[str, object]
    plant_time_s: float
    reason: str
    restored: Mapping[str, object]
    result: FastResult | FiveStageResult | None
    session: int | None
    stage: str
    stage_times_s: Mapping[str, float]


class UnknownWord(ValueError):
    """A row holds a word that this version does not know."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Job:
    """A job as stored. Times of day are UTC, ISO 8601; the columns are explained in `service.store.tables`."""

    number: int
    id: str
    loop: str
    state: JobState
    dry_run: bool
    request: JsonObject
    by: str
    created_at: str
    started_at: str | None
    ended_at: str | None
    stage: str | None
    plant_time_s: float
    stage_times_s: dict[str, float] | None
    reason: Reason | None
    detail: str | None
    previous_gains: JsonObject | None
    restored: JsonObject | None
    result: FastResult | FiveStageResult | None
    host: str
    version: str
    attempt: int
    found: JsonObject | None
    session: int | None
    restore_unconfirmed: bool
    false_pv: bool
    stop_reason: Reason | None

    @classmethod
    def from_row(cls, row: JobRow) -> Job:
        """Raises UnknownWord."""
        columns = {field.name: getattr(row, field.name) for field in fields(cls)}
        columns["state"] = _word(JobState, row.state, row.id)
        for name in ("reason", "stop_reason"):
            if columns[name] is not None:
                columns[name] = _word(Reason, columns[name], row.id)
        return cls(**columns)


class StageBegun(NamedTuple):
    """A stage that has begun.

    expected_s: the plant time that the stage is expected to take, s.
    remaining_s: the plant time that the stages after it are expected to take, s.
    """

    stage: str
    expected_s: float
    remaining_s: float


class StageEnded(NamedTuple):
    """A stage that has ended. result: its result as stored.  stage_time_s: the plant time that it took, s; 0 where
    it is not stored."""

    stage: str
    result: JsonObject | None
    stage_time_s: float


@dataclass(frozen=True, slots=True, kw_only=True)
class JobEvent:
    """One thing that happened in a job; seq counts from 1 within the job."""

    job_id: str
    seq: int
    at: str
    plant_time_s: float
    kind: str
    data: JsonObject

    def stage_begun(self) -> StageBegun | None:
        """Returns what the event says of a stage that has begun; None for an event of another kind."""
        if self.kind != "stage_started":
            return None
        return StageBegun(str(self.data["stage"]), number(self.data["expected_s"]), number(self.data["remaining_s"]))

    def shown(self) -> JsonObject:
        """Returns what the event says in the names of the API: times that are plant time are called so, and what
        remains is to the end of the job, as everywhere."""
        begun = self.stage_begun()
        if begun is None:
            return self.data
        remaining_s = begun.expected_s + begun.remaining_s
        return {
            "stage": begun.stage, "expected_plant_time_s": begun.expected_s, "remaining_plant_time_s": remaining_s,
        }  # fmt: skip

    def stage_ended(self) -> StageEnded | None:
        """Returns what the event says of a stage that has ended with a result; None for an event of another kind."""
        if self.kind != "stage_done":
            return None
        result = self.data.get("result")
        time_s = number(self.data.get("stage_time_s", 0.0))
        return StageEnded(str(self.data["stage"]), result if isinstance(result, dict) else None, time_s)

    def note(self) -> str | None:
        """Returns the text of a note; None for an event of another kind."""
        return str(self.data["text"]) if self.kind == "note" else None


def _word(kind: type[Word], value: str, job_id: str) -> Word:
    try:
        return kind(value)
    except ValueError:
        known = ", ".join(kind)
        raise UnknownWord(f"job {job_id} holds {value!r}, which is no {kind.__name__} ({known})") from None

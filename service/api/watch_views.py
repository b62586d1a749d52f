"""The view of the monitoring of a loop after gains were accepted."""

from __future__ import annotations

from typing import Literal

from pydantic import BaseModel, Field

from loopwright.service.states.acceptance_watch import (
    CHANGES,
    AcceptanceWatch,
    Trouble,
    TroubleKind,
    WatchedChange,
    WatchEnd,
    instead_in_words,
)
from loopwright.service.states.job_state import JobState
from loopwright.tuning.operation.change_findings import ChangeState, DifferenceKind, OtherPlant
from loopwright.tuning.operation.model_conclusion import ModelState


class InsteadView(BaseModel):
    """What fits operation instead of the model."""

    kind: DifferenceKind
    message: str = Field(examples=["a second path acts 53.2 s later, with 43 +- 1.2 % of the gain of the model"])
    size: float = Field(
        description="gain: the gain over that of the model, less 1; second_path: its gain over that of the model; "
        "dead_time: by how much the dead time is longer, s",
        examples=[0.43],
    )
    deviation: float = Field(description="Standard deviation of `size`", examples=[0.006])
    delay_s: float | None = Field(description="By how much a second path acts later, s; null: of another kind")
    Ms: float = Field(description="Ms of the accepted gains with it; 100 where it is larger or the loop is not stable")

    @classmethod
    def of(cls, found: OtherPlant) -> InsteadView:
        return cls(
            kind=found.kind,
            message=instead_in_words(found),
            size=found.size,
            deviation=found.deviation,
            delay_s=found.delay_s if found.kind is DifferenceKind.SECOND_PATH else None,
            Ms=found.Ms,
        )


class WatchedChangeView(BaseModel):
    """A change of normal operation that was compared with the model."""

    at_s: float = Field(description="Its first move, wall time, seconds since 1970 UTC", examples=[1769860830.5])
    size: float = Field(description="Largest deviation of the set-point from before, PV units")
    state: ChangeState = Field(
        description="confirmed: the model explains it; differs: it shows another plant; disturbed: neither the model "
        "nor an alternative explains it; not_enough_excitation: it tells too little"
    )
    residual: float = Field(description="What the model leaves of PV, in standard deviations of the noise")
    load: bool = Field(description="Whether one step of the load explains what the model leaves")
    instead: InsteadView | None = Field(description="What fits this change alone instead; null: nothing that is clear")

    @classmethod
    def of(cls, change: WatchedChange) -> WatchedChangeView:
        found = change.compared
        return cls(
            at_s=change.at_s,
            size=found.size,
            state=found.state,
            residual=found.residual,
            load=found.load,
            instead=None if found.best is None else InsteadView.of(found.best),
        )


class WatchTroubleView(BaseModel):
    """What went wrong while the loop was monitored."""

    kind: TroubleKind
    at: str = Field(description="UTC, ISO 8601, wall time", examples=["2026-01-31T12:00:00.000Z"])
    text: str = Field(examples=["PV went above its limit of 51 degC under the new gains"])
    rolled_back: bool | None = Field(
        description="Whether monitoring has put the previous gains back; null: not decided yet"
    )
    reason: str | None = Field(description="Why it has not; null: it has")

    @classmethod
    def of(cls, trouble: Trouble) -> WatchTroubleView:
        return cls(**trouble.model_dump())


class MonitoringView(BaseModel):
    """The monitoring of a loop after gains were accepted: operation compared with the model of the proposal, from
    what is heard alone."""

    verdict: ModelState = Field(
        description="open: operation does not say yet; confirmed: at least one change confirms the model; mismatch: "
        "two changes at least show the same other plant"
    )
    message: str = Field(examples=["The model is confirmed by 3 changes of normal operation."])
    since: str = Field(description="UTC, ISO 8601, wall time", examples=["2026-01-31T12:00:00.000Z"])
    active: bool = Field(description="Whether the loop is still monitored")
    end: WatchEnd | None = Field(description="Why monitoring has ended; null: it goes on")
    ended_at: str | None = Field(description="UTC, ISO 8601, wall time")
    no_data: str | None = Field(
        description="Why there is no data of the loop at present; null: there is, or monitoring has ended"
    )
    requested: int = Field(description="Number of changes that are to be compared", examples=[CHANGES])
    confirmed: int = Field(description="Changes that confirm the model", examples=[3])
    changes: list[WatchedChangeView] = Field(description="The changes compared so far, oldest first")
    instead: InsteadView | None = Field(description="What fits instead, of a mismatch; null: there is none")
    auto_rollback: bool = Field(description="Whether the previous gains are put back where something goes wrong")
    auto_rollback_off: str | None = Field(
        description="Why they are not put back any more; null: they are, if asked for"
    )
    trouble: WatchTroubleView | None = Field(description="What went wrong; null: nothing")
    action: Literal["rollback"] | None = Field(
        description="What the operator may do about it: `POST /jobs/{id}/rollback`; null: nothing needs to be done"
    )

    @classmethod
    def of(cls, watch: AcceptanceWatch, state: JobState) -> MonitoringView:
        found = watch.conclusion()
        bad = found.state is ModelState.MISMATCH or watch.trouble is not None
        return cls(
            verdict=found.state,
            message=watch.message,
            since=watch.since,
            active=watch.end is None,
            end=watch.end,
            ended_at=watch.ended_at,
            no_data=watch.no_data if watch.end is None else None,
            requested=CHANGES,
            confirmed=found.confirmed,
            changes=[WatchedChangeView.of(each) for each in watch.changes],
            instead=None if found.instead is None else InsteadView.of(found.instead),
            auto_rollback=watch.auto_rollback,
            auto_rollback_off=watch.auto_rollback_off,
            trouble=None if watch.trouble is None else WatchTroubleView.of(watch.trouble),
            action="rollback" if bad and state is JobState.ACCEPTED else None,
        )

"""The route of the history of a loop, as it was heard on its bus."""

from __future__ import annotations

import time
from datetime import UTC, datetime
from typing import Annotated

import numpy as np
from fastapi import APIRouter, Path, Query
from fastapi.exceptions import RequestValidationError
from pydantic import BaseModel, Field

from loopwright.protocol.profile import Mode
from loopwright.service.api import problems
from loopwright.service.api.routes import new_router
from loopwright.service.inputs.config import LoopConfig
from loopwright.service.jobs.loop_directory import LoopDirectory
from loopwright.service.listening.bins import Bins, decimals
from loopwright.service.listening.listening import History, Listening
from loopwright.service.results import GainsView
from loopwright.tuning.gains import Gains

USUAL_S, LONGEST_S = 3600.0, 8 * 86_400.0
MAX_POINTS = 5000
_UNIX = "seconds since 1970 UTC, wall time"
_UNKNOWN = "null where it is not known for all samples of the bin"


class GapView(BaseModel):
    """A time in which samples are missing: nothing is known of it, and no line is to be drawn across."""

    from_s: float = Field(description=f"The last sample before, {_UNIX}", examples=[1769860830.5])
    to_s: float = Field(description=f"The first sample after, {_UNIX}", examples=[1769860843.1])


class DisturbedView(BaseModel):
    """A time in which a neighbour was under test: what PV did then may be its doing."""

    from_s: float = Field(description=f"Begin of its test, {_UNIX}", examples=[1769860830.5])
    to_s: float = Field(description=f"End of its test, or of the time asked for, {_UNIX}", examples=[1769860913.1])
    loop: str = Field(description="Tag of the neighbour", examples=["TIC-102"])


class HistoryView(BaseModel):
    """The history of a loop as columns of equal length, one entry for each bin of consecutive samples. A bin of one
    sample has the values of that sample, as a job stores them."""

    loop: str = Field(examples=["TIC-101"])
    pv_unit: str = Field(description="Unit of PV and SP", examples=["degC"])
    from_s: float = Field(description=f"Begin of the time asked for, {_UNIX}", examples=[1769860800.0])
    to_s: float = Field(description=f"End of the time asked for, {_UNIX}", examples=[1769864400.0])
    at_s: list[float] = Field(description=f"First sample of the bin, {_UNIX}")
    until_s: list[float] = Field(description=f"Last sample of the bin, {_UNIX}")
    sample_number: list[int] = Field(description="Number of the first sample, as the plant counts them on the bus")
    samples: list[int] = Field(description="Number of samples in the bin")
    pv_min: list[float | None] = Field(description="Smallest PV, PV units")
    pv_max: list[float | None] = Field(description="Largest PV, PV units")
    pv_mean: list[float | None] = Field(description="Mean PV, PV units; null: not every PV was a number")
    mv_min: list[float | None] = Field(description="Smallest MV, percent")
    mv_max: list[float | None] = Field(description="Largest MV, percent")
    mv_mean: list[float | None] = Field(description="Mean MV, percent; null: not every MV was a number")
    sp: list[float | None] = Field(description=f"Set-point at the last sample, PV units; {_UNKNOWN}")
    mode: list[str | None] = Field(
        description=f"off, manual, automatic or experiment, at the last sample; {_UNKNOWN}", examples=[["automatic"]]
    )
    gains: list[int | None] = Field(
        description=f"Gains in effect at the last sample, as position in `gain_sets` from 0; {_UNKNOWN}"
    )
    gain_sets: list[GainsView] = Field(description="The sets of gains that were in effect")
    incomplete: list[bool] = Field(description="True: samples are missing in the bin, or just before it")
    gaps: list[GapView] = Field(
        description="Times in which samples are missing. Where bins were put together to keep to `points`, gaps that "
        "are shorter than a bin are left out (see `incomplete`); of a gap within a bin of the memory (4 s, or 32 s for "
        "what is older than 8 h) the time of the bin is given"
    )
    disturbed: list[DisturbedView] = Field(
        description="Times in which neighbours were under test: loops of the same area, and those whose outer_loop "
        "this loop is"
    )
    no_data: str | None = Field(
        description="Why there is no data of the loop at present; null: there is",
        examples=["a bus of the kind slcan cannot be opened by a second process"],
    )


def router(directory: LoopDirectory, listening: Listening) -> APIRouter:
    """A router with GET /loops/{tag}/history."""
    routes = new_router("loops")

    @routes.get(
        "/loops/{tag}/history",
        summary="PV, MV, set-point, mode and gains of a loop on its bus, in normal operation and under test",
        responses=problems.responses(404, 422, 503),
    )
    def get_history(
        tag: Annotated[str, Path(description="Tag of the loop", examples=["TIC-101"])],
        from_: Annotated[
            datetime | None,
            Query(
                alias="from",
                description="Begin, ISO 8601 (UTC unless it says otherwise) or seconds since 1970; default: an hour "
                "before the end",
                examples=["2026-01-31T12:00:00Z"],
            ),
        ] = None,
        to: Annotated[
            datetime | None, Query(description="End; default: now", examples=["2026-01-31T13:00:00Z"])
        ] = None,
        points: Annotated[int, Query(ge=1, le=MAX_POINTS, description="Maximum number of bins", examples=[600])] = 600,
    ) -> HistoryView:
        config, _ = directory.owner(tag)
        now_s = time.time()
        to_s = min(_seconds(to, now_s), now_s)
        from_s = _seconds(from_, to_s - USUAL_S)
        if not 0.0 < to_s - from_s <= LONGEST_S:
            why = f"must be before `to` (and now), by {LONGEST_S / 86_400:g} days at most"
            raise RequestValidationError([{"type": "value_error", "loc": ("query", "from"), "msg": why}])
        disturbed = directory.disturbed(tag, from_s, to_s)
        return _view(config, listening.history(tag, from_s, to_s, points), from_s, to_s, disturbed)

    return routes


def _seconds(at: datetime | None, default_s: float) -> float:
    if at is None:
        return default_s
    return (at if at.tzinfo is not None else at.replace(tzinfo=UTC)).timestamp()


def _view(
    config: LoopConfig, found: History, from_s: float, to_s: float, disturbed: list[tuple[float, float, str]]
) -> HistoryView:
    bins = found.rows.bins
    names = {mode.value: mode.name.lower() for mode in Mode}
    return HistoryView(
        loop=config.tag,
        pv_unit=config.pv_unit,
        from_s=round(from_s, 3),
        to_s=round(to_s, 3),
        at_s=_milliseconds(bins, "at_s"),
        until_s=_milliseconds(bins, "until_s"),
        sample_number=bins["n"].tolist(),
        samples=bins["count"].tolist(),
        **{name: decimals(bins, name) for name in ("pv_min", "pv_max", "pv_mean", "mv_min", "mv_max", "mv_mean")},
        sp=decimals(bins, "sp"),
        mode=[names.get(mode) for mode in bins["mode"].tolist()],
        gains=[number - 1 if number else None for number in bins["gains"].tolist()],
        gain_sets=[GainsView.of(Gains(*each)) for each in found.rows.sets],
        incomplete=(bins["gap"] > 0).tolist(),
        gaps=[GapView(from_s=round(begin, 3), to_s=round(end, 3)) for begin, end in found.rows.gaps],
        disturbed=[DisturbedView(from_s=round(a, 3), to_s=round(b, 3), loop=loop) for a, b, loop in disturbed],
        no_data=found.no_data,
    )


def _milliseconds(bins: Bins, name: str) -> list[float]:
    values: list[float] = np.round(bins[name], 3).tolist()
    return values

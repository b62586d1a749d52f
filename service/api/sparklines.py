"""The route of the sparklines: the last minutes of all loops in one answer."""

from __future__ import annotations

import time
from typing import Annotated

import numpy as np
from fastapi import APIRouter, Query
from pydantic import BaseModel, Field

from loopwright.service.api import problems
from loopwright.service.api.routes import new_router
from loopwright.service.jobs.loop_directory import LoopDirectory
from loopwright.service.listening.bins import Bins, decimals
from loopwright.service.listening.listening import Listening

LONGEST_S, MAX_POINTS = 86_400.0, 500


class SparklineView(BaseModel):
    """The last minutes of a loop, as columns of equal length, one entry for each bin of consecutive samples. Where
    samples are missing there is an entry of nulls."""

    tag: str = Field(examples=["TIC-101"])
    at_s: list[float | None] = Field(description="Last sample of the bin, seconds since 1970 UTC; null: a gap")
    pv_min: list[float | None] = Field(description="Smallest PV, PV units")
    pv_max: list[float | None] = Field(description="Largest PV, PV units")
    sp: list[float | None] = Field(description="Set-point at the last sample, PV units; null: not known, or a gap")


class SparklinesView(BaseModel):
    """The last minutes of all loops of this gateway, from memory alone."""

    from_s: float = Field(description="Begin, seconds since 1970 UTC", examples=[1769860530.5])
    to_s: float = Field(description="End: now, seconds since 1970 UTC", examples=[1769860830.5])
    loops: list[SparklineView] = Field(description="Sorted by tag; a loop without data has empty columns")


def router(directory: LoopDirectory, listening: Listening) -> APIRouter:
    """A router with GET /history."""
    routes = new_router("loops")

    @routes.get(
        "/history", summary="PV and set-point of all loops in the last minutes", responses=problems.responses(422)
    )
    def list_sparklines(
        seconds: Annotated[
            float,
            Query(gt=0, le=LONGEST_S, allow_inf_nan=False, description="How far to go back, s", examples=[300]),
        ] = 300.0,
        points: Annotated[
            int, Query(ge=1, le=MAX_POINTS, description="Maximum number of bins of a loop", examples=[60])
        ] = 60,
    ) -> SparklinesView:
        to_s = time.time()
        found = [
            _sparkline(tag, listening.memory(tag, to_s - seconds, to_s, points).bins) for tag in sorted(directory.loops)
        ]
        return SparklinesView(from_s=round(to_s - seconds, 3), to_s=round(to_s, 3), loops=found)

    return routes


def _sparkline(tag: str, bins: Bins) -> SparklineView:
    gaps = [n for n in np.flatnonzero(bins["gap"]).tolist() if n]
    at_s: list[float | None] = np.round(bins["until_s"], 3).tolist()
    columns = at_s, decimals(bins, "pv_min"), decimals(bins, "pv_max"), decimals(bins, "sp")
    for column in columns:
        for n in reversed(gaps):
            column.insert(n, None)
    return SparklineView(tag=tag, at_s=columns[0], pv_min=columns[1], pv_max=columns[2], sp=columns[3])

"""The routes of what is computed of a job after its end: its record with the model, and the gains from robust to
fast."""

from __future__ import annotations

import asyncio
from typing import Annotated

import numpy as np
from fastapi import APIRouter, Query
from fastapi.concurrency import run_in_threadpool
from pydantic import BaseModel, Field

from loopwright.protocol.profile import Mode
from loopwright.service.api import problems
from loopwright.service.api.routes import JobId, new_router
from loopwright.service.errors import Conflict, Stopping
from loopwright.service.execution.computing.pool import NotWanted
from loopwright.service.jobs.alternatives import designable
from loopwright.service.jobs.design_curve import DesignCurve
from loopwright.service.jobs.job_figures import JobFigures
from loopwright.service.jobs.job_record import MAX_POINTS, JobRecord, RecordFacts
from loopwright.service.jobs.kept_figures import KeptFigures
from loopwright.service.jobs.manager import Jobs
from loopwright.service.listening.bins import GAP_BEFORE, Bins, decimals
from loopwright.service.store.jobs import Job

_SINCE = "plant time since the first sample, s"


class ExplainedView(BaseModel):
    """What the model says of a record, as columns with one entry for each bin of the record, PV units."""

    model: list[float | None] = Field(description="Mean PV of the model")
    residual_min: list[float | None] = Field(description="Smallest residual, PV less model")
    residual_max: list[float | None] = Field(description="Largest residual, PV less model")
    residual_mean: list[float | None] = Field(description="Mean residual, PV less model")


class RecordView(RecordFacts):
    """The record of a job's last attempt as columns of equal length, one entry for each bin of consecutive samples. A
    bin of one sample has the values of that sample."""

    job: str = Field(examples=["4f0c2a9be113"])
    loop: str = Field(examples=["TIC-101"])
    at_s: list[float] = Field(description=f"First sample of the bin, {_SINCE}")
    until_s: list[float] = Field(description=f"Last sample of the bin, {_SINCE}")
    samples: list[int] = Field(description="Number of samples in the bin")
    sp: list[float | None] = Field(description="Set-point at the last sample, PV units")
    mode: list[str | None] = Field(
        description="off, manual, automatic or experiment, at the last sample", examples=[["experiment"]]
    )
    pv_min: list[float | None] = Field(description="Smallest PV, PV units")
    pv_max: list[float | None] = Field(description="Largest PV, PV units")
    pv_mean: list[float | None] = Field(description="Mean PV, PV units")
    mv_min: list[float | None] = Field(description="Smallest MV, percent")
    mv_max: list[float | None] = Field(description="Largest MV, percent")
    mv_mean: list[float | None] = Field(description="Mean MV, percent")
    gap_before: list[bool] = Field(description="True: samples are missing between this bin and the one before")
    explained: ExplainedView | None = Field(description="The model and the residual; null: there is no model")


class DesignsView(DesignCurve):
    """The curve from robust to fast of a job."""

    job: str = Field(examples=["4f0c2a9be113"])
    loop: str = Field(examples=["TIC-101"])


async def figures_of(jobs: Jobs, figures: KeptFigures, job_id: str) -> tuple[Job, JobFigures]:
    """Returns a job and its figures: the stored ones, or those that all who ask at the same time wait for together.

    Raises NoSuchJob, Conflict (the job is not over), Stopping, Ended.
    """
    row = await run_in_threadpool(jobs.store.get, job_id)
    found = await run_in_threadpool(figures.kept, job_id)
    if found is None:
        future = await run_in_threadpool(figures.asked, row)
        try:
            found = await asyncio.shield(asyncio.wrap_future(future))
        except NotWanted:
            raise Stopping("the service is shutting down") from None
    return row, found


def router(jobs: Jobs, figures: KeptFigures) -> APIRouter:
    """A router with GET /jobs/{job_id}/record and GET /jobs/{job_id}/designs."""
    routes = new_router("jobs")

    @routes.get(
        "/jobs/{job_id}/record",
        summary="The record of a job with its model and what the model leaves, thinned for a plot",
        responses=problems.responses(404, 409, 422, 503),
    )
    async def get_job_record(
        job_id: JobId,
        points: Annotated[int, Query(ge=1, le=MAX_POINTS, description="Maximum number of bins", examples=[600])] = 600,
    ) -> RecordView:
        row, found = await figures_of(jobs, figures, job_id)
        if found.record is None:
            events = await run_in_threadpool(jobs.store.events, job_id)
            deleted = any(event.kind == "samples_deleted" for event in events)
            why = "its samples were deleted" if deleted else f"it ended as {row.state} before its second sample"
            raise Conflict(f"job {job_id} has no record: {why}")
        return _record_view(row, found.record.thinned(points))

    @routes.get(
        "/jobs/{job_id}/designs",
        summary="The gains of fast for each Ms from robust to fast, with their figures, on one model",
        responses=problems.responses(404, 409, 422, 503),
    )
    async def get_designs(job_id: JobId) -> DesignsView:
        row, found = await figures_of(jobs, figures, job_id)
        if found.designs is None:
            events = await run_in_threadpool(jobs.store.events, job_id)
            designable(row, events, has_record=False)  # raises the reason
            raise Conflict(f"no gains could be designed on the model of job {job_id}; the log of the service says why")
        return DesignsView(job=row.id, loop=row.loop, **dict(found.designs))

    return routes


def _record_view(row: Job, record: JobRecord) -> RecordView:
    bins, explained = record.measured, record.explained
    names = {mode.value: mode.name.lower() for mode in Mode}
    return RecordView(
        sample_time_s=record.facts.sample_time_s,
        recorded=record.facts.recorded,
        marks=record.facts.marks,
        model_from=record.facts.model_from,
        noise=record.facts.noise,
        loads=record.facts.loads,
        job=row.id,
        loop=row.loop,
        at_s=_rounded(bins, "at_s"),
        until_s=_rounded(bins, "until_s"),
        samples=bins["count"].tolist(),
        sp=decimals(bins, "sp"),
        mode=[names.get(mode) for mode in bins["mode"].tolist()],
        pv_min=decimals(bins, "pv_min"),
        pv_max=decimals(bins, "pv_max"),
        pv_mean=decimals(bins, "pv_mean"),
        mv_min=decimals(bins, "mv_min"),
        mv_max=decimals(bins, "mv_max"),
        mv_mean=decimals(bins, "mv_mean"),
        gap_before=(bins["gap"] & GAP_BEFORE > 0).tolist(),
        explained=None
        if explained is None
        else ExplainedView(
            model=decimals(explained, "pv_mean"),
            residual_min=decimals(explained, "mv_min"),
            residual_max=decimals(explained, "mv_max"),
            residual_mean=decimals(explained, "mv_mean"),
        ),
    )


def _rounded(bins: Bins, name: str) -> list[float]:
    values: list[float] = np.round(bins[name], 6).tolist()
    return values

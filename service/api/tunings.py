"""Routes over models: the methods, and tunings of a model that was typed in or that a job found."""

from __future__ import annotations

from functools import partial
from typing import Annotated

from fastapi import APIRouter, Path, Query, Request
from fastapi.concurrency import run_in_threadpool

from loopwright.service.api import problems
from loopwright.service.api.bodies import JsonRoute
from loopwright.service.api.computed import Work, computed
from loopwright.service.api.samples import record_columns
from loopwright.service.api.tuning_views import AlternativesView, MethodView, TuningRequest, TuningsView
from loopwright.service.execution.computing.pool import Pool
from loopwright.service.jobs.alternatives import alternatives, redesigned
from loopwright.service.jobs.manager import Jobs
from loopwright.service.jobs.relay_record import relay_record
from loopwright.service.offline import tunings
from loopwright.tuning.fast.procedure import FAST


def router(jobs: Jobs, pool: Pool) -> APIRouter:
    """GET /methods, POST /tunings, GET /jobs/{job_id}/alternatives. pool: who computes."""
    routes = APIRouter(route_class=JsonRoute)

    @routes.get("/methods", tags=["tunings"], summary="The tuning methods")
    def methods() -> list[MethodView]:
        return [MethodView.model_validate(each) for each in tunings.methods_json()]

    @routes.post(
        "/tunings",
        tags=["tunings"],
        summary="Tune a model by one method or all",
        responses=problems.responses(422),
    )
    async def tune(request: TuningRequest, http: Request) -> TuningsView:
        work = partial(tunings.tunings, request.model.plant(), request.method, request.options)
        return TuningsView(**await computed(pool, work, http, lambda: jobs.stopping))

    @routes.get(
        "/jobs/{job_id}/alternatives",
        tags=["jobs"],
        summary="What other methods, or fast for another Ms, make of what the job found",
        responses=problems.responses(404, 409, 422),
    )
    async def job_alternatives(
        http: Request,
        job_id: Annotated[str, Path(description="Id of the job", examples=["4f0c2a9be113"])],
        method: Annotated[
            str | None, Query(description="Only this one; without it all but the slow one, me-pso", examples=["me-pso"])
        ] = None,
        ms: Annotated[
            float | None,
            Query(
                ge=1.2, le=2.0, allow_inf_nan=False, examples=[1.4],
                description="The gains of fast for this Ms instead, from the same record; without `method`",
            ),
        ] = None,
        derivative: Annotated[
            bool | None, Query(description="With `ms`: a PID where it pays; by default as the job had it")
        ] = None,
    ) -> AlternativesView:  # fmt: skip
        if ms is None and derivative is not None:
            raise tunings.BadTuning("derivative is for another ms: give that too")
        if ms is not None and method not in (None, FAST):
            raise tunings.BadTuning(f"ms is for the method fast, not for {method}: leave one of them out")
        work = await run_in_threadpool(wish, job_id, method, ms, derivative)
        return AlternativesView(**await computed(pool, work, http, lambda: jobs.stopping))

    def wish(job_id: str, method: str | None, ms: float | None, derivative: bool | None) -> Work:
        """What is to be computed, with all that it needs of the store."""
        row, events = jobs.store.get(job_id), jobs.store.events(job_id)
        if ms is None:
            return partial(alternatives, row, events, method)
        wanted = bool(row.request.get("derivative")) if derivative is None else derivative
        fast = row.request.get("method") == FAST  # of others the model they found is designed on
        record = relay_record(record_columns(jobs.store.blocks(job_id))) if fast else None
        return partial(redesigned, row, events, record, ms, wanted)

    return routes

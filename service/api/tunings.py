"""Routes for the tuning methods, and for tunings of a given model or of the model that a job found."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from typing import Annotated, Any

from fastapi import APIRouter, Path, Query, Request, Response
from fastapi.concurrency import run_in_threadpool

from loopwright.service.api import problems
from loopwright.service.api.computed import computed
from loopwright.service.api.paging import LINK, Limit, Position, page_of
from loopwright.service.api.routes import new_router
from loopwright.service.api.tuning_views import AlternativesView, MethodView, TuningRequest, TuningsView
from loopwright.service.execution.computing.pool import Pool
from loopwright.service.inputs.plausible import Gain, SetpointWeight, Time
from loopwright.service.jobs.alternatives import alternatives, asked_spec, redesigned
from loopwright.service.jobs.manager import Jobs
from loopwright.service.jobs.stored_record import record_columns, stored_record
from loopwright.service.offline import tunings
from loopwright.service.results import DESIGNED
from loopwright.tuning.fast.design.design import Aim
from loopwright.tuning.fast.design.options import weights_up_to
from loopwright.tuning.fast.relay.procedure import FAST
from loopwright.tuning.rules.registry import METHODS


def router(jobs: Jobs, pool: Pool) -> APIRouter:
    """A router with GET /methods, POST /tunings and GET /jobs/{job_id}/alternatives. pool: computes the tunings."""
    routes = new_router()

    @routes.get(
        "/methods", tags=["tunings"], summary="The tuning methods", responses={**LINK, **problems.responses(422)}
    )
    def list_methods(response: Response, limit: Limit = 1000, cursor: Position = None) -> list[MethodView]:
        found = [MethodView.model_validate(each) for each in tunings.methods_json(METHODS)]
        return list(page_of(response, "/methods", found, limit, cursor))

    @routes.post(
        "/tunings",
        tags=["tunings"],
        summary="Tune a model by one method or all",
        responses=problems.responses(422),
    )
    async def tune_model(request: TuningRequest, http: Request) -> TuningsView:
        work = partial(tunings.tunings, request.model.plant(), request.method, request.options)
        return TuningsView.model_validate(await computed(pool, work, http, lambda: jobs.stopping))

    @routes.get(
        "/jobs/{job_id}/alternatives",
        tags=["jobs"],
        summary="Tunings of the model that a job found, by other methods or by fast for another Ms",
        responses=problems.responses(404, 409, 422),
    )
    async def list_alternatives(
        http: Request,
        job_id: Annotated[str, Path(description="Id of the job", examples=["4f0c2a9be113"])],
        method: Annotated[
            str | None,
            Query(description="Only this method; default: all but me-pso, which is slow", examples=["me-pso"]),
        ] = None,
        Ms: Annotated[
            float | None,
            Query(
                ge=1.2, le=2.0, allow_inf_nan=False, examples=[1.4],
                description="Ms for which fast designs the gains from the same record; not together with `method`",
            ),
        ] = None,
        derivative: Annotated[
            bool | None,
            Query(description="Whether fast may design a PID; only with `Ms`. The default is the option of the job"),
        ] = None,
        aim: Annotated[
            Aim | None,
            Query(description="What the gains are the best for; only with `Ms`. The default is the option of the job"),
        ] = None,
        settling_s: Annotated[
            Time | None,
            Query(
                description="Longest settling time after a set-point step, s, as in a retune: the gains are those for "
                "the smallest Ms up to `Ms` that permits it; only with `Ms`. The default is none, even where the job "
                "asked for one: it is another way to choose an Ms"
            ),
        ] = None,
        mv_peak: Annotated[
            Gain | None,
            Query(
                description="Largest change of MV after a set-point step, percent per PV unit; only with `Ms`. The "
                "default is the option of the job"
            ),
        ] = None,
        noise_gain: Annotated[
            Gain | None,
            Query(
                description="Largest noise gain, percent per PV unit; only with `Ms`. The default is the option of the "
                "job"
            ),
        ] = None,
        setpoint_weight_max: Annotated[
            SetpointWeight | None,
            Query(
                description="Largest set-point weight b of the gains; only with `Ms`. The default is the option of the "
                "job, else 1"
            ),
        ] = None,
    ) -> AlternativesView:  # fmt: skip
        own = {
            "derivative": derivative, "aim": aim, "settling_s": settling_s, "mv_peak": mv_peak,
            "noise_gain": noise_gain, "setpoint_weight_max": setpoint_weight_max,
        }  # fmt: skip
        for name, given in own.items():
            if Ms is None and given is not None:
                raise tunings.BadTuning(f"{name} needs Ms: give Ms too")
        if Ms is not None and method not in (None, FAST):
            raise tunings.BadTuning(f"Ms is an option of fast, not of {method}: leave out Ms or method")
        options: dict[str, Any] = {name: value for name, value in own.items() if value is not None}
        if "setpoint_weight_max" in options:
            options["weights"] = weights_up_to(options.pop("setpoint_weight_max"))
        work = await run_in_threadpool(computation, job_id, method, Ms, options)
        return AlternativesView.model_validate(await computed(pool, work, http, lambda: jobs.stopping))

    def computation(
        job_id: str, method: str | None, Ms: float | None, options: dict[str, Any]
    ) -> Callable[[], Mapping[str, object]]:
        """The computation, with everything that it needs from the store."""
        row, events = jobs.store.get(job_id), jobs.store.events(job_id)
        if Ms is None:
            return partial(alternatives, row, events, method)
        fast = row.request.get("method") in DESIGNED  # other jobs are designed on the model that they found
        record = stored_record(record_columns(jobs.store.blocks(job_id))) if fast else None
        return partial(redesigned, row, events, record, replace(asked_spec(row, Ms), **options))

    return routes

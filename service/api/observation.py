"""The route that answers what the history of a loop tells of its gains. Nothing is changed on the loop; what was found
is kept."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import Annotated

from fastapi import APIRouter, Path, Query, Request
from fastapi.concurrency import run_in_threadpool

from loopwright.service.api import problems
from loopwright.service.api.computed import computed
from loopwright.service.api.routes import new_router
from loopwright.service.errors import Conflict
from loopwright.service.execution.computing.pool import Pool
from loopwright.service.inputs.plausible import Gain, SetpointWeight, Time
from loopwright.service.inputs.request import permitted_weight
from loopwright.service.jobs.manager import Jobs
from loopwright.service.listening.listening import Listening
from loopwright.service.loops.shared_reading import SharedReading
from loopwright.service.observing.hearing import question
from loopwright.service.observing.observed import ObservationView, Question, observed
from loopwright.service.states.loop_state import LoopState
from loopwright.tuning.fast.design.design import Aim, DesignSpec
from loopwright.tuning.fast.design.options import weights_up_to


def router(jobs: Jobs, readings: SharedReading[LoopState | None], listening: Listening, pool: Pool) -> APIRouter:
    """A router with GET /loops/{tag}/observation. readings: the present states of loops.  pool: computes the answer."""
    routes = new_router("loops")

    @routes.get(
        "/loops/{tag}/observation",
        summary="Gains from the set-point changes that operators made: nothing is moved or written on the loop",
        responses=problems.responses(404, 409, 422, 503),
    )
    async def get_observation(
        http: Request,
        tag: Annotated[str, Path(description="Tag of the loop", examples=["TIC-101"])],
        Ms: Annotated[
            float,
            Query(
                ge=1.2, le=2.0, allow_inf_nan=False, examples=[1.4],
                description="Maximum sensitivity for which gains are designed: 1.2 (robust) to 2.0 (fast)",
            ),
        ] = 1.6,
        derivative: Annotated[bool, Query(description="Design a PID where a derivative improves the loop")] = False,
        aim: Annotated[Aim, Query(description="What the gains are the best for, as in a retune")] = Aim.BALANCED,
        settling_s: Annotated[
            Time | None, Query(description="Longest settling time after a set-point step, s, as in a retune")
        ] = None,
        mv_peak: Annotated[
            Gain | None,
            Query(description="Largest change of MV after a set-point step, percent per PV unit, as in a retune"),
        ] = None,
        noise_gain: Annotated[
            Gain | None, Query(description="Largest noise gain, percent per PV unit, as in a retune")
        ] = None,
        setpoint_weight_max: Annotated[
            SetpointWeight | None,
            Query(description="Largest set-point weight b of the gains, as in a retune; at most that of loops.yaml"),
        ] = None,
    ) -> ObservationView:  # fmt: skip
        spec = DesignSpec(Ms, derivative, noise_gain=noise_gain, aim=aim, settling_s=settling_s, mv_peak=mv_peak)
        asked = await run_in_threadpool(asked_of, tag, spec, setpoint_weight_max)
        found = await computed(pool, partial(observed, asked), http, lambda: jobs.stopping)
        return await run_in_threadpool(kept, found, asked)

    def kept(found: ObservationView, asked: Question) -> ObservationView:
        """The answer with what is known of the loop, once this is kept too."""
        jobs.knowledge.observed(found, asked.spec.Ms, asked.state.sample_time_s)
        return found.model_copy(update={"knowledge": jobs.knowledge.of(found.loop, asked.state.gains)})

    def asked_of(tag: str, spec: DesignSpec, setpoint_weight_max: float | None) -> Question:
        """The question, with everything that it needs from the loop and its history."""
        config, host = jobs.directory.owner(tag)
        spec = replace(spec, weights=weights_up_to(permitted_weight(config, setpoint_weight_max)))
        state = readings.of(tag)
        if state is None:
            raise Conflict(f"loop {tag} belongs to gateway {host}, which listens to it: ask there")
        return question(listening, jobs.store, config, state, spec, jobs.directory.disturbers(tag))

    return routes

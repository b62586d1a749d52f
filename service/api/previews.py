"""Routes that preview a retune of one loop or of many. They change nothing."""

from __future__ import annotations

import logging
from dataclasses import replace
from functools import partial
from typing import Annotated

from fastapi import APIRouter, Body, Query

from loopwright.service.api import problems
from loopwright.service.api.routes import Tag, new_router
from loopwright.service.execution.computing.limits import ComputationKind
from loopwright.service.execution.computing.pool import NotWanted, Pool
from loopwright.service.execution.procedures import expected
from loopwright.service.inputs.config import LoopConfig
from loopwright.service.inputs.request import FastRetune, RetuneRequest, narrow
from loopwright.service.jobs.fleet import Fleet, FleetRequest
from loopwright.service.jobs.loop_model import loop_model
from loopwright.service.jobs.manager import Jobs
from loopwright.service.planning.expected import NOTHING_EXPECTED, ExpectedPv
from loopwright.service.planning.obstacles import Now
from loopwright.service.planning.preview import FleetPreview, LastProposal, Preview, fleet_preview, preview
from loopwright.service.states.loop_state import loop_state
from loopwright.service.store import false_pv, loop_locks
from loopwright.service.store.jobs import Job
from loopwright.tuning.reasons import Ended, Failed

log = logging.getLogger(__name__)


def router(jobs: Jobs, fleet: Fleet, pool: Pool) -> APIRouter:
    """A router with POST /loops/{tag}/retune/preview and POST /batches/preview. pool: computes how far PV goes."""
    routes = new_router()

    @routes.post(
        "/loops/{tag}/retune/preview",
        tags=["loops"],
        summary="Preview a retune: its moves, time and limits, and every reason why it would be refused now",
        responses=problems.responses(404, 422, 503),
    )
    def preview_retune(
        tag: Tag,
        options: Annotated[RetuneRequest | None, Body()] = None,
        pv: Annotated[
            bool,
            Query(description="Whether to compute how far PV goes, which can take seconds; false: the rest, at once"),
        ] = True,
    ) -> Preview:
        request = options or FastRetune()
        config, _ = jobs.directory.owner(tag)
        now = _now(jobs, tag, request)
        known = jobs.knowledge.of(tag, None if now.state is None else now.state.gains)
        told = _expected(jobs, pool, config, request, now) if pv else NOTHING_EXPECTED
        return preview(config, request, now, _last(jobs.store.last_models(tag).get(tag)), known, told)

    @routes.post(
        "/batches/preview",
        tags=["batches"],
        summary="Preview a batch from configuration and earlier jobs, without reading the controllers",
        responses=problems.responses(422, 503),
    )
    def preview_batch(request: Annotated[FleetRequest, Body()]) -> FleetPreview:
        options, busy, models = request.each(), jobs.store.busy(), jobs.store.last_models()
        locked, false = _locked(jobs), _not_acknowledged(jobs)
        return fleet_preview([
            preview(
                config,
                options,
                Now(
                    active_job=busy.get(config.tag),
                    locked=locked.get(config.tag),
                    not_acknowledged=false.get(config.tag),
                    stopping=jobs.stopping,
                ),
                _last(models.get(config.tag)),
            )
            for config in fleet.asked(request)
        ])  # fmt: skip

    return routes


def _expected(jobs: Jobs, pool: Pool, config: LoopConfig, request: RetuneRequest, now: Now) -> ExpectedPv:
    """How far PV is expected to go; nothing where no model is known, or no process is to be had for it."""
    state, (narrowed, problems) = now.state, narrow(config, request)
    if state is None or problems or request.dry_run:
        return NOTHING_EXPECTED
    known = loop_model(jobs.store, jobs.knowledge, config, request, state.gains)
    if known is None:
        return NOTHING_EXPECTED
    try:
        work = partial(expected, narrowed, request, state, known)
        return pool.run(ComputationKind.TUNING, work, unwanted=lambda: jobs.stopping)
    except (Failed, NotWanted) as failed:
        log.warning("how far PV of %s would go could not be computed: %s", config.tag, failed)
        return NOTHING_EXPECTED


def _now(jobs: Jobs, tag: str, request: RetuneRequest) -> Now:
    """The present state of the loop. While a job is using it, this is the state that the job will restore."""
    if request.dry_run:
        return Now(stopping=jobs.stopping)
    active = jobs.store.active(tag)
    if active is not None and active.found is not None:
        state, locked = loop_state(active.found), _locked(jobs).get(tag)
        return Now(state, active_job=active.id, locked=locked, stopping=jobs.stopping)
    found = Now(
        active_job=None if active is None else active.id,
        locked=_locked(jobs).get(tag),
        not_acknowledged=jobs.aftercare.not_acknowledged(tag),
        stopping=jobs.stopping,
    )
    try:
        return replace(found, state=jobs.directory.live(tag))
    except Ended as silent:
        return replace(found, silent=silent)


def _locked(jobs: Jobs) -> dict[str, str]:
    """The lock of each locked loop in words: by whom, since when and why."""
    return {tag: loop_locks.words(row) for tag, row in jobs.locking.locks().items()}


def _not_acknowledged(jobs: Jobs) -> dict[str, str]:
    """Which test has found PV of a loop to be false, in words, where nobody has acknowledged that."""
    with jobs.store.reading() as session:
        return {job.loop: false_pv.words(job) for job in false_pv.not_acknowledged(session)}


def _last(row: Job | None) -> LastProposal | None:
    if row is None or row.result is None:
        return None
    return LastProposal.of(row.id, row.ended_at, row.plant_time_s, row.result)

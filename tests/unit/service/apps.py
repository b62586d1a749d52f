"""The application for some jobs; what a test does not give is made for them alone."""

from __future__ import annotations

from collections.abc import Mapping

from fastapi import FastAPI

from loopwright.service.alarms.watch import AlarmWatch
from loopwright.service.api import operations
from loopwright.service.api.app import create_app
from loopwright.service.api.gate.gate import Policy
from loopwright.service.api.services import Services
from loopwright.service.execution.computing.pool import Pool
from loopwright.service.jobs.kept_figures import KeptFigures
from loopwright.service.jobs.manager import Jobs
from loopwright.service.listening.listening import Listening
from loopwright.service.live.live import Live
from loopwright.service.live.other_gateways import OtherGateways
from loopwright.service.live.own_gateway import OwnGateway


def app_of(
    jobs: Jobs,
    policy: Policy | None = None,
    checks: Mapping[str, operations.Check] | None = None,
    pool: Pool | None = None,
    sdo_retries: Mapping[str, int] | None = None,
    listening: Listening | None = None,
    live: Live | None = None,
    figures: KeptFigures | None = None,
    alarms: AlarmWatch | None = None,
    own: OwnGateway | None = None,
    others: OtherGateways | None = None,
) -> FastAPI:
    listening = listening or Listening(jobs.directory.loops, jobs.store, on=False)
    others = others or OtherGateways(jobs.store)
    alarms = alarms or AlarmWatch(jobs, listening, others)
    pool = pool or Pool()
    return create_app(
        Services(
            jobs=jobs,
            policy=policy or Policy(),
            checks=operations.checks(jobs) if checks is None else checks,
            pool=pool,
            sdo_retries={} if sdo_retries is None else sdo_retries,
            listening=listening,
            live=live or Live(jobs, listening, alarms, others),
            figures=figures or KeptFigures(jobs.store, pool),
            alarms=alarms,
            own=own or OwnGateway(jobs, listening),
            others=others,
            streams_over=lambda: False,
        )
    )

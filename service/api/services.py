"""What the routes are served from; it is composed where the process begins."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

from loopwright.service.alarms.watch import AlarmWatch
from loopwright.service.api.gate.gate import Policy
from loopwright.service.api.operations import Check
from loopwright.service.execution.computing.pool import Pool
from loopwright.service.jobs.kept_figures import KeptFigures
from loopwright.service.jobs.manager import Jobs
from loopwright.service.listening.listening import Listening
from loopwright.service.live.live import Live
from loopwright.service.live.other_gateways import OtherGateways
from loopwright.service.live.own_gateway import OwnGateway


@dataclass(frozen=True)
class Services:
    """jobs: they are stopped when the server shuts down.  policy: who may come in, and how much one caller may take.
    checks: the parts of /readyz by name.  pool: processes that compute tunings.
    sdo_retries: SDO retries by bus, as counted in this process.
    own, others: this gateway, and those that share its database.
    streams_over: whether the streams of jobs are to end, although their jobs have not.
    """

    jobs: Jobs
    policy: Policy
    checks: Mapping[str, Check]
    pool: Pool
    sdo_retries: Mapping[str, int]
    listening: Listening
    live: Live
    figures: KeptFigures
    alarms: AlarmWatch
    own: OwnGateway
    others: OtherGateways
    streams_over: Callable[[], bool]

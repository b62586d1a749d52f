"""The Prometheus metrics: the counters of this process, and the jobs and loops, which are counted at each scrape."""

from __future__ import annotations

from collections import Counter as Tally
from collections.abc import Callable, Iterable, Mapping
from importlib.metadata import version
from platform import python_version

from prometheus_client import CollectorRegistry, generate_latest
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric
from prometheus_client.registry import Collector
from sqlalchemy import func, select
from sqlalchemy.exc import SQLAlchemyError
from sqlalchemy.orm import Session

from loopwright.service.alarms.alarm import Priority
from loopwright.service.inputs.config import LoopConfig
from loopwright.service.states.job_state import ACTIVE, JobState
from loopwright.service.store import unconfirmed_restorations
from loopwright.service.store.live_jobs import latest_tests
from loopwright.service.store.store import Store
from loopwright.service.store.tables import JobRow
from loopwright.service.telemetry.metrics import OF_THIS_PROCESS, SAMPLES_LOST

MEDIA_TYPE = "text/plain; version=0.0.4; charset=utf-8"


class _Alarms(Collector):
    def __init__(self, counts: Callable[[], Mapping[Priority, int]]) -> None:
        self._counts = counts

    def collect(self) -> Iterable[Metric]:
        found = GaugeMetricFamily(
            "loopwright_alarms",
            "Alarms of the loops and buses of this gateway, 1 is the worst priority",
            labels=["priority"],
        )
        for priority, count in self._counts().items():
            found.add_metric([str(priority)], count)
        yield found


class _Build(Collector):
    def collect(self) -> Iterable[Metric]:
        found = GaugeMetricFamily(
            "loopwright_build_info", "1; the labels have the versions", labels=["version", "python"]
        )
        found.add_metric([version("loopwright"), python_version()], 1)
        yield found


class _OfTheStore(Collector):
    def __init__(self, loops: Mapping[str, LoopConfig], store: Store, sdo_retries: Mapping[str, int]) -> None:
        self._loops, self._store, self._sdo_retries = loops, store, sdo_retries

    def collect(self) -> Iterable[Metric]:
        loops = GaugeMetricFamily("loopwright_loops", "Configured loops", labels=["bus"])
        for bus, count in sorted(Tally(loop.bus for loop in self._loops.values()).items()):
            loops.add_metric([bus], count)
        yield loops
        retries = CounterMetricFamily(
            "loopwright_sdo_retries", "SDO requests sent again for want of an answer", labels=["bus"]
        )
        for bus, count in sorted(self._sdo_retries.items()):
            retries.add_metric([bus], count)
        yield retries
        up = GaugeMetricFamily("loopwright_database_up", "1: the database answers")
        try:
            jobs, waiting, unconfirmed = self._jobs(), self._waiting(), self._not_home()
        except SQLAlchemyError:
            up.add_metric([], 0)
        else:
            up.add_metric([], 1)
            yield jobs
            yield waiting
            yield unconfirmed
        yield up

    def _jobs(self) -> Metric:
        by = JobRow.state, JobRow.reason
        with Session(self._store.engine) as session:
            own = JobRow.host == self._store.host  # gateways that share a database add up
            counts = session.execute(select(*by, func.count()).where(own).group_by(*by)).all()
        jobs = GaugeMetricFamily("loopwright_jobs", "Jobs of this gateway in the database", labels=["state", "reason"])
        found: Tally[tuple[str, str]] = Tally()
        for state, reason, count in counts:
            found[JobState(state).value, reason or ""] += count
        # Active states are always exported, because an alarm cannot use a gauge that vanishes.
        for key in sorted(found.keys() | {(state.value, "") for state in ACTIVE | {JobState.PROPOSED}}):
            jobs.add_metric(list(key), found.get(key, 0))
        return jobs

    def _waiting(self) -> Metric:
        """A proposal that a later test has followed does not wait any more."""
        latest = [job for job in latest_tests(self._store).values() if job.host == self._store.host]
        found = GaugeMetricFamily("loopwright_proposals_waiting", "Loops whose latest job awaits a decision")
        found.add_metric([], sum(job.state is JobState.PROPOSED for job in latest))
        return found

    def _not_home(self) -> Metric:
        with Session(self._store.engine) as session:
            count = unconfirmed_restorations.count(session, self._store.host)
        found = GaugeMetricFamily(
            "loopwright_loops_restore_unconfirmed", "Loops whose restoration after a job is not confirmed"
        )
        found.add_metric([], count)
        return found


def registry(
    loops: Mapping[str, LoopConfig],
    store: Store,
    sdo_retries: Mapping[str, int],
    alarms: Callable[[], Mapping[Priority, int]] = dict,
) -> CollectorRegistry:
    """The registry of the metrics of a service. sdo_retries: SDO retries by bus, as counted in this process.
    alarms: returns the number of alarms by priority, 0 included."""
    for bus in {loop.bus for loop in loops.values()}:
        SAMPLES_LOST.labels(bus)  # from 0 on: of a counter that begins with the first loss Prometheus sees none
    found = CollectorRegistry()
    for collector in (*OF_THIS_PROCESS, _Build(), _OfTheStore(loops, store, sdo_retries), _Alarms(alarms)):
        found.register(collector)
    return found


def exposition(of: CollectorRegistry) -> bytes:
    """The metrics in the text format of Prometheus."""
    return generate_latest(of)

"""Gathers what is known at one moment, from the listening, the running jobs, the database and the other gateways.

While the database does not answer, what it has said last stays: buses and loops are looked at all the same.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Protocol

from sqlalchemy.exc import SQLAlchemyError

from loopwright.service.alarms.alarm import Alarm
from loopwright.service.alarms.conditions import AlarmFacts, BusFacts, GatewayFacts, LoopFacts, to_be_asked
from loopwright.service.jobs.journal import temporary
from loopwright.service.jobs.manager import Jobs
from loopwright.service.listening.listening import Listening
from loopwright.service.states.job_state import ACTIVE
from loopwright.service.states.loop_state import LoopState
from loopwright.service.store import alarms, audit, gateways, watches
from loopwright.service.store.alarms import FalsePvJob, UnconfirmedJob
from loopwright.service.store.live_jobs import Acceptance, JobInBrief, acceptances, latest_tests
from loopwright.service.store.store import Store
from loopwright.service.store.watches import WatchWithAlarm

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class _Stored:
    """What the database has said. audited: number of the latest entry of the audit log, which every decision writes."""

    tests: Mapping[str, JobInBrief] = field(default_factory=dict)
    unconfirmed: Sequence[UnconfirmedJob] = ()
    false_pvs: Sequence[FalsePvJob] = ()
    watches: Sequence[WatchWithAlarm] = ()
    accepted: Mapping[str, Acceptance] = field(default_factory=dict)
    audited: int | None = None


class GatewaysSeen(Protocol):
    """What is known of the other gateways of the database."""

    def look(self) -> None:
        """Asks the database, unless it was asked just now. Raises SQLAlchemyError."""

    def age_s(self, name: str) -> float | None:
        """Returns how long ago a gateway was there, s; None: it never was."""

    def alarms(self, name: str) -> Sequence[Alarm]:
        """Returns what a gateway has said last of what only it can know."""


class FactSource:
    """One thread at a time may gather. others: None where no other gateway is looked at."""

    def __init__(self, jobs: Jobs, listening: Listening, others: GatewaysSeen | None) -> None:
        self._jobs, self._listening, self._others = jobs, listening, others
        self._stored = _Stored()
        self._gateways: Sequence[GatewayFacts] = ()
        self._asked_from_s: float | None = None
        self._acknowledged: frozenset[str] = frozenset()
        self._up_s: dict[str, float] = {}

    def gather(self, now_s: float) -> AlarmFacts:
        """Returns what is known. now_s: the present time, wall time, s."""
        store = self._jobs.store
        away = False
        try:
            self._stored = _asked(store, self._stored)
            self._gateways = self._asked_gateways(now_s)
        except SQLAlchemyError as error:
            away, self._asked_from_s = True, None
            _report(error)
        known = AlarmFacts(
            host=store.host,
            buses=self._buses(now_s),
            loops=self._loops(),
            nodes=dict(self._listening.nodes),
            gateways=self._gateways,
            tests=list(self._stored.tests.values()),
            unconfirmed=self._stored.unconfirmed,
            false_pvs=self._stored.false_pvs,
            watches=self._stored.watches,
        )
        candidates = to_be_asked(known)
        if not candidates:
            return known
        if not away:  # else one more question would wait as long as the first one
            try:
                self._acknowledged = alarms.acknowledged(store, candidates)
            except SQLAlchemyError as error:
                _report(error)
        return replace(known, acknowledged=self._acknowledged)

    def _asked_gateways(self, now_s: float) -> list[GatewayFacts]:
        """Asks for the other gateways. Raises SQLAlchemyError."""
        if self._others is None or not self._jobs.store.shared:
            return []
        self._others.look()
        asked_from_s = self._asked_from_s = now_s if self._asked_from_s is None else min(now_s, self._asked_from_s)
        found = []
        for name, tags in gateways.loops_elsewhere(self._jobs.store).items():
            age_s = self._others.age_s(name)
            last_s = None if age_s is None else now_s - age_s
            silent = age_s is None or age_s > gateways.NO_DATA_S
            found.append(GatewayFacts(name, last_s, silent, asked_from_s, tags, self._others.alarms(name)))
        return found

    def _buses(self, now_s: float) -> list[BusFacts]:
        if not self._listening.begun:
            return []
        found = []
        for url, why in self._listening.buses().items():
            if url in self._listening.off:
                continue
            if why is not None:
                self._up_s.pop(url, None)
            up_s = min(now_s, self._up_s.setdefault(url, now_s)) if why is None else now_s
            found.append(BusFacts(url, why, up_s))
        return found

    def _loops(self) -> list[LoopFacts]:
        heard, stored = self._listening.heard, self._stored
        held = self._held()
        return [
            LoopFacts(
                config=config,
                heard=heard.get(tag),
                held=held.get(tag, (None, None))[1],
                job=held[tag][0] if tag in held else _active(stored.tests.get(tag)),
                gains=self._listening.gains_read(tag),
                accepted=stored.accepted.get(tag),
            )
            for tag, config in self._jobs.directory.loops.items()
        ]

    def _held(self) -> dict[str, tuple[str, LoopState | None]]:
        """Returns the jobs that work on loops here, with the state of the loop as far as they have read it."""
        found: dict[str, tuple[str, LoopState | None]] = {}
        for job_id in self._jobs.under_test():
            running = self._jobs.running(job_id)
            if running is not None and running.loop is not None:
                found[running.tag] = job_id, running.loop.latest
        return found


def _active(latest: JobInBrief | None) -> str | None:
    """Returns the id of the job that has the loop, of its latest one: no other is made while one has it."""
    return latest.id if latest is not None and latest.state in ACTIVE else None


def _asked(store: Store, before: _Stored) -> _Stored:
    """Asks the database. Raises SQLAlchemyError."""
    with store.reading() as session:
        audited = audit.latest(session)
    return _Stored(
        tests=latest_tests(store),
        unconfirmed=alarms.unconfirmed(store),
        false_pvs=alarms.false_pvs(store),
        watches=watches.with_alarm(store),
        accepted=before.accepted if audited == before.audited else acceptances(store),
        audited=audited,
    )


def _report(error: SQLAlchemyError) -> None:
    if not temporary(error):
        log.error("the database could not be asked what is abnormal: %s", error)

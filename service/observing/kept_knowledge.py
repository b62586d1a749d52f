"""What is known of the loops, kept in the store: fed by tests, by accepted trials and by observations."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from contextlib import AbstractContextManager
from datetime import UTC, datetime

from sqlalchemy.exc import SQLAlchemyError

from loopwright.service.observing import knowledge
from loopwright.service.observing.observed import ObservationView
from loopwright.service.results import Finding, KnowledgeView
from loopwright.service.states.loop_state import loop_state
from loopwright.service.store import knowledge as stored
from loopwright.service.store.jobs import Job
from loopwright.service.store.lock import FolderInUse
from loopwright.service.store.store import Store
from loopwright.tuning.gains import Gains

log = logging.getLogger(__name__)

Range = tuple[float, float] | None


def _now() -> datetime:
    return datetime.now(UTC)


class KeptKnowledge:
    """The knowledge of the loops. What cannot be kept is lost, with a line in the log: neither a test nor an answer
    depends on it.

    lock: held while a finding is compared with those before it, and stored.
    """

    def __init__(
        self, store: Store, lock: AbstractContextManager[object] | None = None, now: Callable[[], datetime] = _now
    ) -> None:
        self._store, self._lock, self._now = store, lock or threading.Lock(), now

    def of(self, tag: str, gains: Gains | None) -> KnowledgeView | None:
        """Returns what is known of a loop of any host; None where nothing is. Raises SQLAlchemyError.

        gains: the gains in effect; None where they are not known.
        """
        return knowledge.known(stored.read(self._store, tag), gains)

    def observed(self, found: ObservationView, Ms_asked: float, sample_time_s: float) -> None:
        """Keeps what an observation has shown, if it had an answer. sample_time_s: that of the controller, s."""
        self._keep(found.loop, lambda _: knowledge.of_observation(found, Ms_asked, sample_time_s, self._now()))

    def tested(self, job: Job, pv_range: Range, mv_range: Range) -> None:
        """Keeps what a finished job has shown. pv_range, mv_range: the ranges during the test."""
        if job.found is not None:
            sample_time_s = loop_state(job.found).sample_time_s
            self._keep(job.loop, lambda _: knowledge.of_test(job, sample_time_s, pv_range, mv_range))

    def accepted(self, job: Job) -> None:
        """Keeps that a trial was accepted."""
        self._keep(job.loop, lambda findings: knowledge.of_trial(job, findings, self._now()))

    def outdated(self, job: Job, why: str) -> None:
        """Keeps that what operation has shown of a loop before a job is of an older plant. why: in words. Raises
        SQLAlchemyError."""
        with self._lock:
            findings = stored.read(self._store, job.loop)
            text = f"job {job.id} has tried gains from operation, and {why}"
            stored.mark_older(self._store, dict.fromkeys(knowledge.of_operation(findings), text))

    def _keep(self, tag: str, make: Callable[[list[stored.Known]], Finding | None]) -> None:
        try:
            with self._lock:
                findings = stored.read(self._store, tag)
                finding = make(findings)
                if finding is None or knowledge.adds_nothing(finding, findings):
                    return
                instead_of = knowledge.replaced(finding, findings)
                others = [each for each in findings if each.number not in instead_of]
                older = knowledge.disagreeing(finding, others)
                agreeing = [each for each in others if each.superseded is None and each.number not in older]
                best = knowledge.best(agreeing, finding.present.gains.gains()).number if agreeing else None
                stored.add(self._store, tag, finding, older, instead_of, best)
        except (SQLAlchemyError, FolderInUse) as error:
            log.warning("what was found of loop %s could not be stored: %s", tag, error)
        except Exception:  # the end of a test, or an answer, must not depend on it
            log.exception("a defect while storing what was found of loop %s", tag)
            return
        else:
            for why in older.values():
                log.info("loop %s: %s", tag, why)

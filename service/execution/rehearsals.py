"""Dry runs in processes of their own; their reports reach the hooks of the job in order."""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial

from loopwright.service.execution.computing.limits import ComputationKind
from loopwright.service.execution.computing.pool import NotWanted, Pool
from loopwright.service.execution.procedures import Hooks, Outcome, Rehearse
from loopwright.service.inputs.config import LoopConfig
from loopwright.service.inputs.request import RetuneRequest
from loopwright.service.planning.ground import Ground
from loopwright.tuning.plan import Event, Sample
from loopwright.tuning.reasons import Aborted, Reason

Report = Callable[[list[Event | list[Sample]]], None]

SAMPLES_AT_ONCE = 1000
REPORT_AFTER_S = 0.2
"""Wall time after which gathered samples are reported, s."""


def rehearsed_in_pool(rehearse: Rehearse, pool: Pool) -> Rehearse:
    """Returns the same rehearsal, computed by the pool.

    rehearse: a function that can be pickled.
    """

    def rehearse_apart(config: LoopConfig, request: RetuneRequest, hooks: Hooks) -> Outcome:
        def hear(reports: list[Event | list[Sample]]) -> None:
            for each in reports:
                if isinstance(each, list):
                    hooks.on_samples(each)
                else:
                    hooks.on_event(each)

        work = partial(_rehearsed, rehearse, config, request, hooks.ground)
        try:
            outcome = pool.run(ComputationKind.DRY_RUN, work, on_report=hear, unwanted=lambda: hooks.stop() is not None)
        except NotWanted:
            reason = hooks.stop() or Reason.SERVICE_STOPPED
            return Outcome(None, Aborted(reason, "the dry run was stopped"), None, {})
        assert isinstance(outcome, Outcome)
        return outcome

    return rehearse_apart


def _rehearsed(
    rehearse: Rehearse, config: LoopConfig, request: RetuneRequest, ground: Ground, report: Report
) -> Outcome:
    """Runs the rehearsal in the process of the computation."""
    reports = _Reports(report)
    outcome = rehearse(config, request, Hooks(reports.event, reports.samples, lambda: None, ground=ground))
    if outcome.ended is not None and outcome.ended.reason is Reason.COMPUTATION_LIMIT:
        raise MemoryError  # the runner has reported it; the pool knows the limit
    reports.hand_on()
    return outcome


class _Reports:
    """Gathers the reports of a rehearsal, which may come sample by sample, into messages."""

    def __init__(self, report: Report) -> None:
        self._report = report
        self._gathered: list[Event | list[Sample]] = []
        self._handed_on_at = 0.0

    def event(self, event: Event) -> None:
        self._gathered.append(event)
        self.hand_on()

    def samples(self, samples: list[Sample]) -> None:
        last = self._gathered[-1] if self._gathered else None
        if isinstance(last, list):
            last.extend(samples)
        else:
            self._gathered.append(last := list(samples))
        if len(last) >= SAMPLES_AT_ONCE or time.monotonic() - self._handed_on_at > REPORT_AFTER_S:
            self.hand_on()

    def hand_on(self) -> None:
        if self._gathered:
            self._report(self._gathered)
            self._gathered = []
        self._handed_on_at = time.monotonic()

"""Findings whose Ms is known in closed form: a first-order plant under a PI that cancels its time constant.

L(s) = k exp(-s)/s with k = Kp K/T and a dead time of 1 s: for k = 0.5 it is the loop of SIMC, with Ms 1.59 (S.
Skogestad, Journal of Process Control 13, 2003, table 1).
"""

from __future__ import annotations

from typing import Any

from loopwright.service.results import (
    FastResult,
    Finding,
    FindingSource,
    GainsView,
    KnownGainsView,
    RangeView,
    TransferModelView,
)
from loopwright.service.states.job_state import JobState
from loopwright.service.store.jobs import Job
from loopwright.tuning.gains import Gains

T = 8.0
SIMC_MS = 1.59
PRESENT, PROPOSED, OTHER = Gains(2.4, T), Gains(3.2, T), Gains(4.0, T)
"""With a gain of 1, k is 0.3, 0.4 and 0.5."""


def gains(of: Gains, Ms: float | None, uncertainty: float | None) -> KnownGainsView:
    return KnownGainsView(gains=GainsView.of(of), Ms=Ms, uncertainty=uncertainty)


def model(K: float = 1.0) -> TransferModelView:
    return TransferModelView(structure="fopdt", num=[K / T], den=[1.0, 1.0 / T], dead_time_s=0.95)


def finding(Ms: float | None = 1.30, uncertainty: float | None = 0.05, **changes: Any) -> Finding:
    fields: dict[str, Any] = {
        "source": FindingSource.OPERATION, "at": "2026-01-31T12:00:00.000Z", "changes": 3, "last_change_s": 1000.0,
        "sample_s": 0.1, "present": gains(PRESENT, Ms, uncertainty), "proposed": gains(PROPOSED, 1.42, 0.04),
        "Ms_asked": 1.42, "model": model(), "sampling_delay_s": 0.05, "pv_range": RangeView(low=49.0, high=51.0),
        "mv_range": RangeView(low=40.0, high=45.0),
    }  # fmt: skip
    return Finding(**fields | changes)


def job(result: FastResult) -> Job:
    """An accepted job."""
    none = dict.fromkeys(
        ("started_at", "ended_at", "stage", "stage_times_s", "reason", "detail", "previous_gains", "restored", "found")
    )
    return Job(
        number=1, id="j2", loop="A", state=JobState.ACCEPTED, dry_run=False, request={}, by="me",
        created_at="2026-02-01", plant_time_s=1.0, result=result, host="local", version="0", attempt=1, session=1,
        restore_unconfirmed=False, stop_reason=None, false_pv=None, **none,
    )  # fmt: skip

"""What a picture needs to know of a job, as `GET /jobs/{id}` shows it."""

from __future__ import annotations

from typing import Protocol

from loopwright.service.job_states import JobState
from loopwright.service.results import EvidenceView, GainsView, ModelView, TransferModelView, VerificationView
from loopwright.tuning.reasons import Reason


class Shown(Protocol):
    """A job with its result."""

    id: str
    loop: str
    method: str
    state: JobState
    reason: Reason | None
    detail: str | None
    advice: str | None
    model: ModelView | TransferModelView | None
    old_gains: GainsView | None
    new_gains: GainsView | None
    evidence: EvidenceView | None
    verification: VerificationView | None

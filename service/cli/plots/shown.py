"""The job and its samples, as a plot of the job takes them: the fields of `GET /jobs/{id}` and of its samples."""

from __future__ import annotations

import math
from typing import Annotated, Protocol

from pydantic import BaseModel, BeforeValidator

from loopwright.service.results import EvidenceView, GainsView, ModelView, TransferModelView, VerificationView
from loopwright.service.states.job_state import JobState
from loopwright.tuning.reasons import Reason


class Shown(Protocol):
    """The fields of a job that its plot shows."""

    id: str
    loop: str
    method: str
    state: JobState
    reason: Reason | None
    detail: str | None
    advice: str | None
    model: ModelView | TransferModelView | None
    previous_gains: GainsView | None
    new_gains: GainsView | None
    evidence: EvidenceView | None
    verification: VerificationView | None
    sample_time_s: float | None


def _nan_for_null(value: object) -> object:
    return math.nan if value is None else value


Value = Annotated[float, BeforeValidator(_nan_for_null)]
"""A sample; NaN for null, which is a value that was not finite."""


class ShownSamples(BaseModel):
    """The samples of a job as columns of equal length, as `GET /jobs/{id}/samples` returns them.

    stage: the stage of each sample.  t_s: plant time, s.  sp, pv: PV units.  mv: percent.  mode: the controller's mode.
    """

    stage: list[str]
    t_s: list[Value]
    sp: list[Value]
    pv: list[Value]
    mv: list[Value]
    mode: list[int]

    def columns(self) -> dict[str, list[str] | list[float] | list[int]]:
        """Returns the columns by their names."""
        return {"stage": self.stage, "t_s": self.t_s, "sp": self.sp, "pv": self.pv, "mv": self.mv, "mode": self.mode}

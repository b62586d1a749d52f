"""The record of a job with its model and what the model leaves, thinned for a plot. Pure.

Times are plant time since the first sample of the job's last attempt, s.
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass

import numpy as np
from pydantic import Field

from loopwright.service.jobs.stored_record import Attempt, StoredRecord
from loopwright.service.listening.bins import BIN, GAP_BEFORE, SAMPLE, Bins, of_samples, thinned
from loopwright.service.results import Figures, LoadStepView
from loopwright.tuning.analysis.zero_order_hold import states
from loopwright.tuning.fast.record import ExperimentRecord
from loopwright.tuning.identification.output_error import Fit, Fitted, averaged
from loopwright.tuning.models import Model, Reals, monic

MAX_POINTS = 5000
"""Largest number of points that is stored of a job, and that is answered."""
FITTED, DRIVEN = "fitted", "driven"
_MISSING = 1.5
"""Time between two samples from which on samples are missing between them, in sample times."""


class RecordMark(Figures):
    """The beginning of a stage."""

    stage: str = Field(examples=["relay"])
    at_s: float = Field(description="Plant time since the first sample, s", examples=[12.5])


class RecordFacts(Figures):
    """What belongs to a record besides its columns."""

    sample_time_s: float = Field(description="Sampling period of the record, s", examples=[0.1])
    recorded: int = Field(description="Number of samples of the record, before it was thinned", examples=[512])
    marks: list[RecordMark] = Field(description="The stages in which there are samples, in order")
    model_from: str | None = Field(
        description="fitted: the model as it was fitted to this record, with the disturbances found in it; driven: the "
        "job's model driven by the recorded MV, its level fitted; null: there is no model, and no residual",
        examples=["fitted"],
    )
    noise: float | None = Field(
        description="Standard deviation of PV at rest before the test, PV units; null: not known", examples=[0.002]
    )
    loads: list[LoadStepView] = Field(
        description="Load disturbances that were found; t_s is plant time since the first sample"
    )


@dataclass(frozen=True, slots=True, eq=False)
class JobRecord:
    """The record of a job.

    measured: SP, PV, MV and mode.
    explained: bins of the same samples, with the model's PV as PV and the residual (PV less model) as MV, both in PV
    units; None without a model.
    """

    facts: RecordFacts
    measured: Bins
    explained: Bins | None

    def thinned(self, points: int) -> JobRecord:
        """Returns the record with at most this number of points."""
        at_s = self.measured["at_s"]
        from_s, to_s = float(at_s[0]), float(at_s[-1])
        fewer = None if self.explained is None else thinned(self.explained, from_s, to_s, points)
        return JobRecord(self.facts, thinned(self.measured, from_s, to_s, points), fewer)

    def pack(self) -> bytes:
        """Returns the record as bytes."""
        columns = self.measured.tobytes() + (b"" if self.explained is None else self.explained.tobytes())
        return zlib.compress(self.facts.model_dump_json().encode() + b"\n" + columns)


def unpack(data: bytes) -> JobRecord:
    """Returns the record that was packed."""
    facts, _, columns = zlib.decompress(data).partition(b"\n")
    of = RecordFacts.model_validate_json(facts)
    bins: Bins = np.frombuffer(columns, BIN)
    if of.model_from is None:
        return JobRecord(of, bins, None)
    half = len(bins) // 2
    return JobRecord(of, bins[:half], bins[half:])


@dataclass(frozen=True, slots=True, eq=False)
class FittedRecord:
    """A record with the fit of the model to it."""

    record: StoredRecord
    fit: Fit[ExperimentRecord]
    found: Fitted

    def model_pv(self) -> Reals:
        """Returns the PV of the model at each sample, with the disturbances that were found, PV units."""
        scale = self.fit.record.output_range
        at = averaged(self.record.t[: len(self.fit.u)], self.fit.block)
        level = self.record.rest[1]
        found: Reals = np.interp(self.record.t, at, (self.fit.y - self.found.linear.residual) * scale + level)
        return found


def job_record(
    attempt: Attempt,
    fitted: FittedRecord | None,
    model: Model | None,
    loads: Sequence[LoadStepView],
    noise: float | None,
) -> JobRecord:
    """Returns the record of an attempt.

    fitted: the fit of the model to the record; None where there is none.
    model: the job's model, which is driven by MV where there is no fit; None where there is none.
    loads: the load disturbances found, at times since the excitation began.
    noise: the standard deviation of PV at rest, PV units.
    """
    at = None
    if fitted is not None:
        at = fitted.model_pv()
        begun_s = fitted.record.listened * attempt.Ts
        loads = [LoadStepView(t_s=each.t_s + begun_s, size=each.size) for each in loads]
    elif model is not None:
        loads = ()
        with suppress(ArithmeticError, ValueError):  # a model that cannot be sampled: the record is shown without it
            at = driven(model, attempt)
    if at is not None and not np.isfinite(at).all():
        at = None
    taken = attempt.taken
    stage = attempt.stage[taken]
    t = np.round(taken * attempt.Ts, 6)
    begins = [0, *(1 + np.flatnonzero(stage[1:] != stage[:-1])).tolist()]
    facts = RecordFacts(
        sample_time_s=round(attempt.Ts, 9),
        recorded=len(taken),
        marks=[RecordMark(stage=str(stage[n]), at_s=float(t[n])) for n in begins],
        model_from=None if at is None else FITTED if fitted is not None else DRIVEN,
        noise=noise if noise is not None and math.isfinite(noise) else None,
        loads=[] if at is None else list(loads),
    )
    samples = np.zeros(len(taken), SAMPLE)
    samples["at_s"], samples["n"] = t, taken
    samples["gap"][1:] = np.where(np.diff(taken) > _MISSING, GAP_BEFORE, 0)
    samples["pv"], samples["mv"], samples["sp"] = attempt.pv[taken], attempt.mv[taken], attempt.sp[taken]
    samples["mode"] = attempt.mode[taken]
    explained = None
    if at is not None:
        left = samples.copy()
        left["pv"], left["mv"] = at[taken], (attempt.pv - at)[taken]
        explained = of_samples(left)
    return JobRecord(facts, of_samples(samples), explained).thinned(MAX_POINTS)


def driven(model: Model, attempt: Attempt) -> Reals:
    """Returns the PV of the model driven by the recorded MV from rest, PV units; its level is that at which it leaves
    least of the record."""
    u = attempt.mv - attempt.mv[0]
    num, den = monic(model)
    in_samples = attempt.Ts ** np.arange(len(den))  # the coefficients with the sample time as unit of time
    num, den, L = num * in_samples, den * in_samples, model.L / attempt.Ts
    order = len(den) - 1
    answer: Reals = states(den[1:], L, u, order) @ (num[1:] - num[0] * den[1:])[::-1]
    if num[0]:  # a bi-proper model passes MV on at once, after its dead time
        at = np.arange(len(u)) - math.ceil(L)
        answer += num[0] * np.where(at < 0, 0.0, u[np.maximum(at, 0)])
    level = float(np.mean(attempt.pv - answer))
    return answer + level

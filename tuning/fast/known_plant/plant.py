"""What normal operation has shown of a plant, as a procedure takes it: the record, and for what it holds."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from loopwright.tuning.experiments.primitives import Facts, OperatingPoint, Trace
from loopwright.tuning.fast.record import ExperimentRecord
from loopwright.tuning.gains import Gains
from loopwright.tuning.identification.means import means_alike
from loopwright.tuning.models import Reals

MAX_AGE_T95, MAX_AGE_S = 200.0, 86400.0
"""The longest time since the latest set-point change: the longer of this number of T95 and this time, s."""
WIDENED = 0.5
"""How far beyond the ranges of PV and MV that operation has shown the loop may rest, as a fraction of their widths."""
SAME_GAINS = 1e-5
"""Largest relative difference of gains that are the same: a REAL32 on the bus."""


@dataclass(frozen=True, slots=True, eq=False)
class ObservedPlant:
    """What normal operation has shown of the plant of a loop, well enough known to design gains on it.

    record: the record of the set-point changes; its sample time is `together` sample times of the controller.
    gains: the gains in effect at the latest change.
    pv, mv: the ranges of PV and MV during the changes, absolute, in their units.
    age_s: the plant time since the latest change, s.
    source: where it comes from, in words.
    """

    record: ExperimentRecord
    together: int
    gains: Gains
    pv: tuple[float, float]
    mv: tuple[float, float]
    age_s: float
    source: str

    def not_for(self, facts: Facts) -> str | None:
        """Why the loop as it is now is not the one that was observed, in words with the numbers; None where it is."""
        now, then = facts.previous_gains, self.gains
        if not _same_gains(now, then):
            return (
                f"the gains in effect (Kp {now.Kp:.4g}, Ti {now.Ti:.4g} s) are not those under which the loop was "
                f"observed (Kp {then.Kp:.4g}, Ti {then.Ti:.4g} s)"
            )
        longest = max(MAX_AGE_T95 * facts.T95_s, MAX_AGE_S)
        if self.age_s > longest:
            return f"the latest set-point change is {self.age_s:.4g} s old; at most {longest:.4g} s"
        sample = self.together * facts.sample_time_s
        if abs(sample / self.record.Ts - 1.0) > SAME_GAINS:
            return f"the sample time is {facts.sample_time_s:g} s, and was {self.record.Ts / self.together:g} s"
        if (self.record.direction > 0.0) is not facts.reverse:
            return "the action of the controller is another one"
        return None

    def not_at(self, point: OperatingPoint) -> str | None:
        """Why the operating point is not one that was observed, in words with the numbers; None where it is."""
        for name, at, (low, high) in (("PV", point.pv, self.pv), ("MV", point.mv, self.mv)):
            beyond = WIDENED * (high - low)
            if not low - beyond <= at <= high + beyond:
                return f"{name} rests at {at:.5g}; the loop was observed at {low:.5g} to {high:.5g}"
        return None

    def with_trial(self, trace: Trace, first: int, steps: Sequence[int], period: float) -> ExperimentRecord:
        """The record with a trial as its last piece.

        trace: the samples of the test. first: the first sample of the trial; those before the first step are at rest.
        steps: the samples at which the set-point stepped under the new gains.
        period: the time scale of the record, in samples of the record.
        """
        pv, mv = np.asarray(trace.pv[first:]), np.asarray(trace.mv[first:])
        u, y = self._sampled(pv, mv)
        rest = max((steps[0] - first) // self.together - 1, 1)
        before = slice(0, rest)
        record, begun = self.record, len(self.record.u)
        return replace(
            record,
            u=np.append(record.u, u - np.mean(u[before])),
            y=np.append(record.y, y - np.mean(y[before])),
            excited=begun,
            turns=record.turns + 1,
            period=period,
            steps=tuple(begun + (step - first) // self.together for step in steps),
            lengths=(*record.lengths, len(u)),
            u_earlier=(*record.u_earlier, np.empty(0)) if record.u_earlier else (),
        )

    def _sampled(self, pv: Reals, mv: Reals) -> tuple[Reals, Reals]:
        """MV and PV at the sample time of the record."""
        if self.together == 1:
            return mv, pv
        means = means_alike(np.arange(len(pv) + 1), pv, mv, self.together)
        return means[1], means[0]


@dataclass(frozen=True, slots=True)
class NothingKnown:
    """Normal operation has not shown the plant well enough. why: what is missing, in words with the numbers."""

    why: str


def _same_gains(one: Gains, other: Gains) -> bool:
    pairs = ((one.Kp, other.Kp), (one.Ti, other.Ti), (one.Td, other.Td), (one.Tf, other.Tf), (one.b, other.b))
    return all(abs(a - b) <= SAME_GAINS * max(abs(a), abs(b)) for a, b in pairs)

"""The limits of a run, and the guard that checks every sample against them: the second safety net of docs/safety.md."""

from __future__ import annotations

import math
from dataclasses import dataclass

from loopwright.service.states.loop_state import LoopState
from loopwright.tuning.experiments.false_pv import PvWatch
from loopwright.tuning.experiments.pv_at_rest import PvAtRest, check_end_of_rest
from loopwright.tuning.plan import Sample
from loopwright.tuning.reasons import Failed, FalsePv, Reason


@dataclass(frozen=True, slots=True)
class RunLimits:
    """The limits of a run.

    pv_low, pv_high: limits of PV, PV units.
    mv_low, mv_high: limits of MV from the first command on, MV units.
    max_time_s: time budget, s of plant time.
    max_gap_samples: number of samples in a row that may be missing.
    max_frozen_s: how long a PV of which nothing else is known may stay exactly constant while MV differs from its
    initial value, s of plant time; longer than any dead time.
    sp_deviation: the permitted set-point step, PV units: no PV is rounded so coarsely.
    """

    pv_low: float = -math.inf
    pv_high: float = math.inf
    mv_low: float = -math.inf
    mv_high: float = math.inf
    max_time_s: float = math.inf
    max_gap_samples: int = 5
    max_frozen_s: float = math.inf
    sp_deviation: float = math.inf


class Guard:
    """Checks each sample against the limits, and against what PV did before the first command: a PV that is false
    within its limits ends the run as FalsePv. Commands of an operator or another master are detected by the
    controller."""

    def __init__(self, limits: RunLimits, state: LoopState) -> None:
        self._limits, self._state = limits, state
        self._at_rest: list[float] = []
        self._mv_at_rest = state.mv
        self._watch: PvWatch | None = None
        self._dt = state.sample_time_s
        self._start: float | None = None
        self._last = 0.0
        self._acting = False
        self._slack = 0.01 * min(limits.mv_high - limits.mv_low, 1e300)
        self._pv = math.nan
        self._mv = math.nan
        self._frozen_at = 0.0
        self._notable = 1e-3 * abs(state.mv_high - state.mv_low)

    def commanded(self) -> None:
        """Notes that the plan acts on the loop from now on. Raises FalsePv where PV has ended at rest already."""
        if not self._acting:
            self._acting = True
            check_end_of_rest(self._at_rest)

    def look_on(self, sample: Sample) -> bool:
        """Takes one more sample after the end, where PV may have jumped; whether it is to be looked at further.
        Raises FalsePv."""
        if self._watch is None or not (math.isfinite(sample.pv) and math.isfinite(sample.mv)):
            return False
        self._watch.check(sample.pv, sample.mv)
        return self._watch.undecided

    @property
    def undecided(self) -> bool:
        """Whether PV has just jumped, and may be false."""
        return self._watch is not None and self._watch.undecided

    def check_end(self) -> None:
        """Raises FalsePv where the run ends without a result on a PV that is still, or has jumped, as a true one would
        not have had to."""
        if self._watch is not None:
            self._watch.check_end()

    def check(self, sample: Sample) -> None:
        """Raises Failed when the sample violates a limit; FalsePv where PV is false within its limits."""
        t, _, pv, mv, _ = sample
        limits, acting = self._limits, self._acting
        if not (math.isfinite(pv) and math.isfinite(mv)):
            raise Failed(Reason.BAD_SAMPLE, f"at {t:.3f} s PV is {pv}, MV is {mv}")
        if self._start is None:
            self._start = t
        elif t - self._last > (limits.max_gap_samples + 1.5) * self._dt:
            raise Failed(Reason.SAMPLES_LOST, f"{(t - self._last) / self._dt - 1:.0f} samples missing before {t:.3f} s")
        self._last = t
        if not limits.pv_low <= pv <= limits.pv_high:
            if acting and self._watch is not None:
                self._watch.check(pv, mv)
            raise Failed(Reason.PV_LIMIT, f"PV {pv:.5g} left {limits.pv_low:.5g} .. {limits.pv_high:.5g} at {t:.3f} s")
        if acting and not limits.mv_low - self._slack <= mv <= limits.mv_high + self._slack:
            raise Failed(Reason.MV_LIMIT, f"MV {mv:.5g} left {limits.mv_low:.5g} .. {limits.mv_high:.5g} at {t:.3f} s")
        if t - self._start > limits.max_time_s:
            raise Failed(Reason.TIME_BUDGET, f"{t - self._start:.0f} s of plant time are over the budget")
        self._check_pv(t, pv, mv)

    def _check_pv(self, t: float, pv: float, mv: float) -> None:
        """Raises FalsePv."""
        if not self._acting:
            self._at_rest.append(pv)
            self._mv_at_rest = mv
        else:
            if self._watch is None:
                state = self._state
                rest, direction = PvAtRest.of(self._at_rest), 1.0 if state.reverse_acting else -1.0
                step = self._limits.sp_deviation
                self._watch = PvWatch(rest, self._mv_at_rest, direction, state.mv_low, state.mv_high, step)
                self._at_rest.clear()
            self._watch.check(pv, mv)
        if pv != self._pv:
            self._frozen_at, self._pv, self._mv = t, pv, mv
        elif (move := abs(mv - self._mv)) < self._notable or not (self._watch is None or self._watch.has_to_show(move)):
            self._frozen_at = t
        elif t - self._frozen_at > self._limits.max_frozen_s:
            raise FalsePv(Reason.PV_FROZEN, f"PV is exactly {pv:.6g} for {t - self._frozen_at:.3g} s while MV moved")

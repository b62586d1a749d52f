"""Score tests of what else the plant may be: one whose gain differs above and below rest, changes with MV or in the
course of the test, or one with a second path that acts later (`second_path.py` looks for that one itself).

After a fit, the fitted model is driven with a changed input. What the parameters, the load disturbances, a drift and a
start that was not at rest could explain is projected out of that response and of the residual; the regression of the
residual on the response gives the size of the alternative and its standard deviation, without a new fit. Source: the
Lagrange multiplier test, C. R. Rao, Proc. Cambridge Phil. Soc. 44, 1948.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from loopwright.tuning.fast.design.uncertainty import durbin_watson_ratio, unknown_columns
from loopwright.tuning.fast.record import ExperimentRecord
from loopwright.tuning.identification.output_error import Fit, Fitted
from loopwright.tuning.models import Reals

STANDARD_DEVIATIONS = 4.0
"""Size of an alternative, in its standard deviations, above which the record shows it."""
FIRST_DELAY, DELAY_RATIO = 0.4, 1.25
"""The shortest delay of a second path that is tried, in periods, and the ratio of each delay to the one before."""
NOTABLE_LATER = 0.3
"""Size of a second path, a fraction of the plant's effect, that makes Ms about 2 with the gains for Ms 1.6."""
NEGLIGIBLE_DIRECTION = 1e-9
MIN_CHANGE = 0.1
"""Smallest part by which the plant's gain must differ under the new gains to be shown."""
ROUNDING_ALIKE = 0.5
"""The part of the rounding errors that may go with the answer of an alternative all through a record."""
FAR = 0.5
"""Where PV is far from the operating point, as a part of its way."""


@dataclass(frozen=True, slots=True)
class Alternative:
    """An alternative to the plant of the model that the record shows.

    what: the alternative in words, with its size.
    size: its size, a fraction of the plant's gain.
    deviation: the standard deviation of the size.
    """

    what: str
    size: float
    deviation: float


def above_rest(record: ExperimentRecord) -> Reals:
    """MV above rest alone, MV units, shape (N,)."""
    return np.maximum(record.u, 0.0)


def squared(record: ExperimentRecord) -> Reals:
    """MV times its part of its largest deviation, MV units, shape (N,)."""
    return np.asarray(np.square(record.u) / record.input_range)


def cubed(record: ExperimentRecord) -> Reals:
    """MV times the square of its part of its largest deviation, MV units, shape (N,)."""
    return np.asarray(record.u**3 / record.input_range**2)


def fading(record: ExperimentRecord) -> Reals:
    """MV times a factor that grows from 0 at the end of the rest to 1 at the end of the record, shape (N,)."""
    grown = np.clip(np.arange(len(record.u)) - record.listened, 0.0, None)
    return np.asarray(record.u * grown / max(float(grown[-1]), 1.0))


def since_step(record: ExperimentRecord) -> Reals:
    """MV from the first step under the new gains on, 0 before, MV units, shape (N,)."""
    begin = record.steps[0] if record.steps else len(record.u)
    return np.concatenate((np.zeros(begin), record.u[begin:]))


def since(piece: int) -> Callable[[ExperimentRecord], Reals]:
    """MV of this piece of the record and of those after it, 0 before, MV units, shape (N,)."""

    def of(record: ExperimentRecord) -> Reals:
        begin = sum(record.pieces[:piece])
        return np.concatenate((np.zeros(begin), record.u[begin:]))

    return of


def late(samples: int) -> Callable[[ExperimentRecord], Reals]:
    """MV so many samples later, 0 before each piece of the record, MV units, shape (N,)."""

    def of(record: ExperimentRecord) -> Reals:
        moved = np.zeros(len(record.u))
        begin = 0
        for length in record.pieces:
            end = begin + length
            moved[begin + samples : end] = record.u[begin : max(end - samples, begin)]
            begin = end
        return moved

    return of


class ScoreTests:
    """The score tests of one fit. What the fit can explain by itself is computed once for all of them."""

    def __init__(self, fit: Fit[ExperimentRecord], found: Fitted) -> None:
        self._fit, self._found = fit, found
        known = unknown_columns(fit, found)
        self._to_dead_time = known[:, found.structure.lags]
        lengths = np.linalg.norm(known, axis=0)
        basis, singular, _ = np.linalg.svd(known[:, lengths > 0.0] / lengths[lengths > 0.0], full_matrices=False)
        self._basis = basis[:, singular > NEGLIGIBLE_DIRECTION * singular[0]]
        residual = found.linear.residual
        self._unexplained = self._without_known(residual)
        self._rounding_of_variance = _undithered(fit, found)
        self._variance = found.linear.rss / max(fit.samples - found.parameters, 1) * durbin_watson_ratio(residual)

    def nonlinearity(self) -> Alternative | None:
        """The clearest alternative to a linear plant, None where the record shows none of a size that matters for
        Ms."""
        shown = []
        scored = [(each, self.score(each.changed)) for each in ALTERNATIVES]
        scored += [(each, self.score_in_pv(each.changed)) for each in CHANGING_WITH_PV]
        for each, (size, deviation) in scored:
            if abs(size) > max(each.minimum, STANDARD_DEVIATIONS * deviation + self._by_rounding(deviation)):
                shown.append(Alternative(each.words(size), size, deviation))
        return max(shown, key=lambda each: abs(each.size) / each.deviation, default=None)

    def changed_with_the_gains(self) -> Alternative | None:
        """A plant whose gain is another one under the new gains, None where the record does not show one."""
        size, deviation = self.score(since_step)
        if abs(size) <= max(MIN_CHANGE, STANDARD_DEVIATIONS * deviation + self._by_rounding(deviation)):
            return None
        text = f"the plant's gain is {max(1.0 + size, 0.0):.2g} times what it was before the new gains took over"
        return Alternative(text, size, deviation)

    def longest_delay_seen(self) -> float:
        """The longest delay, s, up to which the record would show a second path of 30 % of the plant's effect; 0 where
        it would show none."""
        seen = (each for each in self._delays() if STANDARD_DEVIATIONS * self.score(late(each))[1] < NOTABLE_LATER)
        return max(seen, default=0) * self._fit.record.Ts

    def unknown_difference(self) -> float:
        """By how much the gain may differ above and below rest for all that the record tells, as a fraction of the
        gain: two standard deviations, and the size itself where that is larger. Load disturbances in the model can
        stand for such a difference."""
        size, deviation = self.score(above_rest)
        return 2.0 * deviation + (abs(size) if abs(size) > 2.0 * deviation else 0.0)

    def score(
        self, changed: Callable[[ExperimentRecord], Reals], before: tuple[Reals, ...] = ()
    ) -> tuple[float, float]:
        """The size of an alternative, as a fraction of the plant's gain, and its standard deviation.

        changed: the further input of the alternative, MV units, shape (N,), from the record; the size multiplies it.
        before: this input before each piece of several, as `ExperimentRecord.u_earlier`; without it there was none.
        """
        moved = changed(self._fit.record)
        if not np.any(moved):  # MV was never above rest, or the record ends before the delay
            return 0.0, math.inf
        sizes, deviations = self.scores(moved[None], [each[None] for each in before])
        return float(sizes[0]), float(deviations[0])

    def scores(self, further: Reals, before: Sequence[Reals] = ()) -> tuple[Reals, Reals]:
        """The sizes of many alternatives, as fractions of the plant's gain, and their standard deviations, shape
        (alternatives,).

        further: the further inputs of the alternatives, MV units, shape (alternatives, N). before: these inputs before
        each piece of several, shape (alternatives, samples) each.
        """
        fit, found = self._fit, self._found
        inputs = found.structure.inputs
        columns = fit.answers(found.structure, found.theta, fit.lines(further, before))
        return self._regressions((columns @ found.linear.coefficients[:inputs]).T)

    def later_since(self, piece: int) -> tuple[float, float]:
        """By how much the dead time is longer in this piece of the record and those after it than before, in samples,
        and its standard deviation."""
        column = self._to_dead_time.copy()
        column[: self._fit.rows[piece].start] = 0.0
        return self._regression(column)

    def score_in_pv(self, changed: Callable[[Reals], Reals]) -> tuple[float, float]:
        """The size of an alternative in which the gain changes with PV, as a fraction of the gain, and its standard
        deviation.

        changed: the further part of PV, shape (rows,), from PV by the model; the size multiplies it.
        """
        modelled = self._fit.y - self._found.linear.residual
        at_rest = np.median(modelled[: max(self._fit.record.listened // self._fit.block, 1)])
        return self._regression(changed(np.asarray(modelled - at_rest)))

    def _by_rounding(self, deviation: float) -> float:
        """How large an alternative of this standard deviation rounding errors alone can make, where they go with PV."""
        per_variance = math.sqrt(len(self._unexplained) / self._variance) if self._variance > 0.0 else 0.0
        return (
            ROUNDING_ALIKE * self._rounding_of_variance * per_variance * deviation if math.isfinite(deviation) else 0.0
        )

    def _regression(self, column: Reals) -> tuple[float, float]:
        """The coefficient of a further column of the record in the residual, and its standard deviation."""
        sizes, deviations = self._regressions(column[:, None])
        return float(sizes[0]), float(deviations[0])

    def _regressions(self, columns: Reals) -> tuple[Reals, Reals]:
        """The coefficients of further columns of the record, each alone, in the residual, and their standard
        deviations; columns of shape (rows, alternatives)."""
        responses = self._without_known(columns)
        power = np.einsum("ij,ij->j", responses, responses)
        seen = power > 0.0
        power = np.where(seen, power, 1.0)
        sizes = np.where(seen, (self._unexplained @ responses) / power, 0.0)
        return sizes, np.where(seen, np.sqrt(self._variance / power), math.inf)

    def _delays(self) -> list[int]:
        """The delays of a second path that are tried, in samples, up to the length of the longest piece's test."""
        record = self._fit.record
        longest = max(record.pieces) if len(record.pieces) > 1 else len(record.u) - record.listened
        found, at = [], FIRST_DELAY * record.period
        while at < longest:
            found.append(round(at))
            at *= DELAY_RATIO
        return found

    def _without_known(self, values: Reals) -> Reals:
        """What is left of columns of the record, shape (rows, ...), by everything that the fit can explain."""
        return np.asarray(values - self._basis @ (self._basis.T @ values))


def _undithered(fit: Fit[ExperimentRecord], found: Fitted) -> float:
    """The standard deviation of those rounding errors of PV that its noise does not make random, in ranges of PV.

    They are a function of PV, of which noise leaves exp(-2 pi^2 (noise/step)^2). Source: B. Widrow, I. Kollar,
    Quantization Noise, Cambridge 2008.
    """
    rounding = fit.record.rounding / fit.record.output_range
    noise = math.sqrt(max(found.linear.rss / fit.samples * fit.block - rounding**2, 0.0))
    step = rounding * math.sqrt(12.0)
    return rounding * math.exp(-2.0 * (math.pi * noise / step) ** 2) if step > 0.0 else 0.0


def _sides(size: float) -> str:
    return f"the plant's gain above the operating point is {max(1.0 + size, 0.0):.2g} times that below"


def _curve(size: float) -> str:
    return f"the plant's gain changes by {200.0 * size:+.0f} % from the operating point to the largest MV"


def _both_ways(size: float) -> str:
    percent = max(300.0 * size, -100.0)
    return f"the plant's gain changes by {percent:+.0f} % from the operating point to the largest MV, both ways"


def _fading(size: float) -> str:
    return f"the plant's gain changes by {100.0 * size:+.0f} % in the course of the test"


@dataclass(frozen=True, slots=True)
class GainAlternative:
    """An alternative in which the plant's gain is not always the same.

    changed: the further input, MV units, shape (N,), from the record; where the gain changes with PV, the further part
    of PV, shape (rows,), from the modelled PV.
    minimum: the smallest size that matters.
    words: the alternative of a size in words.
    """

    changed: Callable[[Any], Reals]
    minimum: float
    words: Callable[[float], str]


def pv_above_rest(pv: Reals) -> Reals:
    return np.maximum(pv, 0.0)


def pv_far_above(pv: Reals) -> Reals:
    return np.maximum(pv - FAR * max(float(pv.max()), 0.0), 0.0)


def pv_far_below(pv: Reals) -> Reals:
    return np.minimum(pv - FAR * min(float(pv.min()), 0.0), 0.0)


def _pv_sides(size: float) -> str:
    return f"PV answers {max(1.0 + size, 0.0):.2g} times as much above the operating point as below"


def _pv_far(size: float) -> str:
    return f"PV answers {max(1.0 + size, 0.0):.2g} times as much where it is far from the operating point"


CHANGING_WITH_MV = (GainAlternative(above_rest, 0.05, _sides), GainAlternative(squared, 0.03, _curve))
ALTERNATIVES = (
    *CHANGING_WITH_MV,
    GainAlternative(cubed, 0.03, _both_ways),
    GainAlternative(fading, 0.1, _fading),
)
CHANGING_WITH_PV = (
    GainAlternative(pv_above_rest, 0.05, _pv_sides),
    GainAlternative(pv_far_above, 0.1, _pv_far),
    GainAlternative(pv_far_below, 0.1, _pv_far),
)
"""Plants such as a pH, whose gain depends on where PV is."""

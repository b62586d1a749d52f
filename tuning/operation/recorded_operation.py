"""Model and gains from a record of a loop in automatic: the set-point changes in it, without a test."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from loopwright.tuning.analysis.comparison import Comparison
from loopwright.tuning.analysis.notebook import as_html
from loopwright.tuning.experiments.primitives import Facts
from loopwright.tuning.fast.design.design import DesignSpec
from loopwright.tuning.fast.design.options import DesignOptions
from loopwright.tuning.fast.evaluation.evaluation import Evaluation
from loopwright.tuning.fast.evaluation.proposal import comparison_of
from loopwright.tuning.gains import AnyGains, Gains, as_gains
from loopwright.tuning.identification.record import column, sample_time
from loopwright.tuning.models import Model
from loopwright.tuning.operation import observation
from loopwright.tuning.operation.export import action_of, require_raw
from loopwright.tuning.operation.history import Stretch
from loopwright.tuning.operation.observation import Observation
from loopwright.tuning.reasons import Reason, Refused

FEWEST = 100
"""Smallest number of samples of a record."""


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Observed:
    """What a record of normal operation tells of the plant and of the best gains.

    stretch: the record, with the gains in effect.
    reverse: whether the controller acts reversely, as MV follows PV in the record.
    observation: what its set-point changes tell, with every figure.
    comparison: the comparison of the gains in effect and the designed ones; None where none are proposed.
    """

    stretch: Stretch
    reverse: bool
    observation: Observation
    comparison: Comparison | None

    @property
    def reason(self) -> Reason | None:
        """The reason why no gains are proposed; None where they are."""
        if self.comparison is not None and not self.comparison.gain:
            return Reason.NO_GAIN
        return self.observation.reason

    @property
    def detail(self) -> str:
        """What the comparison comes to, or what speaks against gains, in a sentence with the numbers."""
        return self.observation.detail if self.comparison is None else self.comparison.verdict

    @property
    def model(self) -> Model | None:
        """The model that explains the record best; None without one."""
        return None if self.observation.evaluation is None else self.observation.evaluation.model

    @property
    def gains(self) -> Gains | None:
        """The proposed gains; None where none are proposed."""
        return self.comparison.new.gains if self.comparison is not None and self.comparison.gain else None

    @property
    def Ms(self) -> float | None:
        """Ms of the designed gains on the model; None where there are none."""
        return None if self.comparison is None else self.comparison.new.Ms

    @property
    def known_to(self) -> float | None:
        """How far this Ms may be off, by all that may be wrong together; None without a model."""
        return self.observation.known_to

    def __repr__(self) -> str:
        if self.gains is None:
            return f"no gains, {self.reason}: {self.detail}"
        return f"{self.gains}; Ms {self.Ms:.3g} ± {self.known_to:.2g}; {self.detail}"

    def _repr_html_(self) -> str:
        """What a notebook shows: the gains in effect beside the designed ones, and the conclusion."""
        shown = [("in effect", self.stretch.gains, None if self.comparison is None else self.comparison.previous.Ms)]
        if self.gains is not None:
            shown.append(("proposed", self.gains, self.Ms))
        rows = [
            (name, f"{g.Kp:.4g}", f"{g.Ti:.4g}", f"{g.Td:.4g}", f"{g.b:.3g}", "-" if Ms is None else f"{Ms:.3g}")
            for name, g, Ms in shown
        ]
        title = f"{len(self.observation.used)} set-point changes"
        return as_html(title, [("", "Kp", "Ti, s", "Td, s", "b", "Ms"), *rows], [self.detail], None)


def observe(
    t: ArrayLike, sp: ArrayLike, pv: ArrayLike, mv: ArrayLike, gains: AnyGains, spec: DesignSpec | None = None,
    **options: object,
) -> Observed:  # fmt: skip
    """Identifies the plant from a record of a loop in automatic, and designs gains; nothing has to be moved for it.

    t: the times of the samples, s, evenly spaced, shape (N,), at least 100.
    sp, pv: the set-point and PV of each sample, PV units, shape (N,). The set-point must have been changed twice.
    mv: MV of the same sample, as the controller computed it, MV units, shape (N,).
    gains: the gains that were in effect throughout, or a result that has some.
    spec, options: what is asked of the gains, as `DesignSpec`, or by the names of `DesignOptions` (Ms=1.6,
    derivative=True).
    Raises Refused: BAD_INPUT for a record that does not show the loop itself (values that are stored by exception or
    interpolated, MV that does not follow by the gains given); SETPOINT_IS_DRIVEN. Raises TypeError for what are no
    gains.
    """
    present = as_gains(gains)
    columns = {name: column(name, each) for name, each in (("t", t), ("sp", sp), ("pv", pv), ("mv", mv))}
    sizes = {name: len(each) for name, each in columns.items()}
    if len(set(sizes.values())) != 1:
        listed = ", ".join(f"{size} of {name}" for name, size in sizes.items())
        raise Refused(Reason.BAD_INPUT, f"t, sp, pv and mv must be equally long; there are {listed}")
    if sizes["t"] < FEWEST:
        raise Refused(Reason.BAD_INPUT, f"there are {sizes['t']} samples; at least {FEWEST} are needed")
    asked = spec or _spec(options)
    times = columns["t"]
    stretch = Stretch(float(times[0]), sample_time(times), columns["mv"], columns["pv"], columns["sp"], present)
    require_raw(stretch)
    reverse = action_of(stretch)
    found = observation.observe([stretch], reverse, asked)
    evaluation = found.evaluation
    if found.reason is not None or evaluation is None:
        return Observed(stretch, reverse, found, None)
    try:
        compared = comparison_of(evaluation, _facts(stretch, evaluation, reverse), asked, False)
    except Refused as refused:
        return Observed(stretch, reverse, replace(found, reason=refused.reason, detail=refused.detail), None)
    return Observed(stretch, reverse, found, compared)


def _spec(options: dict[str, object]) -> DesignSpec:
    known = [name for name in DesignOptions.__dataclass_fields__ if name not in ("verify", "propose_anyway")]
    for name in options:
        if name not in known:
            raise Refused(Reason.BAD_INPUT, f"observe has no option {name!r}; it has: {', '.join(known)}")
    return DesignOptions(**options).spec()  # type: ignore[arg-type]


def _facts(stretch: Stretch, evaluation: Evaluation, reverse: bool) -> Facts:
    low, high = float(np.min(stretch.mv)), float(np.max(stretch.mv))
    T95 = max(evaluation.period, 5.0 * stretch.Ts)
    moved = float(np.max(stretch.sp) - np.min(stretch.sp))
    return Facts(stretch.Ts, T95, low, high, moved, stretch.gains, reverse)

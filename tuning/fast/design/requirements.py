"""A settling time and a movement of MV that a user asks for are kept by the design, or refused with what is possible.

The bound on Ms alone leaves one design, the fastest that is worth having. A settling time leaves a choice: every loop
that settles in time is good enough for the set-point, and the robustness that is not needed for it is worth keeping.
So the gains are those for the smallest Ms that permits the time, never above the Ms asked for. This is what is meant by
"in five minutes, not faster": of the gains from robust to fast, the most robust that are in time.

    smallest Ms' from 1.1 to Ms for which gains under Ms' (and Mt, the noise gain, the overshoot, the movement of MV)
    settle in time and have a J of at most MAX_COST_RATIO times the smallest J under the same bounds without the time

and of these gains those with the smallest J. A movement of MV bounds Kp and b together. Without a settling time the
gains are those with the smallest J that keep it, of the largest gains under any Ms from 1.1 to the one asked for: with
less Kp a larger b may move MV no further.

Both are judged by the exact response of the continuous loop, as the comparison of old and new gains shows it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from loopwright.tuning.analysis.comparison import BAND
from loopwright.tuning.fast.design.design import MAX_PRICE, MAX_WEIGHT, WIDER_OVERSHOOTS, GainDesign, OptimalGains
from loopwright.tuning.fast.design.iae import Cost
from loopwright.tuning.fast.design.weight_bounds import KEPT, DesignBounds, Missed
from loopwright.tuning.models import Model, integrators
from loopwright.tuning.reasons import Reason, Refused

LOWEST_MS, HIGHEST_MS = 1.1, 2.0
"""The smallest Ms of a design, and the largest that is named as what would do."""
LEVELS, HALVINGS, REFINEMENTS = 5, 5, 2
"""Number of values of Ms that are tried where the one asked for does not do, of halvings of an interval of Ms, and of
steps of half the distance between two values."""
STEP = 0.05
"""Step of the values of Ms, and of the set-point weight b, that are named as what would do."""
TIGHTENINGS, MARGIN = 3, 0.998
"""How often a bound of the simulated response is tightened because the exact response misses it, and by how much more
than it misses it by."""
MORE = (1.0, 1.02, 1.05, 1.1, 1.2)
"""Ratios to the nearest value found at which a number is asked for again before it is named as possible."""
NEARLY = 1.0 + 1e-4
"""Ratio to what was asked for that counts as kept."""
DIGITS = 3
"""Significant digits of a number that is said to be possible; it is rounded up."""


@dataclass(frozen=True, slots=True)
class _Found:
    """The gains under one bound on Ms, and by how much they miss the requirements, by the exact response or, where they
    miss them by more there, by the simulated one."""

    best: OptimalGains
    missed: Missed

    @property
    def kept(self) -> bool:
        return self.missed == KEPT


def required(design: GainDesign) -> OptimalGains:
    """The best gains that keep the requirements of the specification of this design.

    Raises Refused: NOT_ROBUST as `GainDesign.best`, NOT_POSSIBLE where no gains keep the requirements, with what is
    possible instead.
    """
    found = keeping(design)
    if found is None:
        raise Refused(Reason.NOT_POSSIBLE, possible_instead(design))
    return found


def keeping(design: GainDesign) -> OptimalGains | None:
    """The same; None where no gains keep the requirements. Raises Refused, NOT_ROBUST.

    Where no gains with a derivative do, those without may: MAX_COST_RATIO is then measured by the best of these.
    """
    spec = design.spec
    if not spec.has_requirements:
        return design.best()
    found = _keeping(design)
    return _keeping(_without_derivative(design)) if found is None and spec.derivative else found


def _without_derivative(design: GainDesign) -> GainDesign:
    return GainDesign(design.model, replace(design.spec, derivative=False), design.period)


def _keeping(design: GainDesign) -> OptimalGains | None:
    spec = design.spec
    if spec.mv_peak is not None and spec.mv_peak * NEARLY < _final_change(design.model):
        return None
    overshoots = (None,) if spec.aim.max_overshoot is None else (spec.aim.max_overshoot, *WIDER_OVERSHOOTS, None)
    for overshoot in overshoots:
        search = _RequirementSearch(design, DesignBounds(spec.Ms, overshoot, spec.settling_s, spec.mv_peak))
        found = search.found()
        if found is not None and (overshoot is None or _overshoot_costs_little(design, search, found)):
            return found.best
    if search.nearest is None:
        raise Refused(Reason.NOT_ROBUST, f"no gains on the model have an Ms of at most {spec.Ms:g}")
    return None


def possible_instead(design: GainDesign) -> str:
    """What is possible in place of requirements that no gains keep: each number named is kept if it is asked for.
    Raises Refused, NOT_ROBUST."""
    spec = design.spec
    if spec.derivative:  # the answer for gains without one: its search is exact, and it holds for both
        return possible_instead(_without_derivative(design))
    if spec.mv_peak is not None:
        smallest = _possible(design, DesignBounds(spec.Ms, mv_peak=max(spec.mv_peak, _final_change(design.model))))
        if smallest.mv_peak is None or smallest.mv_peak > spec.mv_peak * NEARLY:
            return _instead_of_peak(design, spec.mv_peak, smallest.mv_peak)
    assert spec.settling_s is not None
    fastest = _possible(design, DesignBounds(spec.Ms, settling_s=spec.settling_s, mv_peak=spec.mv_peak)).settling_s
    return _instead_of_time(design, spec.settling_s, fastest)


def _possible(design: GainDesign, bounds: DesignBounds) -> DesignBounds:
    """The bounds with the requirement that is missed the most replaced by the least that is possible, None where no
    gains keep it at all. Raises Refused, NOT_ROBUST."""
    search = _RequirementSearch(design, bounds)
    if search.found() is not None:
        return bounds
    if search.nearest is None:
        raise Refused(Reason.NOT_ROBUST, f"no gains on the model have an Ms of at most {bounds.Ms:g}")
    missed = search.nearest.missed
    past = missed.mv_peak or missed.settling
    without = replace(bounds, mv_peak=None) if missed.mv_peak else replace(bounds, settling_s=None)

    def moved(factor: float) -> DesignBounds:
        def to(value: float | None) -> float | None:
            return None if value is None else _up(value * (1.0 + past) * factor)

        if missed.mv_peak:
            return replace(bounds, mv_peak=to(bounds.mv_peak))
        return replace(bounds, settling_s=to(bounds.settling_s))

    if not math.isfinite(past):
        return without
    for factor in MORE:
        if _RequirementSearch(design, moved(factor)).found() is not None:
            return moved(factor)
    return without


def _overshoot_costs_little(design: GainDesign, search: _RequirementSearch, found: _Found) -> bool:
    """Whether a bound on the overshoot raises J by at most MAX_PRICE; where a settling time is asked for, J is not what
    decides."""
    if search.bounds.settling_s is not None:
        return True
    free = _RequirementSearch(design, replace(search.bounds, overshoot=None)).at(found.best.Ms)
    return free is None or design.J(found.best, free.best.minimum) <= MAX_PRICE * free.best.J


class _RequirementSearch:
    """The search over Ms. bounds: those asked for."""

    def __init__(self, design: GainDesign, bounds: DesignBounds) -> None:
        self.design, self.bounds = design, bounds
        self.nearest: _Found | None = None

    def found(self) -> _Found | None:
        """The gains that keep the requirements; None where there are none."""
        if self.bounds.settling_s is None:
            return self._cheapest()
        found = next(filter(None, map(self._noted, self._levels())), None)
        return None if found is None else self._with_the_smallest_Ms(found)

    def _cheapest(self) -> _Found | None:
        """The gains with the smallest J that keep the movement of MV."""
        free = self._exact(replace(self.bounds, mv_peak=None))
        if free is not None and self._missed(free.best) == KEPT:
            return free
        levels = self._levels()
        kept = {Ms: found for Ms in levels if (found := self._noted(Ms)) is not None}
        if not kept:
            return None
        minima = [each.best.minimum for each in kept.values()]
        minimum = Cost(min(each.setpoint for each in minima), min(each.load for each in minima))

        def J(Ms: float) -> float:
            return self.design.J(kept[Ms].best, minimum)

        ratio = math.sqrt((levels[0] - 1.0) / (levels[1] - 1.0)) if len(levels) > 1 else 1.0
        for _ in range(REFINEMENTS):
            middle = min(kept, key=J) - 1.0
            for Ms in (1.0 + middle / ratio, min(1.0 + middle * ratio, self.bounds.Ms)):
                if Ms not in kept and (found := self._noted(Ms)) is not None:
                    kept[Ms] = found
            ratio = math.sqrt(ratio)
        best = kept[min(kept, key=J)]
        return replace(best, best=replace(best.best, J=self.design.J(best.best, minimum), minimum=minimum))

    def _levels(self) -> list[float]:
        """The values of Ms that are tried, the one asked for first."""
        highest = self.bounds.Ms
        if highest <= LOWEST_MS * NEARLY:
            return [highest]
        return [highest, *(1.0 + np.geomspace(highest - 1.0, LOWEST_MS - 1.0, LEVELS))[1:].tolist()]

    def _with_the_smallest_Ms(self, found: _Found) -> _Found:
        """The gains with the smallest Ms that keep the requirements."""
        if found.best.Ms <= LOWEST_MS:
            return found
        lowest = self._noted(LOWEST_MS)
        return self._between(LOWEST_MS, found) if lowest is None else lowest

    def _between(self, missed: float, found: _Found) -> _Found:
        """The gains with the Ms nearest to one that misses the requirements."""
        for _ in range(HALVINGS):
            middle = 1.0 + math.sqrt((missed - 1.0) * (found.best.Ms - 1.0))
            nearer = self._noted(middle)
            if nearer is None:
                missed = middle
            else:
                found = nearer
        return found

    def _noted(self, Ms: float) -> _Found | None:
        """The gains for this Ms if they keep the requirements; those that miss them least are remembered."""
        found = self.at(Ms)
        if found is None or found.kept:
            return found
        if self.nearest is None or found.missed.order < self.nearest.missed.order:
            self.nearest = found
        return None

    def at(self, Ms: float) -> _Found | None:
        """The gains for this Ms; None where there are none."""
        bounds = replace(self.bounds, Ms=Ms)
        free = self._exact(replace(bounds, settling_s=None))
        if free is None or bounds.settling_s is None or free.missed.mv_peak or self._missed(free.best) == KEPT:
            return free
        return self._exact(bounds, free.best)

    def _exact(self, bounds: DesignBounds, without_time: OptimalGains | None = None) -> _Found | None:
        """The gains that keep these bounds by the exact response too; None where there are none."""
        found: _Found | None = None
        tight = bounds
        for _ in range(TIGHTENINGS):
            try:
                best = self.design.best_within(tight, without_time)
            except Refused:
                return found
            missed = self._missed(best, bounds.settling_s is not None)
            if best.missed != KEPT and found is not None:  # the tightened bounds are not kept
                return found
            found = _Found(best, Missed(*map(max, missed.order, best.missed.order)))
            if found.kept or best.missed != KEPT:
                return found
            if tight.settling_s is not None and 0.0 < missed.settling < math.inf:
                tight = replace(tight, settling_s=tight.settling_s * MARGIN / (1.0 + missed.settling))
            if tight.mv_peak is not None and missed.mv_peak:
                tight = replace(tight, mv_peak=tight.mv_peak * MARGIN / (1.0 + missed.mv_peak))
        return found

    def _missed(self, best: OptimalGains, settling: bool = True) -> Missed:
        """By how much the exact response misses the requirements. settling: the settling time too."""
        reached = self.design.setpoint_step(best.gains)
        if reached is None:
            return Missed(math.inf, math.inf)
        settled = math.inf if reached.settling_s is None else reached.settling_s
        asked = self.bounds.settling_s if settling else None
        return Missed(_past(reached.mv_peak, self.bounds.mv_peak), _past(settled, asked))


def _past(value: float, maximum: float | None) -> float:
    """By how much a value exceeds its largest permitted one, as a fraction of that."""
    return 0.0 if maximum is None or value <= NEARLY * maximum else value / maximum - 1.0


def _final_change(model: Model) -> float:
    """By how much MV has moved in the end after a set-point step, MV units per PV unit: on a plant that integrates it
    comes back."""
    return 0.0 if integrators(model) else 1.0 / abs(model.static_gain)


def _instead_of_peak(design: GainDesign, asked: float, smallest: float | None) -> str:
    """What is possible in place of the movement of MV."""
    if smallest is None:
        return f"no gains with an Ms of at most {design.spec.Ms:g} move MV by no more than {asked:g} for each PV unit"
    text = (
        f"after a set-point step MV has to move by at least {smallest:g} for each PV unit on this loop, and {asked:g} "
        "was asked for"
    )
    if final := _final_change(design.model):
        text += f"; in the end it has moved by {final:.3g}, one over the plant's gain"
    return f"{text}: permit at least {smallest:g}"


def _instead_of_time(design: GainDesign, asked: float, fastest: float | None) -> str:
    """What is possible in place of the settling time."""
    spec = design.spec
    with_mv = "" if spec.mv_peak is None else f" and a movement of MV of {spec.mv_peak:g} for each PV unit"
    if fastest is None:
        text = f"no gains with an Ms of at most {spec.Ms:g}{with_mv} settle into {100.0 * BAND:g} % on this loop"
        others = list(_others(design))
        return f"{text}: ask for {', or '.join(others)}" if others else text
    text = (
        f"the fastest that Ms {spec.Ms:g}{with_mv} permits on this loop settles into {100.0 * BAND:g} % in {fastest:g} "
        f"s after a set-point step, and {asked:g} s was asked for"
    )
    if asked <= design.model.L:
        text += f", less than the dead time of {design.model.L:.3g} s"
    return f"{text}: ask for {', or '.join([f'at least {fastest:g} s', *_others(design)])}"


def _others(design: GainDesign) -> Iterator[str]:
    """What else would permit the settling time."""
    spec = design.spec
    search = _RequirementSearch(design, DesignBounds(spec.Ms, settling_s=spec.settling_s, mv_peak=spec.mv_peak))
    if (Ms := _sufficient_Ms(search)) is not None:
        yield f"for Ms {Ms:g}"
    if spec.mv_peak is not None:
        free = _RequirementSearch(design, replace(search.bounds, mv_peak=None)).at(spec.Ms)
        if free is not None and free.kept:
            reached = design.setpoint_step(free.best.gains)
            assert reached is not None
            peak = _up(reached.mv_peak)
            if _RequirementSearch(design, replace(search.bounds, mv_peak=peak)).found() is not None:
                yield f"for a movement of MV of {peak:g}"
    if (b := _sufficient_weight(design, search.bounds)) is not None:
        yield f"for a set-point weight b of {b:g}, where the controller takes it (setpoint_weight_max)"


def _sufficient_Ms(search: _RequirementSearch) -> float | None:
    """The smallest multiple of STEP, up to HIGHEST_MS, that permits the settling time; None for none."""

    def permits(Ms: float) -> bool:
        found = search.at(Ms)
        return found is not None and found.kept

    return _smallest(permits, search.bounds.Ms, HIGHEST_MS)


def _sufficient_weight(design: GainDesign, bounds: DesignBounds) -> float | None:
    """The smallest multiple of STEP, up to MAX_WEIGHT, that permits the settling time as the largest set-point weight;
    None for none."""

    def permits(b: float) -> bool:
        spec = replace(design.spec, weights=(design.spec.weights[0], b))
        return _RequirementSearch(GainDesign(design.model, spec, design.period), bounds).found() is not None

    return _smallest(permits, design.spec.weights[1], MAX_WEIGHT)


def _smallest(permits: Callable[[float], bool], above: float, highest: float) -> float | None:
    """The smallest multiple of STEP above a value, up to the highest, that permits what is asked for; None for none."""
    low, high = math.floor(above / STEP + 1e-9), round(highest / STEP)
    if high <= low or not permits(highest):
        return None
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (low, middle) if permits(round(middle * STEP, 2)) else (middle, high)
    return round(high * STEP, 2)


def _up(value: float) -> float:
    """The value rounded up to DIGITS significant digits."""
    unit = 10.0 ** (math.floor(math.log10(value)) - DIGITS + 1)
    return float(f"{math.ceil(value / unit - 1e-9) * unit:.{DIGITS}g}")

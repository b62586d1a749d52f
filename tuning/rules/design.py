"""The gains of any rule of `registry` are checked on the model before they are tried on the loop.

Gains that would not be robust on their own model, or that come near instability at the ultimate point measured on the
loop, are refused.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

from loopwright.tuning.analysis.comparison import (
    Comparison,
    IAE_over_present,
    Predicted,
    RobustnessBounds,
    compare,
    loop_performance,
    predicted,
)
from loopwright.tuning.analysis.margins import Ultimate
from loopwright.tuning.gains import Gains
from loopwright.tuning.models import FOPDT, SOPDT
from loopwright.tuning.reasons import Reason, Refused
from loopwright.tuning.rules.registry import METHODS, tune
from loopwright.tuning.rules.robust_pi import UNSTABLE, Criterion
from loopwright.tuning.rules.setting import Setting

MAX_Ms, MIN_GM = 2.0, 2.0
ROUNDING = 1.002
"""Factor by which Ms may exceed its bound: a method that searches on the bound ends on it."""
SLOWER = {"lambda_s": "larger", "tau_c_s": "larger", "c": "smaller"}
"""The options that make a rule more robust."""
CRITERION_7 = "criterion (7): 10 ITAE + overshoot + 10 Ms, the largest with K, T and L 20 % off"
OVER_PRESENT = "half of the set-point's and half of the load's IAE, each over that of the present gains"
ROBUST = "robust"
MIN_DISTANCE = 0.45
"""Smallest distance from -1 of the loop's response at the measured ultimate frequency."""


@dataclass(frozen=True, slots=True)
class Designed:
    """The result of Stage 5.

    method: the name of the rule.
    gains: the gains, realisable by the controller.
    predicted: their main figures on the model.
    chosen: the design parameters of the rule, by name with unit.
    notes: what the user should know, one sentence each.
    """

    method: str
    gains: Gains
    predicted: Predicted
    chosen: Mapping[str, float]
    notes: tuple[str, ...]


def design(
    method: str, plant: FOPDT | SOPDT, ultimate: Ultimate | None, options: Mapping[str, object] | None = None
) -> Designed:
    """The realisable gains of a rule for this plant, with their figures on the model.

    ultimate: the measured ultimate point, which the rules made on the ultimate point use; None without one.
    Raises Refused: NOT_ROBUST, or as the rule does.
    """
    setting = _setting(method, plant, ultimate, options or {})
    gains, notes = realisable(setting.gains, METHODS[method].filter)
    found = loop_performance(plant, gains)
    robust = found.Ms is not None and found.Ms <= MAX_Ms * ROUNDING and (found.GM is None or found.GM >= MIN_GM)
    if not robust:
        GM = "none" if found.GM is None else f"{found.GM:.2f}"
        shown = "the loop would be unstable" if found.Ms is None else f"Ms {found.Ms:.2f}, GM {GM}"
        raise Refused(
            Reason.NOT_ROBUST,
            f"{method} gives Kp {gains.Kp:.4g}, Ti {gains.Ti:.4g} s, Td {gains.Td:.4g} s; on the model {shown} "
            f"(Ms at most {MAX_Ms}, GM at least {MIN_GM}){_slower(setting)}",
        )
    if ultimate is not None:
        distance = abs(1.0 - _controller(gains, 2.0 * math.pi / ultimate.Pu_s) / ultimate.Ku)
        if distance < MIN_DISTANCE:
            raise Refused(
                Reason.NOT_ROBUST,
                f"at the measured ultimate point the loop comes within {distance:.2f} of instability "
                f"(least {MIN_DISTANCE})",
            )
    return Designed(method, gains, predicted(found), dict(setting.chosen), setting.notes + notes)


def comparison_of(
    designed: Designed,
    plant: FOPDT | SOPDT,
    previous_gains: Gains,
    sample_time_s: float,
    options: Mapping[str, object],
    anyway: bool,
) -> Comparison:
    """The comparison of the previous gains with those of the rule, on the model that the rule was given.

    The robust PI is compared by the bounds of this module and by its own criterion. The other rules minimise nothing:
    their gains are an improvement where they are more robust than the old ones, or lower the IAE.
    sample_time_s: the sample time, s.
    anyway: see `tuning.analysis.comparison.compare`.
    """
    before, after = loop_performance(plant, previous_gains, sample_time_s), loop_performance(plant, designed.gains)
    assert after.Ms is not None  # `design` sees to that
    of_robust = designed.method == ROBUST
    asked = RobustnessBounds(MAX_Ms, GM=MIN_GM) if of_robust else RobustnessBounds(after.Ms, by=f"by {designed.method}")
    if of_robust and isinstance(plant, FOPDT) and _plain_pi(previous_gains):
        scale_free = options.get("scale_free")
        of = Criterion(plant, designed.chosen["horizon_s"], None if scale_free is None else bool(scale_free))
        now, then = (None if J >= UNSTABLE else J for J in (of(g.Kp, g.Ti) for g in (previous_gains, designed.gains)))
        return compare(before, after, asked, CRITERION_7, (now, then), anyway)
    return compare(before, after, asked, OVER_PRESENT, IAE_over_present(before, after), anyway)


def _plain_pi(gains: Gains) -> bool:
    """Whether the gains are a PI without set-point weight, for which criterion (7) is made."""
    return gains.Ti > 0.0 and gains.Td == 0.0 and gains.b == 1.0


def _slower(setting: Setting) -> str:
    """The option to ask for instead, where the rule has a number that makes it more robust."""
    for name, direction in SLOWER.items():
        if name in setting.chosen:
            return f"; ask for a {direction} {name} than {setting.chosen[name]:.4g}"
    return ""


def realisable(gains: Gains, filter: float) -> tuple[Gains, tuple[str, ...]]:
    """The gains as a controller can realise them: an ideal derivative gets the filter Tf = Td/filter and acts on PV
    alone, and notes say so.

    An ideal derivative would amplify noise without bound, and a set-point step would kick MV.
    """
    if gains.Td == 0.0:
        return gains, ()
    notes = []
    if gains.Tf == 0.0:
        gains = replace(gains, Tf=gains.Td / filter)
        notes.append(f"The derivative is filtered with Tf = Td/{filter:g} = {gains.Tf:.4g} s.")
    if gains.c != 0.0:
        gains = replace(gains, c=0.0)
        notes.append("The derivative acts on PV alone, not on the set-point.")
    return gains, tuple(notes)


def _controller(gains: Gains, w: float) -> complex:
    """The frequency response C(jw) of the feedback path; w in rad/s."""
    s = 1j * w
    integral = 1.0 / (gains.Ti * s) if gains.Ti > 0.0 else 0.0
    return gains.Kp * (1.0 + integral + gains.Td * s / (1.0 + gains.Tf * s))


def _setting(method: str, plant: FOPDT | SOPDT, ultimate: Ultimate | None, options: Mapping[str, object]) -> Setting:
    if ultimate is not None and method in METHODS and METHODS[method].measured is not None:
        return METHODS[method].tune_measured(ultimate.Ku, ultimate.Pu_s, **options)
    return tune(method, plant, **options)

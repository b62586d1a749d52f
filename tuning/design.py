"""From a model to gains worth trying on the loop: any rule of `tuning.methods`, judged on the model before it is tried.

Nothing that would not be robust on its own model, or that comes near instability at the ultimate point measured on the
loop, is handed over.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

from tuning.assess import assess
from tuning.gains import Gains
from tuning.methods import METHODS, tune
from tuning.models import FOPDT, SOPDT
from tuning.reasons import Reason, Refused
from tuning.setting import Setting

MOST_Ms, LEAST_GM = 2.0, 2.0
ROUNDING = 1.002
"""A method that seeks the bound ends on it."""
SLOWER = {"lambda_s": "larger", "tau_c_s": "larger", "c": "smaller"}
"""The options that make a rule more robust."""
LEAST_DISTANCE = 0.45
"""From the loop's response at the measured ultimate frequency to -1."""


@dataclass(frozen=True, slots=True)
class Ultimate:
    """Ku: MV units per PV unit.  Pu_s: s. As measured on the loop, or typed in."""

    Ku: float
    Pu_s: float


@dataclass(frozen=True, slots=True)
class Predicted:
    """Of the new gains on the model: Ms, GM (ratio), PM (degrees), set-point step figures (settling into 5 %).

    None where the loop has no such crossing, or does not settle.
    """

    Ms: float
    GM: float | None
    PM_deg: float | None
    overshoot_pct: float
    settling_s: float | None
    IAE_per_unit: float


@dataclass(frozen=True, slots=True)
class Designed:
    """What stage 5 hands on. chosen: the rule's design parameters, by name with unit."""

    method: str
    gains: Gains
    predicted: Predicted
    chosen: Mapping[str, float]
    notes: tuple[str, ...]


def design(
    method: str, plant: FOPDT | SOPDT, ultimate: Ultimate | None, options: Mapping[str, object] | None = None
) -> Designed:
    """The rule's gains for this plant, realisable, with what the model predicts of them.

    The rules made on the ultimate point take the measured one. Refused: as the rule says; NOT_ROBUST.
    """
    setting = _setting(method, plant, ultimate, options or {})
    gains, notes = realisable(setting.gains, METHODS[method].filter)
    found = assess(plant, gains, band=0.05)
    m, figures = found.margins, found.setpoint
    if figures is None or not (m.Ms <= MOST_Ms * ROUNDING and (m.GM is None or m.GM >= LEAST_GM)):
        GM = "none" if m.GM is None else f"{m.GM:.2f}"
        stable = "" if figures else "the loop would be unstable: "
        raise Refused(
            Reason.NOT_ROBUST,
            f"{method} gives Kp {gains.Kp:.4g}, Ti {gains.Ti:.4g} s, Td {gains.Td:.4g} s; on the model {stable}Ms "
            f"{m.Ms:.2f} (at most {MOST_Ms}), GM {GM} (at least {LEAST_GM}){_slower(setting)}",
        )
    if ultimate is not None:
        distance = abs(1.0 - _controller(gains, 2.0 * math.pi / ultimate.Pu_s) / ultimate.Ku)
        if distance < LEAST_DISTANCE:
            raise Refused(
                Reason.NOT_ROBUST,
                f"at the measured ultimate point the loop comes within {distance:.2f} of instability "
                f"(least {LEAST_DISTANCE})",
            )
    predicted = Predicted(m.Ms, m.GM, m.PM_deg, figures.overshoot_pct, figures.settling_s, figures.IAE)
    return Designed(method, gains, predicted, dict(setting.chosen), setting.notes + notes)


def _slower(setting: Setting) -> str:
    """What to ask for instead, where the rule has a number for it."""
    for name, direction in SLOWER.items():
        if name in setting.chosen:
            return f"; ask for a {direction} {name} than {setting.chosen[name]:.4g}"
    return ""


def realisable(gains: Gains, filter: float) -> tuple[Gains, tuple[str, ...]]:
    """An ideal derivative gets the filter Tf = Td/filter, and acts on PV alone; notes say so.

    It would answer noise without bound, and a set-point step would kick MV.
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
    """C(jw) of the feedback path."""
    s = 1j * w
    integral = 1.0 / (gains.Ti * s) if gains.Ti > 0.0 else 0.0
    return gains.Kp * (1.0 + integral + gains.Td * s / (1.0 + gains.Tf * s))


def _setting(method: str, plant: FOPDT | SOPDT, ultimate: Ultimate | None, options: Mapping[str, object]) -> Setting:
    if ultimate is not None and method in METHODS and METHODS[method].measured is not None:
        return METHODS[method].tune_measured(ultimate.Ku, ultimate.Pu_s, **options)
    return tune(method, plant, **options)

"""Internal model control with one free number, the filter's time constant lambda, as PI and PID.

    imc_pi   FOPDT        exp(-L s) ~ 1 - L s            Kp = T/(K (lambda + L))                Ti = T        (9), (10)
    imc_pid  FOPDT        Pade, form "zero"              Kp = (T + L/2)/(K (lambda + L/2))                    (26)-(28)
                          Pade, form "all-pass"          Kp = (T + L/2)/(K (lambda + L))                      (11), (12)
                          both: Ti = T + L/2, Td = T L/(2 T + L)
             SOPDT        Taylor                         Kp = (T1 + T2)/(K (lambda + L)), Ti = T1 + T2,
                                                         Td = T1 T2/(T1 + T2)
    integrating, filter (gamma s + 1)/(lambda s + 1)^2 of (13), gamma such that a load leaves no offset
             imc_pi       Taylor, gamma = 2 lambda + L   Kp = Ti/(K (lambda + L)^2)        Ti = 2 lambda + L
             imc_pid      Pade, gamma = 2 lambda + L/2   Kp = Ti/(K (lambda + L/2)^2)      Ti = 2 lambda + L
                                                         Td = L (lambda + L/4)/(2 lambda + L)
    integrating, as K psi exp(-L s)/(psi s + 1)          the FOPDT rules with K psi, T = psi             (36)

Source: B. Mabu Sarif, D. V. Ashok Kumar, M. Venu Gopal Rao, IJECE 10(3), 2020; the integrating filter rules follow
from its (13), and agree with D. E. Rivera, M. Morari, S. Skogestad, Ind. Eng. Chem. Process Des. Dev. 25, 1986.

The loop of each rule depends on lambda/L alone. `SAFE` holds the smallest lambda/L accepted, where Ms is about 2. The
paper's own guidelines are lambda > 0.8 L and a start between 1/5 and 1/3 of the dominant time constant; the default is
max(0.8 L, T/5), for an integrating plant sqrt(10) L. Form "zero" is unstable for lambda < 0.1445 L.

The derivative acts on the error (c = 1 in `Gains`), as in the paper.
"""

from __future__ import annotations

import math

from loopwright.tuning.models import FOPDT, SOPDT, Integrating
from loopwright.tuning.reasons import Reason, Refused
from loopwright.tuning.rules.common import needs_dead_time, no_lag, one_of, positive, setting
from loopwright.tuning.rules.setting import Setting

FORMS = ("zero", "all-pass")
SAFE = {"taylor": 0.5, "all-pass": 0.25, "zero": 0.8, "integrating": 2.0}
UNSTABLE_ZERO = 0.1445307
"""Form "zero": GM = (lambda/L + 1/2)/0.6445307; x - atan(x/2) = pi/2 is its crossover."""
MIN_PSI = {"pi": 10.0, "pid": 2.5}
"""Smallest psi/L: below it the integral time is so short that Ms is well above 2 at the smallest safe lambda."""


def imc_pi(
    model: FOPDT | Integrating,
    *,
    lambda_s: float | None = None,
    psi_s: float | None = None,
    extrapolate: bool = False,
) -> Setting:
    """The IMC setting of a PI.

    lambda_s: the time constant of the filter, s; the default is stated above.
    psi_s: the lag that replaces the integrator of an integrating plant, s, by (36).
    extrapolate: True accepts a lambda below the safe range, with a note.
    Raises Refused, OUTSIDE_RANGE, for a lambda below the safe range.
    """
    if isinstance(model, Integrating) and psi_s is None:
        lambda_s, chosen, notes = _filter(model, lambda_s, "integrating", extrapolate)
        L, K = model.L, abs(model.K)
        Ti = 2.0 * lambda_s + L
        return setting(Ti / (lambda_s + L) / (lambda_s + L) / K, Ti, chosen=chosen, notes=notes)
    model, psi = _as_fopdt(model, psi_s, "pi")
    lambda_s, chosen, notes = _filter(model, lambda_s, "taylor", extrapolate)
    Kp = model.T / (lambda_s + model.L) / abs(model.K)
    return setting(Kp, model.T, chosen=chosen | psi, notes=notes)


def imc_pid(
    model: FOPDT | SOPDT | Integrating,
    *,
    lambda_s: float | None = None,
    form: str = "zero",
    psi_s: float | None = None,
    extrapolate: bool = False,
) -> Setting:
    """The IMC setting of a PID.

    lambda_s, psi_s, extrapolate: as for `imc_pi`.
    form: how the Pade factor of a FOPDT model is split, "zero" or "all-pass", see above.
    Raises Refused as `imc_pi`.
    """
    one_of("form", form, FORMS)
    if isinstance(model, SOPDT):
        _only_for_integrating(psi_s)
        lambda_s, chosen, notes = _filter(model, lambda_s, "taylor", extrapolate)
        a1, a2 = 2.0 * model.zeta * model.T, model.T * model.T
        return setting(a1 / (lambda_s + model.L) / abs(model.K), a1, a2 / a1, c=1.0, chosen=chosen, notes=notes)
    if isinstance(model, Integrating) and psi_s is None:
        lambda_s, chosen, notes = _filter(model, lambda_s, "integrating", extrapolate)
        L, K = model.L, abs(model.K)
        Ti, half = 2.0 * lambda_s + L, lambda_s + 0.5 * L
        Td = L * (lambda_s + 0.25 * L) / Ti
        return setting(Ti / half / half / K, Ti, Td, c=1.0, chosen=chosen, notes=notes)
    model, psi = _as_fopdt(model, psi_s, "pid")
    lambda_s, chosen, notes = _filter(model, lambda_s, form, extrapolate)
    if form == "all-pass":
        notes += ("The all-pass form's own lag, lambda L/(2 (lambda + L)), is left out, as in the paper's (11).",)
    Ti = model.T + 0.5 * model.L
    speed = lambda_s + (0.5 if form == "zero" else 1.0) * model.L
    Td = model.T * model.L / (2.0 * model.T + model.L)
    return setting(Ti / speed / abs(model.K), Ti, Td, c=1.0, chosen=chosen | psi, notes=notes)


def _filter(
    model: FOPDT | SOPDT | Integrating, lambda_s: float | None, loop: str, extrapolate: bool
) -> tuple[float, dict[str, float], tuple[str, ...]]:
    """The checked lambda (s), the design parameters in effect, and the notes."""
    L = model.L
    if isinstance(model, Integrating):
        no_lag(model, "IMC")
    if lambda_s is None:
        if isinstance(model, Integrating):
            needs_dead_time(model, "IMC without a lambda_s")
            lambda_s = math.sqrt(10.0) * L
        else:
            slowest = model.T1 if isinstance(model, SOPDT) and model.zeta > 1.0 else model.T
            lambda_s = max(0.8 * L, 0.2 * slowest)
    positive("lambda_s", lambda_s, "s")
    chosen = {"lambda_s": lambda_s}
    if loop == "zero" and lambda_s <= UNSTABLE_ZERO * L:
        raise Refused(
            Reason.OUTSIDE_RANGE,
            f"lambda_s = {lambda_s:g} s makes the loop unstable; above {UNSTABLE_ZERO * L:g} s it is stable, "
            f"from {SAFE[loop] * L:g} s up accepted",
        )
    if lambda_s >= SAFE[loop] * L * (1.0 - 1e-9):
        return lambda_s, chosen, ()
    text = f"lambda_s = {lambda_s:g} s is below {SAFE[loop]:g} L = {SAFE[loop] * L:g} s, the safe range of this rule"
    if not extrapolate:
        raise Refused(Reason.OUTSIDE_RANGE, f"{text}; extrapolate = true uses it nevertheless")
    return lambda_s, chosen, (f"{text}.",)


def _as_fopdt(model: FOPDT | Integrating, psi_s: float | None, controller: str) -> tuple[FOPDT, dict[str, float]]:
    """The model as FOPDT: by (30) an integrator becomes a lag of psi (s); a FOPDT model stays as it is."""
    if isinstance(model, FOPDT):
        _only_for_integrating(psi_s)
        return model, {}
    no_lag(model, "IMC")
    psi = positive("psi_s", psi_s if psi_s is not None else math.nan, "s")
    minimum = MIN_PSI[controller] * model.L
    if psi < minimum:
        raise Refused(Reason.OUTSIDE_RANGE, f"psi_s = {psi:g} s is too short; from {minimum:g} s up is accepted")
    return FOPDT(model.K * psi, psi, model.L), {"psi_s": psi}


def _only_for_integrating(psi_s: float | None) -> None:
    if psi_s is not None:
        raise Refused(Reason.BAD_INPUT, f"psi_s is for integrating plants; leave it out, not {psi_s!r}")

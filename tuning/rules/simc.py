"""SIMC, Skogestad's rules: a closed loop of time constant tau_c, integral action fast enough for loads.

    first order  K exp(-L s)/(T s + 1)               PI     Kp = T/(K (tau_c + L))     Ti = min(T, 4 (tau_c + L))
    second       K exp(-L s)/((T1 s + 1)(T2 s + 1))  PID    series form: the same with T1, and Td = T2
    integrating  K exp(-L s)/s                       PI     Kp = 1/(K (tau_c + L))     Ti = 4 (tau_c + L)
                 K exp(-L s)/(s (T s + 1))           PID    series form: the same, and Td = T

tau_c = L by default, the tightest the author advises (Ms about 1.6); the answer is converted to the ISA form. More lags
than the controller takes are reduced by the half rule, straight to the first order for a PI, to the second for a PID.

Source: S. Skogestad, Simple analytic rules for model reduction and PID controller tuning, J. Process Control 13, 2003.
For real poles: complex ones are refused.
"""

from __future__ import annotations

import math

from loopwright.tuning.gains import Series, of_series
from loopwright.tuning.models import FOPDT, Integrating, Model, TransferFunction
from loopwright.tuning.reasons import Reason, Refused
from loopwright.tuning.reduction.half_rule import exact, half_rule
from loopwright.tuning.rules.common import in_words, one_of, positive, setting
from loopwright.tuning.rules.setting import Setting

CONTROLLERS = ("pi", "pid")


def simc(model: Model, *, controller: str = "pi", tau_c_s: float | None = None) -> Setting:
    """The SIMC setting.

    controller: "pi" or "pid"; "pid" needs a second lag.
    tau_c_s: the time constant of the closed loop, s, not negative; by default the dead time of the reduced model.
    Raises Refused: BAD_INPUT, also for a PID on a FOPDT model or an integrating plant without lag; OUTSIDE_RANGE
    without dead time and tau_c_s.
    """
    one_of("controller", controller, CONTROLLERS)
    if isinstance(model, TransferFunction):
        model = exact(model)
    reduced = half_rule(model, 1 if controller == "pi" else 2)
    notes: tuple[str, ...] = ()
    if reduced != model:
        notes = (f"The model was reduced by the half rule to {in_words(reduced)}.",)
    L = reduced.L
    if tau_c_s is None:
        if L == 0.0:
            raise Refused(Reason.OUTSIDE_RANGE, "without a dead time SIMC has no default: give tau_c_s > 0 s")
        tau_c_s = L
    elif not (math.isfinite(tau_c_s) and tau_c_s >= 0.0):
        raise Refused(Reason.BAD_INPUT, f"tau_c_s must be a number >= 0 s, not {tau_c_s!r}")
    speed = positive("tau_c_s + L", tau_c_s + L, "s")
    if tau_c_s < L:
        notes += (f"tau_c = {tau_c_s:g} s is below the dead time, {L:g} s: faster than the author advises.",)

    second = 0.0
    if isinstance(reduced, Integrating):
        kp, Ti, second = 1.0 / speed / abs(reduced.K), 4.0 * speed, reduced.T
    elif isinstance(reduced, FOPDT):
        kp, Ti = reduced.T / speed / abs(reduced.K), min(reduced.T, 4.0 * speed)
    else:
        kp, Ti, second = reduced.T1 / speed / abs(reduced.K), min(reduced.T1, 4.0 * speed), reduced.T2
    if controller == "pid":
        if second == 0.0:
            raise Refused(
                Reason.BAD_INPUT, "SIMC gives a PID to plants with a second lag only; controller = pi is accepted"
            )
        isa = of_series(Series(kp, Ti, second))
        kp, Ti, second = isa.Kp, isa.Ti, isa.Td
    return setting(kp, Ti, second, chosen={"tau_c_s": tau_c_s}, notes=notes)

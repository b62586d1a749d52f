"""The rule of Cohen and Coon: quarter decay of a load disturbance, with r = L/T.

    P      K Kp = (1 + r/3)/r
    PI     K Kp = (9/10 + r/12)/r    Ti = L (30 + 3r)/(9 + 20r)
    PID    K Kp = (4/3 + r/4)/r      Ti = L (32 + 6r)/(13 + 8r)    Td = 4L/(11 + 2r)

Source: G. H. Cohen, G. A. Coon, Theoretical consideration of retarded control, Trans. ASME 75, 1953; for r up to 1.

Variant "tau", PI only, is the rewriting in tau = L/(L + T) that the ME-PSO paper's table was made with:

    PI     K Kp = 0.9 (1 + 0.92 r)/r    Ti = L (3.3 - 3 tau)/(1 + 1.2 tau)

Its 0.92 is ten times the original's (1/12)/(9/10) = 0.0926, so its gain is far higher; from r = 0.864 its loop is
unstable, and refused.
"""

from __future__ import annotations

from loopwright.tuning.models import FOPDT
from loopwright.tuning.reasons import Reason, Refused
from loopwright.tuning.rules.common import one_of, ratio_within, refuse_unstable, setting
from loopwright.tuning.rules.setting import Setting

CONTROLLERS = ("p", "pi", "pid")
VARIANTS = ("original", "tau")
RATIO = (0.05, 1.0)


def cohen_coon(
    model: FOPDT, *, controller: str = "pi", variant: str = "original", extrapolate: bool = False
) -> Setting:
    """The setting of Cohen and Coon.

    controller: "p", "pi" or "pid".
    variant: "original", or "tau" (see above) for comparison with the paper only.
    extrapolate: True uses the rule outside its range of L/T, with a note.
    """
    one_of("controller", controller, CONTROLLERS)
    one_of("variant", variant, VARIANTS)
    if variant == "tau" and controller != "pi":
        raise Refused(Reason.BAD_INPUT, f"controller must be pi for variant tau, not {controller!r}")
    notes = ratio_within(model, *RATIO, "the Cohen-Coon rule", extrapolate)
    L, r, K = model.L, model.L / model.T, abs(model.K)
    if variant == "tau":
        tau = L / (L + model.T)
        found = setting(0.9 * (1.0 + 0.92 * r) / r / K, L * (3.3 - 3.0 * tau) / (1.0 + 1.2 * tau), notes=notes)
        return refuse_unstable(model, found, "Cohen-Coon, variant tau,")
    if controller == "p":
        return setting((1.0 + r / 3.0) / r / K, notes=notes)
    if controller == "pi":
        return setting((0.9 + r / 12.0) / r / K, L * (30.0 + 3.0 * r) / (9.0 + 20.0 * r), notes=notes)
    Ti, Td = L * (32.0 + 6.0 * r) / (13.0 + 8.0 * r), 4.0 * L / (11.0 + 2.0 * r)
    return setting((4.0 / 3.0 + 0.25 * r) / r / K, Ti, Td, notes=notes)

"""Direct synthesis for second-order plants with dead time: the zeros of the PID cancel the poles of the plant.

    Ti = T1 + T2    Td = T1 T2/(T1 + T2)    Kp = c (T1 + T2)/(K L),    c = 6 - 4 sqrt 2 = 0.3431        (5), (6), (27)

Complex poles: T1 + T2 = 2 zeta T and T1 T2 = T^2; a FOPDT plant is T2 = 0 and gets a PI.

Source: I. A. Polishchuk, Setting of PID-regulator based on direct synthesis method for the second order objects plus
time delay, 2023. What is left of every loop is c exp(-x)/x, x = L s, so that c alone decides:

                                    paper (Pade)    dead time exact
    no overshoot up to c =          0.3431          1/e  = 0.3679
    stable below c =                2               pi/2 = 1.5708

The paper's bound (21), c = 2, is not safe: this rule refuses from pi/2 on. The derivative acts on the error (c = 1 in
`Gains`): on the measurement alone the zeros no longer cancel and a set-point step overshoots by up to 13 %.
"""

from __future__ import annotations

import math

from loopwright.tuning.models import FOPDT, SOPDT
from loopwright.tuning.reasons import Reason, Refused
from loopwright.tuning.rules.common import needs_dead_time, positive, setting
from loopwright.tuning.rules.setting import Setting

PAPER_C = 6.0 - 4.0 * math.sqrt(2.0)
NO_OVERSHOOT_C = math.exp(-1.0)
STABLE_C = 0.5 * math.pi


def direct_synthesis(model: SOPDT | FOPDT, *, c: float = PAPER_C) -> Setting:
    """The setting of direct synthesis. c: K Kp L/(T1 + T2), below pi/2; up to 1/e a set-point step does not
    overshoot."""
    needs_dead_time(model, "direct synthesis")
    positive("c", c, "(no unit)")
    if c >= STABLE_C:
        raise Refused(Reason.OUTSIDE_RANGE, f"c = {c:g} is unstable; below pi/2 = {STABLE_C:.4f} is accepted")
    a1, a2 = _sums(model)
    notes: tuple[str, ...] = ()
    if c > NO_OVERSHOOT_C * (1.0 + 1e-9):
        notes += (f"c = {c:.4g} is above 1/e = 0.3679: a set-point step overshoots.",)
    if isinstance(model, SOPDT):
        if model.zeta < 1.0 and a1 * a1 < 4.0 * a2 * (1.0 - 1e-12):
            notes += (
                f"The cancelled poles are complex (zeta = {model.zeta:.3g}): a load disturbance rings with them, and "
                "the PID has no series form.",
            )
        if a1 > model.L:
            notes += ("Keep the derivative filter at Td/20 or less: the plant is slower than its dead time.",)
        notes += ("For set-points: the cancelled poles govern the recovery from a load disturbance.",)
    chosen = {"c": c, "lambda_s": (1.0 / c - 1.0) * model.L} if c < 1.0 else {"c": c}
    return setting(c * a1 / model.L / abs(model.K), a1, a2 / a1, c=1.0, chosen=chosen, notes=notes)


def _sums(model: SOPDT | FOPDT) -> tuple[float, float]:
    """The sum T1 + T2, s, and the product T1 T2, s^2."""
    if isinstance(model, FOPDT):
        return model.T, 0.0
    return 2.0 * model.zeta * model.T, model.T * model.T

"""The rule of Chien, Hrones and Reswick: the fastest response with 0 or 20 % overshoot, for set-points or for loads.

    a = K L/T         set-point, 0 %          set-point, 20 %           load, 0 %              load, 20 %
    P                 0.3/a                   0.7/a                     0.3/a                  0.7/a
    PI   Kp  Ti       0.35/a  1.2 T           0.6/a  T                  0.6/a  4 L             0.7/a  2.3 L
    PID  Kp  Ti  Td   0.6/a   T     0.5 L     0.95/a  1.4 T  0.47 L     0.95/a  2.4 L  0.42 L  1.2/a  2 L  0.42 L

Source: K. L. Chien, J. A. Hrones, J. B. Reswick, On the automatic control of generalized passive systems, Trans. ASME
74, 1952; for L/T from 0.1 to 1.
"""

from __future__ import annotations

from loopwright.tuning.models import FOPDT
from loopwright.tuning.reasons import Reason, Refused
from loopwright.tuning.rules.common import one_of, ratio_within, setting
from loopwright.tuning.rules.setting import Setting

CONTROLLERS = ("p", "pi", "pid")
AIMS = ("setpoint", "load")
OVERSHOOTS_PCT = (0.0, 20.0)
RATIO = (0.1, 1.0)

# a Kp, Ti in T (set-point) or in L (load), Td in L
TABLE = {
    ("setpoint", 0.0): {"p": (0.3, 0.0, 0.0), "pi": (0.35, 1.2, 0.0), "pid": (0.6, 1.0, 0.5)},
    ("setpoint", 20.0): {"p": (0.7, 0.0, 0.0), "pi": (0.6, 1.0, 0.0), "pid": (0.95, 1.4, 0.47)},
    ("load", 0.0): {"p": (0.3, 0.0, 0.0), "pi": (0.6, 4.0, 0.0), "pid": (0.95, 2.4, 0.42)},
    ("load", 20.0): {"p": (0.7, 0.0, 0.0), "pi": (0.7, 2.3, 0.0), "pid": (1.2, 2.0, 0.42)},
}


def chien_hrones_reswick(
    model: FOPDT,
    *,
    controller: str = "pi",
    aim: str = "setpoint",
    overshoot_pct: float = 0.0,
    extrapolate: bool = False,
) -> Setting:
    """The setting of Chien, Hrones and Reswick.

    controller: "p", "pi" or "pid".
    aim: the response that the setting is made for, "setpoint" or "load".
    overshoot_pct: the overshoot of that response, 0 or 20 percent.
    extrapolate: True uses the rule outside its range of L/T, with a note.
    """
    one_of("controller", controller, CONTROLLERS)
    one_of("aim", aim, AIMS)
    if overshoot_pct not in OVERSHOOTS_PCT:
        raise Refused(Reason.BAD_INPUT, f"overshoot_pct must be 0 or 20 %, not {overshoot_pct!r}")
    notes = ratio_within(model, *RATIO, "the Chien-Hrones-Reswick rule", extrapolate)
    kp, ti, td = TABLE[aim, overshoot_pct][controller]
    unit = model.T if aim == "setpoint" else model.L
    return setting(kp * model.T / model.L / abs(model.K), ti * unit, td * model.L, notes=notes)

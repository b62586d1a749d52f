"""AMIGO: approximate M-constrained integral gain optimisation; load disturbances at Ms and Mt of 1.4 or so.

    PI     K Kp = 0.15 + (0.35 - L T/(L + T)^2) T/L    Ti = 0.35 L + 13 L T^2/(T^2 + 12 L T + 7 L^2)
    PID    K Kp = 0.2 + 0.45 T/L                       Ti = L (0.4 L + 0.8 T)/(L + 0.1 T)    Td = 0.5 L T/(0.3 L + T)

An integrating plant K exp(-L s)/s is the limit of T and K without bound with K/T constant:

    PI     K Kp = 0.35/L    Ti = 13.35 L               PID    K Kp = 0.45/L    Ti = 8 L    Td = 0.5 L

Source: T. Hagglund, K. J. Astrom, Revisiting the Ziegler-Nichols tuning rules for PI control (Asian J. Control 4,
2002), Revisiting the Ziegler-Nichols step response method for PID control (J. Process Control 14, 2004): plants with
essentially monotone step responses, any L/T. The PID's set-point weight is 0 for L <= T, else 1.
"""

from __future__ import annotations

from loopwright.tuning.models import FOPDT, Integrating
from loopwright.tuning.rules.common import needs_dead_time, no_lag, one_of, setting
from loopwright.tuning.rules.setting import Setting

CONTROLLERS = ("pi", "pid")


def amigo(model: FOPDT | Integrating, *, controller: str = "pi") -> Setting:
    """The AMIGO setting; an integrating plant must have no lag. controller: "pi" or "pid"."""
    one_of("controller", controller, CONTROLLERS)
    needs_dead_time(model, "AMIGO")
    K, L = abs(model.K), model.L
    if isinstance(model, Integrating):
        no_lag(model, "AMIGO")
        if controller == "pi":
            return setting(0.35 / L / K, 13.35 * L)
        return setting(0.45 / L / K, 8.0 * L, 0.5 * L, b=0.0)
    # in r = L/T nothing overflows before the answer does
    r, T = L / model.T, model.T
    if controller == "pi":
        kp = 0.15 + (0.35 - r / (r + 1.0) ** 2) / r
        return setting(kp / K, 0.35 * L + 13.0 * L / (1.0 + 12.0 * r + 7.0 * r * r))
    Ti, Td = L * (0.4 * L + 0.8 * T) / (L + 0.1 * T), 0.5 * L * T / (0.3 * L + T)
    return setting((0.2 + 0.45 / r) / K, Ti, Td, b=0.0 if L <= T else 1.0)

"""Lambda tuning: the closed loop gets a time constant lambda that the user chooses.

    FOPDT         Kp = T/(K (lambda + L))                  Ti = T                lambda: of the set-point response
    integrating   Kp = (2 lambda + L)/(K (lambda + L)^2)   Ti = 2 lambda + L     lambda: of the recovery from a load

Source: E. B. Dahlin, Designing and tuning digital controllers, Instruments and Control Systems 41, 1968; integrating:
practice of the paper industry (TAPPI), the IMC filter of D. E. Rivera, M. Morari, S. Skogestad, 1986, dead time by
Taylor. Defaults: lambda = 3 T (3 L for an integrating plant), the industry's cautious choice. A lambda below L is
refused: the loop then counts on a dead time known exactly.
"""

from __future__ import annotations

from loopwright.tuning.models import FOPDT, Integrating
from loopwright.tuning.reasons import Reason, Refused
from loopwright.tuning.rules.common import needs_dead_time, no_lag, positive, setting
from loopwright.tuning.rules.setting import Setting


def lambda_tuning(model: FOPDT | Integrating, *, lambda_s: float | None = None) -> Setting:
    """The setting of lambda tuning.

    lambda_s: the time constant of the closed loop, s, at least the dead time; by default 3 T, or the dead time if that
    is longer (3 L for an integrating plant).
    """
    K, L = abs(model.K), model.L
    if isinstance(model, Integrating):
        no_lag(model, "lambda tuning")
    if lambda_s is None:
        if isinstance(model, Integrating):
            needs_dead_time(model, "lambda tuning without a lambda_s")
        lambda_s = max(3.0 * model.T, L) if isinstance(model, FOPDT) else 3.0 * L
    positive("lambda_s", lambda_s, "s")
    if lambda_s < L:
        raise Refused(
            Reason.OUTSIDE_RANGE, f"lambda_s = {lambda_s:g} s is below the dead time; from {L:g} s up is accepted"
        )
    chosen = {"lambda_s": lambda_s}
    if isinstance(model, FOPDT):
        return setting(model.T / (lambda_s + L) / K, model.T, chosen=chosen)
    Ti = 2.0 * lambda_s + L
    return setting(Ti / (lambda_s + L) / (lambda_s + L) / K, Ti, chosen=chosen)

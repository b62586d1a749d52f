"""The kappa-tau rule in its step-response form for a PI: dominant pole designs of many plants, fitted in tau = L/(L +
T).

    Ms = 1.4    K Kp L/T = 0.29 exp(-2.7 tau + 3.7 tau^2)    Ti = 8.9 L exp(-6.6 tau + 3.0 tau^2)
    Ms = 2      K Kp L/T = 0.78 exp(-4.1 tau + 5.7 tau^2)    Ti as above

Ms is the value that the designs were made for, 1.4 (cautious) or 2 (fast). The Ms of a loop differs, as the fit covers
many plants: with Ms = 1.4 the loop of a FOPDT plant has 1.25 to 1.35.

Source: K. J. Astrom, T. Hagglund, PID controllers: theory, design and tuning, 2nd edition, 1995, section 5.3: plants
with essentially monotone step responses, L/T from 0.1 to 5.5. The book's PID fits are left out: they are for plants
of higher order, and their ideal derivative makes the loop of a FOPDT plant with L/T below 0.2 unstable.
"""

from __future__ import annotations

import math

from loopwright.tuning.models import FOPDT
from loopwright.tuning.reasons import Reason, Refused
from loopwright.tuning.rules.common import ratio_within, setting
from loopwright.tuning.rules.setting import Setting

MS = (1.4, 2.0)
RATIO = (0.1, 5.5)


def kappa_tau(model: FOPDT, *, Ms: float = 1.4, extrapolate: bool = False) -> Setting:
    """The kappa-tau setting. Ms: 1.4 or 2. extrapolate: True uses the rule outside its range of L/T, with a note."""
    if Ms not in MS:
        raise Refused(Reason.BAD_INPUT, f"Ms must be 1.4 or 2, not {Ms!r}")
    notes = ratio_within(model, *RATIO, "the kappa-tau rule", extrapolate)
    L, T = model.L, model.T
    tau = L / (L + T)
    kp = 0.29 * math.exp(tau * (-2.7 + 3.7 * tau)) if Ms == 1.4 else 0.78 * math.exp(tau * (-4.1 + 5.7 * tau))
    Ti = 8.9 * L * math.exp(tau * (-6.6 + 3.0 * tau))
    return setting(kp * T / L / abs(model.K), Ti, chosen={"Ms": Ms}, notes=notes)

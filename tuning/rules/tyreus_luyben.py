"""The rule of Tyreus and Luyben: a well damped setting from the ultimate cycle.

    PI     Kp = Ku/3.2    Ti = 2.2 Pu
    PID    Kp = Ku/2.2    Ti = 2.2 Pu    Td = Pu/6.3

Sources: B. D. Tyreus, W. L. Luyben, Tuning PI controllers for integrator/dead time processes, Ind. Eng. Chem. Res. 31,
1992; the PID: W. L. Luyben, M. L. Luyben, Essentials of process control, 1997. Made for plants that integrate or are
dominated by their lag; the PI of variant "0.45", Ti = Pu/0.45, is what the ME-PSO paper's table was made with.
"""

from __future__ import annotations

from loopwright.tuning.analysis.margins import ultimate_point
from loopwright.tuning.models import Model, integrators
from loopwright.tuning.rules.common import one_of, positive, refuse_unstable, setting, stable_plant
from loopwright.tuning.rules.setting import Setting

CONTROLLERS = ("pi", "pid")
VARIANTS = ("2.2", "0.45")


def ultimate(Ku: float, Pu: float, *, controller: str = "pi", variant: str = "2.2") -> Setting:
    """The setting from the ultimate gain Ku (MV units per PV unit) and the ultimate period Pu (s)."""
    one_of("controller", controller, CONTROLLERS)
    one_of("variant", variant, VARIANTS)
    positive("Ku", Ku, "MV units per PV unit")
    positive("Pu", Pu, "s")
    chosen = {"Ku": Ku, "Pu_s": Pu}
    Ti = 2.2 * Pu if variant == "2.2" else Pu / 0.45
    if controller == "pi":
        return setting(Ku / 3.2, Ti, chosen=chosen)
    return setting(Ku / 2.2, Ti, Pu / 6.3, chosen=chosen)


def tyreus_luyben(model: Model, *, controller: str = "pi", variant: str = "2.2") -> Setting:
    """The setting from the model's own ultimate point.

    Raises Refused: CANNOT_OSCILLATE for a plant without an ultimate point; OUTSIDE_RANGE where the loop would be
    unstable, as with a PID on a plant with L/T above 5.
    """
    one_of("controller", controller, CONTROLLERS)
    one_of("variant", variant, VARIANTS)
    stable_plant(model, "Tyreus-Luyben")
    found = ultimate(*ultimate_point(model), controller=controller, variant=variant)
    # with a long dead time the ideal derivative alone makes the loop unstable
    return found if integrators(model) else refuse_unstable(model, found, "Tyreus-Luyben")

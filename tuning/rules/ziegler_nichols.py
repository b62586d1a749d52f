"""The two rules of Ziegler and Nichols: quarter decay of a load disturbance.

    ultimate cycle          Kp         Ti       Td            step response       Kp       Ti     Td
    P                       0.5 Ku                            P                   1/a
    PI                      0.45 Ku    Pu/1.2                 PI                  0.9/a    L/0.3
    PID                     0.6 Ku     Pu/2     Pu/8          PID                 1.2/a    2 L    L/2

a = K L/T for a self-regulating plant, K L for an integrating one: the steepest slope times the apparent dead time.

Source: J. G. Ziegler, N. B. Nichols, Optimum settings for automatic controllers, Trans. ASME 64, 1942. The step rule
is for L/T up to 1; below 0.1 the dead time is too short to be read from a step, and the gain too high to be used.
"""

from __future__ import annotations

from loopwright.tuning.analysis.margins import ultimate_point
from loopwright.tuning.models import FOPDT, Integrating, Model, integrators
from loopwright.tuning.rules.common import (
    needs_dead_time,
    one_of,
    positive,
    ratio_within,
    refuse_unstable,
    setting,
    stable_plant,
)
from loopwright.tuning.rules.setting import Setting

CONTROLLERS = ("p", "pi", "pid")
RATIO = (0.1, 1.0)


def ultimate(Ku: float, Pu: float, *, controller: str = "pi") -> Setting:
    """The setting from the ultimate gain Ku (MV units per PV unit) and the ultimate period Pu (s)."""
    one_of("controller", controller, CONTROLLERS)
    positive("Ku", Ku, "MV units per PV unit")
    positive("Pu", Pu, "s")
    chosen = {"Ku": Ku, "Pu_s": Pu}
    if controller == "p":
        return setting(0.5 * Ku, chosen=chosen)
    if controller == "pi":
        return setting(0.45 * Ku, Pu / 1.2, chosen=chosen)
    return setting(0.6 * Ku, 0.5 * Pu, 0.125 * Pu, chosen=chosen)


def zn_ultimate(model: Model, *, controller: str = "pi") -> Setting:
    """The setting from the model's own ultimate point.

    Raises Refused: CANNOT_OSCILLATE for a plant without an ultimate point; OUTSIDE_RANGE where the loop would be
    unstable, as with a PID on a plant with L/T from about 5.
    """
    one_of("controller", controller, CONTROLLERS)
    stable_plant(model, "Ziegler-Nichols")
    found = ultimate(*ultimate_point(model), controller=controller)
    # with a long dead time the ideal derivative alone makes the loop unstable
    return found if integrators(model) else refuse_unstable(model, found, "Ziegler-Nichols")


def zn_step(model: FOPDT | Integrating, *, controller: str = "pi", extrapolate: bool = False) -> Setting:
    """The setting from the step response. The lag of an integrating plant counts as dead time: its ramp starts at L +
    T.

    extrapolate: True uses the rule outside its range of L/T, with a note.
    """
    one_of("controller", controller, CONTROLLERS)
    notes: tuple[str, ...] = ()
    if isinstance(model, FOPDT):
        notes = ratio_within(model, *RATIO, "the Ziegler-Nichols step rule", extrapolate)
        L, slope = model.L, abs(model.K) / model.T
    else:
        L, slope = model.L + model.T, abs(model.K)
        if L == 0.0:
            needs_dead_time(model, "the Ziegler-Nichols step rule")
    inverse_a = 1.0 / L / slope
    if controller == "p":
        return setting(inverse_a, notes=notes)
    if controller == "pi":
        return setting(0.9 * inverse_a, L / 0.3, notes=notes)
    return setting(1.2 * inverse_a, 2.0 * L, 0.5 * L, notes=notes)

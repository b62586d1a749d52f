"""Controller settings in the ISA (standard) form, the only form used inside Loopwright.

u = Kp * ( b*SP - PV  +  1/Ti * integral(SP - PV)  +  Td * d/dt(c*SP - PV) / (1 + Tf*s) )
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Gains:
    """ISA gains of a PI(D) controller.

    Kp: MV units per PV unit (positive; the direction of action is the controller's).
    Ti: integral time, s; 0 means no integral action (as in the device's object dictionary).
    Td: derivative time, s.  Tf: derivative filter time, s.
    b, c: set-point weights of the proportional and derivative paths.
    """

    Kp: float
    Ti: float = 0.0
    Td: float = 0.0
    Tf: float = 0.0
    b: float = 1.0
    c: float = 0.0

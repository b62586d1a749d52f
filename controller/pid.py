"""The control law: ISA PI(D) with two degrees of freedom, sampled.

    e = SP - PV (reverse action) or PV - SP (direct action: both terms change sign)
    u = Kp*(b*SP - PV) + I + D,   I' = Kp*e/Ti,   D = Kp*Td*s/(1 + Tf*s) * (c*SP - PV)

I is a forward difference (the present error acts from the next sample on), D a backward one, so Tf = 0 is allowed.
With Ti = 0, I is the constant bias of a P controller. Every change of the law re-bases I so that the output stays where
it is, and restarts D, because its history belongs to the previous law.
"""

from __future__ import annotations

import math
from dataclasses import astuple, dataclass

from loopwright.protocol.real32 import fits


@dataclass(frozen=True, slots=True)
class Parameters:
    """The parameters of the control law in the ISA form.

    Kp: gain, MV units per PV unit; positive.
    Ti, Td, Tf: integral, derivative and filter time, s; Ti = 0 for no integral action.
    b, c: set-point weights of P and D.
    Raises ValueError.
    """

    Kp: float
    Ti: float = 0.0
    Td: float = 0.0
    Tf: float = 0.0
    b: float = 1.0
    c: float = 0.0

    def __post_init__(self) -> None:
        if not all(fits(value) for value in astuple(self)):
            raise ValueError("controller parameters must be finite, and within the range of a REAL32")
        if self.Kp <= 0:
            raise ValueError("Kp must be positive: the direction is set by the controller's action")
        if min(self.Ti, self.Td, self.Tf) < 0:
            raise ValueError("Ti, Td and Tf must not be negative")


class Pid:
    """One control law with its state. Call `rebase` before the first `step`."""

    __slots__ = ("_b", "_c", "_decay", "_derivative", "_gain", "_integral", "_kick", "_last", "_per_sample", "_track")

    def __init__(self, sample_time_s: float, parameters: Parameters, reverse: bool) -> None:
        if not (sample_time_s > 0 and math.isfinite(sample_time_s)):
            raise ValueError("sample time must be finite and positive")
        Ts, p = sample_time_s, parameters
        self._gain = gain = p.Kp if reverse else -p.Kp
        self._b = p.b
        self._c = p.c
        self._per_sample = gain * Ts / p.Ti if p.Ti else 0.0
        # Back-calculation discharges the integral with Ti, or with the usual sqrt(Ti*Td) when there is a derivative,
        # but never faster than one sample. The bias of a P controller cannot wind up, so it is not changed.
        tracking = math.sqrt(p.Ti * p.Td) if p.Td else p.Ti
        self._track = Ts / max(tracking, Ts) if p.Ti else 0.0
        self._decay = p.Tf / (p.Tf + Ts)
        self._kick = gain * p.Td / (p.Tf + Ts)
        self._integral = 0.0
        self._derivative = 0.0
        self._last = 0.0

    def rebase(self, setpoint: float, pv: float, output: float) -> None:
        """Makes the control law continue at `output`."""
        self._integral = output - self._gain * (self._b * setpoint - pv)
        self._derivative = 0.0
        self._last = self._c * setpoint - pv

    def step(self, setpoint: float, pv: float, low: float, high: float) -> float:
        """Computes one sample. Returns the output within low..high; the limits also keep the integral from winding
        up."""
        wanted = self._integral + self._gain * (self._b * setpoint - pv)
        if self._kick:
            moved = self._c * setpoint - pv
            self._derivative = self._decay * self._derivative + self._kick * (moved - self._last)
            self._last = moved
            wanted += self._derivative
        output = low if wanted < low else high if wanted > high else wanted
        self._integral += self._per_sample * (setpoint - pv) + self._track * (output - wanted)
        return output

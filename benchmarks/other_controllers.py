"""Controllers that do not do what their gains say, in place of our device.

They are written for themselves, with another sampling of the integral and of the filters than ours.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from loopwright.controller.channel import Channel, Settings
from loopwright.controller.pid import Parameters
from loopwright.tuning.gains import Gains
from loopwright.tuning.plan import Mode


@dataclass(frozen=True, slots=True)
class Other:
    """In what a controller differs from the law that it is said to have.

    gain, Ti: factors of Kp and Ti.  filter: of PV inside, Pu.  parallel: Ki and Kd are not times Kp.  series: the
    gains are those of the series form.  b, c: the weights in force, None for those that are said.  unfiltered: the
    derivative has no filter.  late: MV is computed from the PV of so many samples before.  steps: of MV, in parts of
    Kp times the permitted step of the set-point.
    """

    gain: float = 1.0
    Ti: float = 1.0
    filter: float = 0.0
    parallel: bool = False
    series: bool = False
    b: float | None = None
    c: float | None = None
    unfiltered: bool = False
    late: int = 0
    steps: float = 0.0
    derivative: bool = False

    def terms(self, said: Gains) -> tuple[float, float, float, float]:
        """The gains of the three terms and the filter time of the derivative: u = P (..) + I int e + D d/dt(..)."""
        Kp, Ti = self.gain * said.Kp, self.Ti * said.Ti
        lag = 0.0 if self.unfiltered else said.Tf
        if self.parallel:
            return Kp, 1.0 / Ti, said.Td, lag
        if self.series and said.Td > 0.0:
            # Kp (1 + 1/(Ti s)) (1 + Td s)/(1 + Tf s) by partial fractions: P + I/s + D s/(1 + Tf s)
            P = Kp * (1.0 + (said.Td - lag) / Ti)
            return P, Kp / Ti, Kp * said.Td - P * lag, lag
        return Kp, Kp / Ti, Kp * said.Td, lag

    def isa(self, said: Gains) -> Gains:
        """The gains in ISA form that are in force."""
        P, integral, D, lag = self.terms(said)
        return Gains(P, P / integral, D / P, lag)


class OtherLaw:
    """The law, in the place of `controller.pid.Pid`."""

    def __init__(self, other: Other, sample_time_s: float, said: Parameters, reverse: bool, period_s: float) -> None:
        self._other, self._Ts, self._sign = other, sample_time_s, 1.0 if reverse else -1.0
        self._P, self._I, self._D, self._lag = other.terms(_gains(said))
        self._b = said.b if other.b is None else other.b
        self._c = said.c if other.c is None else other.c
        time = other.filter * period_s
        self._pole = math.exp(-sample_time_s / time) if time else 0.0
        self._line: list[float] = []
        self._seen = self._e = self._u = self._moved = self._d = self._p = 0.0

    def follow(self, before: OtherLaw) -> None:
        """Takes over what filter and line hold: they know nothing of gains."""
        self._line, self._seen = before._line, before._seen

    def rebase(self, setpoint: float, pv: float, output: float) -> None:
        self._seen = self._seen if self._line else pv
        self._line = self._line or [pv] * (self._other.late + 1)
        self._e = setpoint - self._seen
        self._p = self._P * (self._b * setpoint - self._seen)
        self._moved, self._d, self._u = self._c * setpoint - self._seen, 0.0, output

    def step(self, setpoint: float, pv: float, low: float, high: float) -> float:
        """The velocity form: increments, with the trapezoidal rule for the integral."""
        self._line = [*self._line[1:], pv]
        self._seen = self._pole * self._seen + (1.0 - self._pole) * self._line[0]
        e, moved = setpoint - self._seen, self._c * setpoint - self._seen
        p = self._P * (self._b * setpoint - self._seen)
        # Tustin where it is far from ringing, else the difference
        slow = self._lag > self._Ts
        a = (2.0 * self._lag - self._Ts) / (2.0 * self._lag + self._Ts) if slow else self._lag / (self._lag + self._Ts)
        k = 2.0 * self._D / (2.0 * self._lag + self._Ts) if slow else self._D / (self._lag + self._Ts)
        d = a * self._d + k * (moved - self._moved)
        i = self._I * self._Ts * 0.5 * (e + self._e)
        wanted = self._u + self._sign * (p - self._p + i + d - self._d)
        self._p, self._d, self._e, self._moved = p, d, e, moved
        self._u = min(max(wanted, low), high)
        quantum = self._other.steps
        return round(self._u / quantum) * quantum if quantum else self._u


class OtherChannel(Channel):
    """Our device with another law in it."""

    def __init__(
        self, other: Other, period_s: float, sample_time_s: float, settings: Settings, parameters: Parameters,
        setpoint: float, mode: Mode | int, manual_output: float = 0.0,
    ) -> None:  # fmt: skip
        self._other, self._period_s = other, period_s
        super().__init__(sample_time_s, settings, parameters, setpoint, mode, manual_output)
        self._pid = self._law(parameters)  # type: ignore[assignment]  # rebase and step are all that it is asked for

    def _law(self, parameters: Parameters) -> OtherLaw:
        return OtherLaw(self._other, self._sample_time_s, parameters, self._settings.reverse, self._period_s)

    def _use(self, parameters: Parameters) -> None:
        before = self._pid
        super()._use(parameters)
        law = self._law(parameters)
        assert isinstance(before, OtherLaw)
        law.follow(before)
        if self.pv is not None:
            law.rebase(self._setpoint, self.pv, self._takes_over)
        self._pid = law  # type: ignore[assignment]


def _gains(said: Parameters) -> Gains:
    return Gains(said.Kp, said.Ti, said.Td, said.Tf, said.b, said.c)


PI = {
    "as said, another sampling": Other(),
    "MV a sample late": Other(late=1),
    "Kp x 0.7": Other(gain=0.7),
    "Kp x 1.2": Other(gain=1.2),
    "Kp x 1.4": Other(gain=1.4),
    "Ti x 0.5": Other(Ti=0.5),
    "Ti x 2": Other(Ti=2.0),
    "filter 0.02 Pu": Other(filter=0.02),
    "filter 0.05 Pu": Other(filter=0.05),
    "filter 0.1 Pu": Other(filter=0.1),
    "filter 0.2 Pu": Other(filter=0.2),
    "parallel": Other(parallel=True),
    "b = 0": Other(b=0.0),
    "Kp x 1.2 and filter 0.1 Pu": Other(gain=1.2, filter=0.1),
}
PID = {
    f"PID, {name}": replace(other, derivative=True)
    for name, other in {
        "as said, another sampling": Other(),
        "Kp x 1.4": Other(gain=1.4),
        "filter 0.1 Pu": Other(filter=0.1),
        "derivative of the error": Other(c=1.0),
        "no derivative filter": Other(unfiltered=True),
        "series": Other(series=True),
        "parallel": Other(parallel=True),
    }.items()
}

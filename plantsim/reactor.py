"""A stirred reactor with free outflow, A + B -> C, exothermic; MV opens both feeds, PV is the concentration of C.

Source: Stopakevych et al., Problemele Energeticii Regionale. The print is damaged in four places; the values used here
close the steady-state balance (heat of reaction, feed reference temperature) and give the printed ultimate point
(actuator lag 4 s, sensor delay 10 s).

    m = (rhoA*FA + rhoB*FB) / (S*rhow)              inflow as a rate of level, m/s
    n = k0*exp(-(E/R)/T)*CA*CB                      rate of reaction, mol/(m3 s)
    CA' = CAi*FA/(S*h) - m*CA/h - n                 CB' likewise;  CC' = n - m*CC/h
    h'  = m - (r/S)*sqrt(h)
    T'  = heat of both feeds - m*(T - Te)/h - n*dh_r/(rhow*cPw)
"""

from __future__ import annotations

import math
import random
from collections import deque

from loopwright.plantsim.models import split_dead_time

FEED_A = 1000.0  # CAi, mol/m3
FEED_B = 1000.0  # CBi, mol/m3
RHO_A, RHO_B, RHO_W = 1050.0, 789.0, 1000.0  # kg/m3
CP_A, CP_B, CP_W = 2069.9417, 2419.3618, 4178.1909  # J/(kg K)
AREA = 2.0  # S, m2
OUTFLOW = 0.894  # r, m^2.5/s
HEAT = -2690.0  # dh_r, J/mol
RATE = 1000.0  # k0
ACTIVATION = 5458.2632  # E/R, K
INLET = 400.0  # TAi = TBi, K
REFERENCE = 298.15  # Te, K
FLOW_A, FLOW_B = 0.01, 0.004  # m3/s per percent of MV

ACTUATOR_LAG_S = 4.0
SENSOR_DELAY_S = 10.0
MV_NOMINAL = 50.0  # percent
# Below this opening (percent) the vessel nearly empties and the equations are not valid, so the valves leak.
LEAK = 2.0

STEADY_STATE = (
    682.9949686543955067,
    243.6276575823393102,
    49.2838831323648137,
    0.5833268771676953,
    350.6083211506618795,
)
"""Steady state at 50 %: CA, CB, CC in mol/m3, h in m, T in K."""

_MAX_SUBSTEP_S = 0.25  # RK4 is exact to 1e-6 mol/m3 here, and stable down to the leak (fastest rate 7 1/s)

State = tuple[float, float, float, float, float]

_M = (RHO_A * FLOW_A + RHO_B * FLOW_B) / (AREA * RHO_W)
_A_IN = FEED_A * FLOW_A / AREA
_B_IN = FEED_B * FLOW_B / AREA
_HEAT_IN = (RHO_A * CP_A * FLOW_A + RHO_B * CP_B * FLOW_B) / (RHO_W * CP_W * AREA)
_HEAT_OF_REACTION = HEAT / (RHO_W * CP_W)
_LEVEL_OUT = OUTFLOW / AREA


def derivative(state: State, opening: float, inlet_K: float) -> State:
    """Returns the time derivatives of CA, CB, CC, h, T.

    opening: MV behind the actuator's lag, percent.
    inlet_K: temperature of both feeds, K.
    """
    CA, CB, CC, h, T = state
    m = _M * opening
    n = RATE * math.exp(-ACTIVATION / T) * CA * CB
    out = m / h
    return (
        _A_IN * opening / h - out * CA - n,
        _B_IN * opening / h - out * CB - n,
        n - out * CC,
        m - _LEVEL_OUT * math.sqrt(h),
        _HEAT_IN * opening * (inlet_K - REFERENCE) / h - out * (T - REFERENCE) - n * _HEAT_OF_REACTION,
    )


def _ahead(state: State, slope: State, dt: float) -> State:
    a, b, c, h, T = state
    da, db, dc, dh, dT = slope
    return a + dt * da, b + dt * db, c + dt * dc, h + dt * dh, T + dt * dT


class Reactor:
    """The simulated reactor: MV in percent, PV in mol/m3, at rest at 50 % initially.

    The sensor's delay is applied to the inputs instead (a delay commutes with a time-invariant process), which makes it
    exact for any sample time; so `state` is the state that the sensor shows now.
    inlet_offset_K: a disturbance, added to the temperature of both feeds, K.
    disturbance: a load disturbance, percent, added after the limits of MV.
    gain: so many times as large is what MV and the load move of the flow, from where the reactor is at rest.
    """

    def __init__(
        self,
        sample_time_s: float,
        noise_std: float = 0.0,
        seed: int = 1,
        mv_low: float = 0.0,
        mv_high: float = 100.0,
    ) -> None:
        if mv_low > mv_high:
            raise ValueError("mv_low must not exceed mv_high")
        whole, late = split_dead_time(SENSOR_DELAY_S, sample_time_s)
        rest = (MV_NOMINAL, INLET)
        self._line = deque([rest] * whole)
        self._before = rest
        self._late_s = late
        self._sample_time_s = sample_time_s
        self._opening = MV_NOMINAL
        self._mv = MV_NOMINAL
        self._mv_low = mv_low
        self._mv_high = mv_high
        self._random = random.Random(seed)
        self.state: State = STEADY_STATE
        self.disturbance = 0.0
        self.gain = 1.0
        self.inlet_offset_K = 0.0
        self.noise_std = noise_std
        self._pv = self._measured()

    @property
    def pv(self) -> float:
        return self._pv

    def step(self, mv: float) -> float:
        if mv == mv:
            self._mv = self._mv_low if mv < self._mv_low else self._mv_high if mv > self._mv_high else mv
        opening = self._mv + self.disturbance
        if self.gain != 1.0:
            opening = MV_NOMINAL + self.gain * (opening - MV_NOMINAL)
        self._line.append((max(opening, LEAK), INLET + self.inlet_offset_K))
        entering = self._line.popleft()
        if self._late_s:
            self._run(*self._before, self._late_s)
        self._run(*entering, self._sample_time_s - self._late_s)
        self._before = entering
        self._pv = self._measured()
        return self._pv

    def _measured(self) -> float:
        return self.state[2] + (self._random.gauss(0.0, self.noise_std) if self.noise_std else 0.0)

    def _run(self, command: float, inlet_K: float, duration: float) -> None:
        """Integrates over `duration` s with constant inputs: the actuator's lag in closed form, the vessel by
        Runge-Kutta 4."""
        substeps = math.ceil(duration / _MAX_SUBSTEP_S)
        dt = duration / substeps
        half_decay = math.exp(-0.5 * dt / ACTUATOR_LAG_S)
        state = self.state
        offset = self._opening - command
        for _ in range(substeps):
            middle = offset * half_decay
            end = middle * half_decay
            k1 = derivative(state, command + offset, inlet_K)
            k2 = derivative(_ahead(state, k1, 0.5 * dt), command + middle, inlet_K)
            k3 = derivative(_ahead(state, k2, 0.5 * dt), command + middle, inlet_K)
            k4 = derivative(_ahead(state, k3, dt), command + end, inlet_K)
            state = _ahead(_ahead(_ahead(_ahead(state, k1, dt / 6), k2, dt / 3), k3, dt / 3), k4, dt / 6)
            offset = end
        self.state = state
        self._opening = command + offset

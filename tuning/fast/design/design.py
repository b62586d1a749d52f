"""This module finds the best PI or PID on a model for a robustness that the user asks for. The design minimises

    J = share IAE_r/IAE_r° + (1 - share) IAE_d/IAE_d°  under Ms <= asked (and Mt, and a bound on the noise gain)

where IAE_r follows a unit set-point step and IAE_d a unit load disturbance; ° marks the minimum of each IAE alone under
the same bounds. The share is that of the aim (`Aim`). The controller has two degrees of freedom: the set-point weight b
moves IAE_r alone, none of the bounds. For each (Ti, Td) the largest gains are known in closed form (`gain_bounds`), and
for each of these the best b (`iae`), so that the search runs over one number (PI) or two (PID). A settling time and a
largest movement of MV that are asked for bound b too (`weight_bounds`), and Ms with it (`requirements`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from scipy.optimize import minimize

from loopwright.tuning.analysis.comparison import StepPerformance, setpoint_performance
from loopwright.tuning.analysis.stability import is_stable
from loopwright.tuning.fast.design.gain_bounds import does_not_encircle, largest_gains
from loopwright.tuning.fast.design.iae import Cost, LoopCost
from loopwright.tuning.fast.design.weight_bounds import KEPT, DesignBounds, Missed, weights
from loopwright.tuning.gains import Gains
from loopwright.tuning.models import Complexes, Model, Reals, TransferFunction, sign
from loopwright.tuning.reasons import Reason, Refused

POINTS = 440
LOWEST, HIGHEST = 10**-2.8, 10**1.6
"""Ends of the frequency grid, in units of 2*pi/period."""
MAX_DEAD_TIME_ANGLE = 13.0
"""Phase w*L in rad above which the dead time turns the loop by more than 0.3 rad between neighbouring grid points."""
TAIL_FACTOR = 1e3
"""Factor above the grid's highest frequency up to which feed-through, or a lag too fast for the record, is bounded."""
TAIL_MARGIN = 0.6
"""Fraction of the high-frequency bound that a controller with derivative may use: a derivative acts at frequencies at
which the record says least of the plant."""
MIN_PERIOD_RATIO, MAX_PERIOD_RATIO = 0.25, 1.3
"""Limits of the model's own ultimate period, as a ratio to the period of the relay."""
TI = np.geomspace(0.04, 30.0, 30)  # Ti of the PI grid, in periods
HALVINGS = 5
PID_TI = np.geomspace(0.1, 8.0, 11)  # Ti of the PID grid, in periods
PID_TD = (0.03, 0.06, 0.15, 0.25, 0.4, 0.65)  # Td as a fraction of Ti
MIN_TD, MIN_TI = 0.045, 0.08  # periods
MAX_TD = 2.0  # Td as a multiple of Ti
PID_STEPS = 45
MAX_J_RATIO = 0.97
"""The PID is taken only if its J is below this fraction of the J of the best PI."""
WEIGHTS = (0.0, 1.0)
"""The smallest and the largest set-point weight b, unless another is permitted: most controllers hold b at 0 to 1."""
MAX_WEIGHT = 2.0
"""The largest set-point weight that may be permitted. The best b is above one where the dead time is longer than the
lags, or where the Ms asked for is small: Kp is then so small that b*Kp moves MV about as far as it has to go in the
end."""
MAX_OVERSHOOT = 0.01
"""Largest overshoot of the aim no_overshoot on the model, as a fraction of the set-point step."""
WIDER_OVERSHOOTS, MAX_PRICE = (0.02, 0.05), 1.5
"""DesignBounds on the overshoot that follow where one raises J by more than the factor MAX_PRICE."""
MAX_COST_RATIO = 1.2
"""Factor by which a settling time may raise J beyond that of the best gains for the same Ms. More of it is bought with
an integral time so long that PV reaches the band by b*Kp alone, and loads are corrected ten times as slowly."""
MAX_SETTLING_S, MAX_MV_PEAK = 1e8, 1e9
"""Largest values that may be asked for, s and MV units per PV unit."""
_MISSED = 1e3
"""J of gains that miss a requirement, for a search that follows one number; those that move MV too far have ten times
as much."""


class Aim(StrEnum):
    """What the gains are the best for, under the robustness asked for.

    balanced: J is half the IAE after a set-point step and half the IAE after a load disturbance.
    setpoint: J is nine tenths the IAE after a set-point step and a tenth the IAE after a load disturbance. The least
    IAE after a set-point step alone would be a controller with hardly any integral, whose kick brings PV to the
    set-point if the model's gain is exact, and which corrects a load disturbance ten times as slowly.
    load: J is the IAE after a load disturbance; the set-point weight then has the least IAE after a set-point step.
    no_overshoot: as balanced, and PV overshoots a set-point step by at most MAX_OVERSHOOT.
    """

    BALANCED = "balanced"
    SETPOINT = "setpoint"
    LOAD = "load"
    NO_OVERSHOOT = "no_overshoot"

    @property
    def share(self) -> float:
        """The share of the set-point's IAE in J; the load's has the rest."""
        return {Aim.SETPOINT: 0.9, Aim.LOAD: 0.0}.get(self, 0.5)

    @property
    def max_overshoot(self) -> float | None:
        """The largest permitted overshoot, a fraction of the set-point step; None for no bound."""
        return MAX_OVERSHOOT if self is Aim.NO_OVERSHOOT else None


def aim_of(name: str) -> Aim:
    """The aim of this name. Raises Refused, BAD_INPUT."""
    try:
        return Aim(name)
    except ValueError:
        raise Refused(Reason.BAD_INPUT, f"aim must be one of {', '.join(Aim)}, not {name!r}") from None


@dataclass(frozen=True, slots=True)
class DesignSpec:
    """The design specification: the robustness and the controller that the user asks for.

    Ms: the maximum sensitivity permitted; 1.2 is robust, 1.6 the default, 2.0 fast.
    derivative: True permits a PID, which is taken where it lowers J.
    Mt: the largest permitted peak of the closed loop |L/(1+L)|, None for no bound.
    noise_gain: the largest permitted answer of MV to a jump of PV, MV units per PV unit, None for no bound.
    N: the derivative filter has the time constant Td/N.
    aim: what the gains are the best for.
    weights: the smallest and the largest set-point weight b; equal where b is given.
    settling_s: the longest time, s, from a set-point step until PV stays within 5 % of it; None for no bound. The gains
    are then those for the smallest Ms that permits it, see `tuning.fast.requirements`.
    mv_peak: the largest permitted change of MV after a set-point step, MV units per PV unit of the step, None for no
    bound.
    """

    Ms: float = 1.6
    derivative: bool = False
    Mt: float | None = None
    noise_gain: float | None = None
    N: float = 10.0
    aim: Aim = Aim.BALANCED
    weights: tuple[float, float] = WEIGHTS
    settling_s: float | None = None
    mv_peak: float | None = None

    def __post_init__(self) -> None:
        for name, value, low, high in (
            ("Ms", self.Ms, 1.1, 3.0), ("Mt", self.Mt, 1.0, 3.0), ("N", self.N, 2.0, 100.0),
            ("noise_gain", self.noise_gain, 0.0, math.inf), ("settling_s", self.settling_s, 0.0, MAX_SETTLING_S),
            ("mv_peak", self.mv_peak, 0.0, MAX_MV_PEAK),
        ):  # fmt: skip
            if value is not None and not low < value < high:
                raise Refused(Reason.BAD_INPUT, f"{name} must be above {low:g} and below {high:g}, not {value!r}")
        low, high = self.weights
        if not 0.0 <= low <= high < math.inf:
            raise Refused(Reason.BAD_INPUT, f"weights must be two rising numbers from 0 up, not {self.weights!r}")

    @property
    def has_requirements(self) -> bool:
        """Whether a settling time or a largest movement of MV is asked for."""
        return self.settling_s is not None or self.mv_peak is not None

    @property
    def requirements(self) -> dict[str, float]:
        """What is asked for beside Ms and Mt: settling_s, mv_peak and noise_gain as far as they are, and
        setpoint_weight_max where it is not that of WEIGHTS."""
        highest = self.weights[1]
        asked = {
            "settling_s": self.settling_s, "mv_peak": self.mv_peak, "noise_gain": self.noise_gain,
            "setpoint_weight_max": None if highest == WEIGHTS[1] else highest,
        }  # fmt: skip
        return {name: value for name, value in asked.items() if value is not None}


@dataclass(frozen=True, slots=True)
class OptimalGains:
    """The gains that minimise J under the bounds.

    gains: the ISA gains of a controller whose action has the plant's sign; b is the set-point weight, c is 0.
    J: the value of the criterion, without unit.
    cost: the two IAE of which J is made.
    minimum: the smallest IAE_r and IAE_d by which J is normalised.
    Ms: the bound on Ms that they were designed for: the one asked for, or the smallest that permits the settling time.
    missed: by how much the requirements are not kept in the simulation of the design.
    """

    gains: Gains
    J: float
    cost: Cost
    minimum: Cost
    Ms: float
    missed: Missed = KEPT

    @property
    def order(self) -> tuple[tuple[float, float], float]:
        """What orders gains: by what they miss, then by J."""
        return self.missed.order, self.J


_Candidate = tuple[Gains, Cost, Missed]


class GainDesign:
    """The search for the best gains on one model.

    model: the process model; its dead time includes the delay of the sampling.
    relay_period: the period of the relay oscillation, s.
    """

    def __init__(self, model: Model, spec: DesignSpec, relay_period: float) -> None:
        positive = TransferFunction(tuple(sign(model) * c for c in model.num), model.den, model.L)
        self.model, self.spec = positive, spec
        self.period = own_period(positive, relay_period)
        self.w = frequencies(self.period)
        self.G = positive.frequency_response(self.w)
        self.cost = LoopCost(positive, self.period)
        # where the dead time turns faster than the grid can follow, and above the grid, only the loop's size is bounded
        end = float(self.w[-1])
        start = min(MAX_DEAD_TIME_ANGLE / positive.L, end) if positive.L > 0.0 else end
        self.tail = np.geomspace(start, TAIL_FACTOR * end, POINTS)
        self.G_tail = positive.frequency_response(self.tail)
        self.minimum: Cost | None = None
        self.bounds = DesignBounds(spec.Ms)
        """The bounds that are in effect."""
        self.without_time: OptimalGains | None = None
        """The gains that others are measured by, see `best_within`."""
        self._best_under: dict[DesignBounds, OptimalGains] = {}
        self._steps: dict[Gains, StepPerformance | None] = {}

    def best(self) -> OptimalGains:
        """The best PI, or the best PID where it is permitted and lowers J, under the bounds on Ms, Mt, the noise gain
        and the overshoot; a settling time and a movement of MV are left to `tuning.fast.requirements`. Raises Refused,
        NOT_ROBUST: no gain meets the bounds.

        A bound on the overshoot that would raise J by more than MAX_PRICE is widened: a fitted model may have a slow
        ripple of one percent that its record hardly shows, and no loop that is worth having is without it.
        """
        if self.spec.aim.max_overshoot is None:
            return self._best()
        free = self._best()
        for overshoot in (self.spec.aim.max_overshoot, *WIDER_OVERSHOOTS):
            self.bounds, self.minimum = DesignBounds(self.spec.Ms, overshoot), None
            try:
                held = self._best()
            except Refused:  # not one PI keeps it
                continue
            if self._J(held.cost, free.minimum) <= MAX_PRICE * free.J:
                return held
        self.bounds, self.minimum = DesignBounds(self.spec.Ms), free.minimum
        return free

    def best_within(self, bounds: DesignBounds, without_time: OptimalGains | None = None) -> OptimalGains:
        """The best PI or PID under these bounds in place of those of the specification; where none keeps the settling
        time and the movement of MV, those that miss them least.

        without_time: the best gains without the settling time; gains with more than MAX_COST_RATIO times their J are
        left out.
        Raises Refused, NOT_ROBUST.
        """
        if without_time is None and bounds in self._best_under:
            return self._best_under[bounds]
        self.bounds, self.without_time = bounds, without_time
        self.minimum = None if without_time is None else without_time.minimum
        try:
            best = self._best()
        finally:
            self.bounds, self.without_time = DesignBounds(self.spec.Ms), None
        if without_time is None:
            self._best_under[bounds] = best
        return best

    def setpoint_step(self, gains: Gains) -> StepPerformance | None:
        """The exact response of the continuous loop to a set-point step; None where the loop is unstable."""
        if gains not in self._steps:
            self._steps[gains] = setpoint_performance(self.model, gains)
        return self._steps[gains]

    def J(self, best: OptimalGains, minimum: Cost) -> float:
        """J of these gains over other smallest IAE."""
        return self._J(best.cost, minimum)

    def _best(self) -> OptimalGains:
        try:
            pi = self._pi()
        except Refused:
            pid = self._pid() if self.spec.derivative and self.without_time is not None else None
            if pid is None:
                raise
            return pid
        if not self.spec.derivative:
            return pi
        pid = self._pid()
        pi = self._evaluated((pi.gains, pi.cost, pi.missed))  # the minimum is now that of all PID
        if pid is not None and pid.missed != pi.missed:
            return min(pi, pid, key=_order)
        return pid if pid is not None and pid.J < MAX_J_RATIO * pi.J else pi

    def candidates(self, Ti: float, Td: float = 0.0) -> list[tuple[Gains, Cost]]:
        """The stable ones of the largest permitted gains for this Ti and Td (s), each with its best set-point weight
        and its cost. Gains without a weight that keeps the overshoot are left out."""
        return [(gains, cost) for gains, cost, _ in self._candidates(Ti, Td)]

    def _candidates(self, Ti: float, Td: float = 0.0) -> list[_Candidate]:
        spec = self.spec
        g = self.G * controller(self.w, Ti, Td, spec.N)
        cap = math.inf
        if spec.noise_gain is not None:
            cap = spec.noise_gain / (1.0 + spec.N if Td > 0.0 else 1.0)
        size = float(np.max(np.abs(self.G_tail * controller(self.tail, Ti, Td, spec.N))))
        cap = min(cap, (TAIL_MARGIN if Td > 0.0 else 1.0) * (1.0 - 1.0 / self.bounds.Ms) / size)
        found = []
        bounds = self.bounds
        for end in largest_gains(g, bounds.Ms, spec.Mt, cap):
            if does_not_encircle(end * g):
                responses = self.cost.responses(end, Ti, Td, spec.N)
                for b, missed in weights(responses, spec.weights, bounds):
                    cost = responses.cost(b)
                    if self._is_cheap_enough(cost):
                        gains = Gains(float(end), float(Ti), float(Td), float(Td) / spec.N, b)
                        found.append((gains, cost, missed))
                        break
        return found

    def _is_cheap_enough(self, cost: Cost) -> bool:
        best = self.without_time
        return best is None or self._J(cost, best.minimum) <= MAX_COST_RATIO * best.J

    def _pi(self) -> OptimalGains:
        scanned = [self._candidates(Ti * self.period) for Ti in TI]
        everything = [each for candidates in scanned for each in candidates]
        if not everything:
            raise Refused(Reason.NOT_ROBUST, f"no PI on the model has an Ms of at most {self.bounds.Ms:.4g}")
        self._lower_minimum(everything)
        best = min((self._evaluated(each) for each in everything), key=_order)
        step = math.log(TI[1] / TI[0])
        for _ in range(HALVINGS):
            step *= 0.5
            middle = best.gains.Ti
            for Ti in (middle * math.exp(-step), middle * math.exp(step)):
                best = min((best, *map(self._evaluated, self._candidates(Ti))), key=_order)
        self._require_stable(best)
        return best

    def _pid(self) -> OptimalGains | None:
        scanned = [
            (found, (math.log(Ti), math.log(ratio * Ti)))
            for Ti in PID_TI * self.period
            for ratio in PID_TD
            if (found := self._permitted(Ti, ratio * Ti))
        ]
        self._lower_minimum([each for found, _ in scanned for each in found])
        grid = [(min(map(self._evaluated, found), key=_order), at) for found, at in scanned]
        grid.sort(key=lambda found: found[0].order)
        starts: list[tuple[float, float]] = []
        for _, at in grid:
            if all(abs(at[0] - other[0]) + abs(at[1] - other[1]) > 0.8 for other in starts):
                starts.append(at)
            if len(starts) == 2:
                break
        best = grid[0][0] if grid else None
        for start in starts:

            def J(at: Reals) -> float:
                nonlocal best
                found = self._at(math.exp(at[0]), math.exp(at[1]))
                if found is None:
                    return 1e6
                if best is None or found.order < best.order:
                    best = found
                return _value(found)

            simplex = np.array(start) + np.array([[0.0, 0.0], [0.25, 0.0], [0.0, 0.25]])
            minimize(
                J, start, method="Nelder-Mead",
                options={"maxiter": PID_STEPS, "initial_simplex": simplex, "fatol": 1e-5, "xatol": 1e-3},
            )  # fmt: skip
        if best is not None:
            self._require_stable(best)
        return best

    def _permitted(self, Ti: float, Td: float) -> list[_Candidate]:
        """The candidates for this Ti and Td (s); none where the times are not permitted."""
        if Td < MIN_TD * self.period or Ti < MIN_TI * self.period or Td > MAX_TD * Ti or Ti > 40.0 * self.period:
            return []
        return self._candidates(Ti, Td)

    def _at(self, Ti: float, Td: float) -> OptimalGains | None:
        """The best gains for this Ti and Td (s); None where the times are not permitted or no gain meets the bounds."""
        return min(map(self._evaluated, self._permitted(Ti, Td)), key=_order, default=None)

    def _lower_minimum(self, found: list[_Candidate]) -> None:
        """Makes the minimum the smallest IAE of all that was found so far, each alone. Gains that miss a requirement
        count where none keeps it."""
        if self.without_time is not None:
            return
        kept = [each for each in found if each[2] == KEPT]
        costs = [cost for _, cost, _ in kept or found] + ([] if self.minimum is None else [self.minimum])
        self.minimum = Cost(min(each.setpoint for each in costs), min(each.load for each in costs))

    def _evaluated(self, each: _Candidate) -> OptimalGains:
        gains, cost, missed = each
        assert self.minimum is not None  # the PI comes first
        return OptimalGains(gains, self._J(cost, self.minimum), cost, self.minimum, self.bounds.Ms, missed)

    def _J(self, cost: Cost, minimum: Cost) -> float:
        share = self.spec.aim.share
        return share * cost.setpoint / minimum.setpoint + (1.0 - share) * cost.load / minimum.load

    def _require_stable(self, best: OptimalGains) -> None:
        if not is_stable(self.model, best.gains):
            model, gains = self.model, best.gains
            raise Refused(
                Reason.NOT_ROBUST,
                f"by its frequency response Kp {gains.Kp:.4g}, Ti {gains.Ti:.4g} s, Td {gains.Td:.4g} s are the best "
                f"gains on the model num {_numbers(model.num)}, den {_numbers(model.den)}, dead time {model.L:.4g} s, "
                "and the exact count of the poles says that this loop is not stable",
            )


def controller(w: Reals, Ti: float, Td: float, N: float) -> Complexes:
    """The frequency response C(jw)/Kp of the controller; w in rad/s, Ti (0: no integral action) and Td in s, derivative
    filter Td/N."""
    s = 1j * w
    return np.asarray(1.0 + (1.0 / (s * Ti) if Ti > 0.0 else 0.0) + (s * Td / (1.0 + s * Td / N) if Td > 0.0 else 0.0))


def frequencies(period: float) -> Reals:
    """The frequency grid of a design, rad/s, for an ultimate period in s."""
    return np.asarray(np.geomspace(LOWEST, HIGHEST, POINTS) * 2.0 * math.pi / period)


def own_period(model: Model, relay_period: float) -> float:
    """The ultimate period of the model, s, limited around the period of the relay, which a load disturbance
    prolongs."""
    w = frequencies(relay_period)
    G = model.frequency_response(w)
    crossing = np.flatnonzero((G.imag[:-1] < 0.0) & (G.imag[1:] >= 0.0) & (G.real[:-1] < 0.0))
    if not len(crossing):
        return relay_period
    i = int(crossing[np.argmax(np.abs(G[crossing]))])
    part = -G.imag[i] / (G.imag[i + 1] - G.imag[i])
    at = float(w[i] * (w[i + 1] / w[i]) ** part)
    return min(max(2.0 * math.pi / at, MIN_PERIOD_RATIO * relay_period), MAX_PERIOD_RATIO * relay_period)


def _numbers(coefficients: tuple[float, ...]) -> str:
    return ", ".join(f"{each:.4g}" for each in coefficients)


def _order(best: OptimalGains) -> tuple[tuple[float, float], float]:
    return best.order


def _value(best: OptimalGains) -> float:
    """J, and more than J of any gains worth having where a requirement is missed."""
    mv_peak, settling = best.missed.order
    if mv_peak > 0.0:
        return _MISSED * (10.0 + min(mv_peak, 100.0))
    return _MISSED * (1.0 + min(settling, 8.0)) if settling > 0.0 else best.J

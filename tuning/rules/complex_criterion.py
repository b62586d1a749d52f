"""The complex criterion of Romasevych, Loveikin and Usenko for PI loops, many settings at once, dead time exact.

    Cr + dT*Ter,   Cr = d1*MIE + d2*MIC + d3*OS + d4*ts

The terms describe the answer to a unit set-point step. ts is the last time outside 5 % of the set-point. MIE and MIC
are the means of |e| and |u| from 0 to ts. OS is the overshoot as a fraction. Ter is the distance to the 5 % band plus
the sum of the sizes of all derivatives of PV up to the plant's order, at the end of the horizon (the paper does not
state that time). There are three weightings.
Source: "PI-controller tuning optimization via PSO-based technique", the criterion, its terminal term and the weights.

All terms are in the plant's own units: time in units of its largest lag or its dead time, whichever is longer, MV in
units of the MV that holds PV at the set-point. For the five plants of the paper these are the paper's second and unit
of MV.

All settings given together are simulated together, for speed. The rational loop is advanced by its matrix exponential,
a loop with dead time by its map from one dead time to the next; powers of these matrices give all samples.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from loopwright.tuning.analysis.exponential import exponentials
from loopwright.tuning.analysis.monodromy import DeadTimeLoop
from loopwright.tuning.analysis.state_space import gain_unit, normalised, state_space, time_sum
from loopwright.tuning.models import Model, Reals, time_constants
from loopwright.tuning.reasons import Reason, Refused

BAND = 0.05
DIVERGED = 1e9
SAMPLES = 6000
HORIZON_IN_TIME_SUMS = 20.0
MIN_HORIZON = 0.5
BLOCK = 64


class Weighting(StrEnum):
    """The term with the largest weight: the error, the control effort, or the duration of the response."""

    ERROR = "error"
    CONTROL = "control"
    DURATION = "duration"


WEIGHTS = {
    Weighting.ERROR: (1000.0, 1.0, 5.0, 1.0),
    Weighting.CONTROL: (1.0, 1000.0, 5.0, 1.0),
    Weighting.DURATION: (1.0, 1.0, 5.0, 1000.0),
}
"""d1 to d4 of the paper's three variants."""
TERMINAL_WEIGHT = 1000.0


@dataclass(frozen=True, slots=True)
class Indices:
    """The terms of the criterion for p settings, each of shape (p,). Terms of a diverging loop may be inf or NaN.

    MIE: the mean |e| as a fraction of the step.
    MIC: the mean |u| as a fraction of the MV that holds PV at the set-point.
    overshoot: the overshoot as a fraction of the step.
    settling: the settling time in time units; the horizon if the loop has not settled.
    terminal: the penalty at the end of the horizon, without its weight.
    """

    MIE: Reals
    MIC: Reals
    overshoot: Reals
    settling: Reals
    terminal: Reals


class ComplexCriterion:
    """The criterion of one model; the parts that do not depend on the controller are computed once.

    Settings are given as kp = Kp*gain_unit and ti = 1/(Ki*gain_unit*time_unit_s), which is the paper's Ti, the
    reciprocal of the integral gain. The attributes are time_unit_s (s), gain_unit (PV units per MV unit) and horizon
    (in time units).

    Ms_max: loops with a larger maximum sensitivity are penalised in proportion; None for no penalty.
    """

    def __init__(
        self,
        model: Model,
        weighting: Weighting,
        horizon_s: float | None = None,
        Ms_max: float | None = None,
        samples: int = SAMPLES,
    ) -> None:
        """Prepares the criterion.

        horizon_s: the simulated time, s, rounded up to whole dead times; by default 20 times all lags and the dead
        time.
        samples: the approximate number of samples of each response.
        Raises Refused, BAD_INPUT, for a model without lag and dead time and for a horizon of less than half a time
        unit.
        """
        total = time_sum(model)
        if total <= 0.0:
            raise Refused(Reason.BAD_INPUT, "the model has neither lag nor dead time: no PI loop is too fast for it")
        self.time_unit_s = max(float(time_constants(model).max(initial=0.0)), model.L)
        self.gain_unit = gain_unit(model, self.time_unit_s)
        self.weights = WEIGHTS[weighting]
        self.Ms_max = Ms_max
        plant = normalised(model, self.time_unit_s)
        horizon = (HORIZON_IN_TIME_SUMS * total if horizon_s is None else horizon_s) / self.time_unit_s
        if horizon < MIN_HORIZON:
            shown = f"at least {MIN_HORIZON * self.time_unit_s:.3g} s is accepted"
            raise Refused(Reason.BAD_INPUT, f"horizon_s {horizon_s}: {shown} for this model")
        self._loops = (_LoopsWithDeadTime if plant.L > 0.0 else _LoopsWithoutDeadTime)(plant, horizon, samples)
        self.horizon = self._loops.dt * self._loops.steps
        self._w = np.geomspace(1e-2 * self.time_unit_s / total, 1e2 * _fastest(plant), 400)
        self._plant = plant.frequency_response(self._w)

    def __call__(self, kp: Reals, ti: Reals) -> Reals:
        """The criterion of each setting, shape (p,), for kp and ti of shape (p,). It is finite, and above DIVERGED
        where a loop diverges."""
        found = self.indices(kp, ti)
        d1, d2, d3, d4 = self.weights
        with np.errstate(over="ignore", invalid="ignore"):
            value = d1 * found.MIE + d2 * found.MIC + d3 * found.overshoot + d4 * found.settling
            value = value + TERMINAL_WEIGHT * found.terminal
        lost = ~(value < DIVERGED)
        if lost.any():
            value[lost] = DIVERGED * (1.0 + self._loops.growth(kp[lost], 1.0 / ti[lost]))
        if self.Ms_max is not None:
            excess = np.maximum(self.sensitivity(kp, ti) / self.Ms_max - 1.0, 0.0)
            # the worst settled loop costs what it takes to settle at the end of the horizon
            value = value + np.minimum(excess, 1e3) * max(self.weights) * self.horizon
        return np.asarray(value)

    def indices(self, kp: Reals, ti: Reals) -> Indices:
        """The terms of the criterion, for kp and ti of shape (p,)."""
        with np.errstate(over="ignore", invalid="ignore"):
            e, u, slopes = self._loops.sample(kp, 1.0 / ti)
            return _indices(e, u, slopes, self._loops.dt)

    def sensitivity(self, kp: Reals, ti: Reals) -> Reals:
        """Ms of each loop on a grid of frequencies, shape (p,)."""
        loop = (kp[:, None] + 1.0 / (1j * ti[:, None] * self._w)) * self._plant
        return np.asarray(1.0 / np.abs(1.0 + loop).min(axis=1))

    def stable(self, kp: float, ti: float) -> bool:
        """Whether all roots of the loop are in the left half-plane."""
        return bool(self._loops.growth(np.array([kp]), np.array([1.0 / ti]))[0] < 0.0)


def _indices(e: Reals, u: Reals, slopes: Reals, dt: float) -> Indices:
    """The terms of the criterion from the responses.

    e: the error, shape (p, n); it is overwritten.
    u: the control, shape (p, n); its first and last samples may jump.
    slopes: the sum of the sizes of the derivatives at the end, shape (p,).
    dt: the step, in time units.
    """
    overshoot = np.maximum(-e.min(axis=1), 0.0)
    size = np.abs(e, out=e)
    steps = size.shape[1] - 1
    outside = size > BAND
    last = steps - np.argmax(outside[:, ::-1], axis=1)
    settled = last < steps
    rows = np.arange(len(e))
    here = np.minimum(last, steps - 1)
    a, b = size[rows, here], size[rows, here + 1]
    part = np.where(settled, (a - BAND) / np.where(settled, a - b, 1.0), 1.0)
    settling = np.where(settled, dt * (here + part), dt * steps)

    def mean(f: Reals) -> Reals:
        """The mean of |f| from 0 to the settling time, by trapezoids of which the last is cut off."""
        first, second = np.abs(f[rows, here]), np.abs(f[rows, here + 1])
        sums = np.array([np.abs(row[: end + 1]).sum() for row, end in zip(f, here, strict=True)])
        whole = sums - 0.5 * (np.abs(f[:, 0]) + first)
        return np.asarray(dt * (whole + part * (first + 0.5 * part * (second - first))) / settling)

    return Indices(
        MIE=mean(e),
        MIC=mean(u),
        overshoot=overshoot,
        settling=settling,
        terminal=np.maximum(size[:, -1] - BAND, 0.0) + slopes,
    )


def _fastest(plant: Model) -> float:
    return float(1.0 / min([*time_constants(plant), plant.L or math.inf]))


def _powers(step: Reals, start: Reals, count: int) -> Reals:
    """The states start, step @ start, step @ step @ start and so on, shape (p, count, s), computed by doubling.

    step: shape (p, s, s).
    start: shape (p, s).
    """
    states, across = start[:, None, :], step.transpose(0, 2, 1)
    while states.shape[1] < count:
        states = np.concatenate((states, states[:, : count - states.shape[1]] @ across), axis=1)
        if states.shape[1] < count:
            across = across @ across
    return states


class _LoopsWithoutDeadTime:
    """Loops without dead time. The states are (plant states, integral part), as deviations from rest at the
    set-point."""

    def __init__(self, plant: Model, horizon: float, samples: int) -> None:
        self.dt, self.steps = horizon / samples, samples
        self.plant = state_space(plant)
        rest, self.u_rest = self.plant.rest()
        self._start = np.concatenate((-rest, [-self.u_rest]))

    def _loop(self, kp: Reals, ki: Reals) -> tuple[Reals, Reals]:
        """The matrix of each closed loop, shape (p, s, s), and its output row for e, shape (p, s)."""
        g, n = self.plant, len(self.plant.b)
        # e = -(c x + d u) and u = kp*e + integral part
        error = -np.append(g.c, g.d) / (1.0 + g.d * kp[:, None])
        closed = np.zeros((len(kp), n + 1, n + 1))
        closed[:, :n, :n] = g.a
        closed[:, :n, n] = g.b
        closed[:, :n, :] += g.b[:, None] * (kp[:, None] * error)[:, None, :]
        closed[:, n, :] = ki[:, None] * error
        return closed, error

    def sample(self, kp: Reals, ki: Reals) -> tuple[Reals, Reals, Reals]:
        closed, error = self._loop(kp, ki)
        step = exponentials(closed * self.dt)
        backward = step.transpose(0, 2, 1)
        rows = _powers(backward, error, BLOCK)
        integral = _powers(backward, np.broadcast_to(np.eye(len(self._start))[-1], error.shape), BLOCK)
        starts = _powers(
            np.linalg.matrix_power(step, BLOCK),
            np.broadcast_to(self._start, error.shape),
            self.steps // BLOCK + 1,
        )
        e, u = (
            (starts @ each.transpose(0, 2, 1)).reshape(len(kp), -1)[:, : self.steps + 1]
            for each in (rows, kp[:, None, None] * rows + integral)
        )
        block, inside = divmod(self.steps, BLOCK)
        last = np.einsum("pij,pj->pi", np.linalg.matrix_power(step, inside), starts[:, block])
        slopes = np.zeros(len(kp))
        for _ in range(len(self.plant.b)):
            last = np.einsum("pij,pj->pi", closed, last)
            slopes += np.abs(np.einsum("pi,pi->p", error, last))
        return e, u + self.u_rest, slopes

    def growth(self, kp: Reals, ki: Reals) -> Reals:
        """The largest real part of each loop's roots."""
        return np.asarray(np.linalg.eigvals(self._loop(kp, ki)[0]).real.max(axis=1))


class _LoopsWithDeadTime:
    """Loops with dead time. Where a dead time is shorter than a sample, one step covers a power of two of dead
    times."""

    def __init__(self, plant: Model, horizon: float, samples: int) -> None:
        self.loop = DeadTimeLoop(plant)
        wanted = horizon / samples
        self.squarings = max(0, math.floor(math.log2(wanted / plant.L)))
        block = plant.L * 2**self.squarings
        self.inside = math.ceil(block / wanted)
        self.dt = block / self.inside
        self.blocks = math.ceil(horizon / block - 1e-9)
        self.steps = self.blocks * self.inside
        at = np.arange(self.inside) / self.inside
        self._value, self._area = self.loop.values(at), self.loop.areas(at)
        self._held: Reals | None = None

    def sample(self, kp: Reals, ki: Reals) -> tuple[Reals, Reals, Reals]:
        """The responses e and u, shape (p, n), and the derivatives' sizes at the end, shape (p,). The next call
        overwrites e and u, as the allocation of memory would take longer than the arithmetic."""
        once, start = self.loop.maps(kp, ki), self.loop.start(kp)
        advance = once
        for _ in range(self.squarings):
            advance = advance @ advance
        states = _powers(advance, start, self.blocks + 1)
        errors, integral = states[:, :, self.loop.errors], states[:, :, -1:]
        if self._held is None or self._held.shape[1] != len(kp):
            self._held = np.empty((3, len(kp), self.blocks + 1, self.inside))
        e, u, area = self._held
        np.matmul(errors, self._value.T, out=e)
        np.matmul(errors, self._area.T, out=area)
        np.multiply(kp[:, None, None], e, out=u)
        u += integral
        area *= ki[:, None, None]
        u += area
        u += self.loop.u_rest
        shape = (len(kp), -1)
        # derivatives at the horizon's end, or at most one block before it
        before = states[:, max(self.blocks - (1 if self.squarings else 2), 0)]
        after = np.einsum("pij,pj->pi", once, before)
        slopes = np.abs(self.loop.rates(before, after, kp, ki)).sum(axis=1)
        return (
            e.reshape(shape)[:, : self.steps + 1],
            u.reshape(shape)[:, : self.steps + 1],
            slopes,
        )

    def growth(self, kp: Reals, ki: Reals) -> Reals:
        """The largest real part of each loop's roots."""
        return np.asarray(self.loop.roots(self.loop.maps(kp, ki))[:, 0].real)

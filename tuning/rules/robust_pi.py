"""The robust PI of the five-stage procedure: criterion (7), minimised by Nelder-Mead.

    J = max over the 8 corners of [ 10*ITAE + 1*overshoot + 10*Ms ],   K, T and L each 20 % low or high

J is for a unit set-point step; overshoot is a fraction, not below 0; ITAE is in s^2 (or scale-free, times (5 s/T)^2).
Source: Stopakevych et al., automatic re-tuning of PI controllers, Problemele Energeticii Regionale.

The computation is made fast as follows. Time is in units of each corner's own dead time. Within one dead time the error
is smooth and is represented by its values at a few Chebyshev points; its values one dead time later follow by a linear
map (the method of steps: the plant's input is already known). All eight maps depend on Kp and Kp/Ti alone through fixed
matrices, and a response of 2^n dead times takes n squarings.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.polynomial import chebyshev
from scipy.optimize import minimize

from loopwright.tuning.analysis.margins import ultimate_point
from loopwright.tuning.gains import Gains
from loopwright.tuning.models import FOPDT, Reals
from loopwright.tuning.rules.common import positive, ratio_within, setting
from loopwright.tuning.rules.setting import Setting

WEIGHTS = (10.0, 1.0, 10.0)
SPREAD = 0.2
MS_POINTS = 300
SCALE_FREE_BELOW_S = 5.0
UNSTABLE = 1e30
RATIO = (0.02, 20.0)
"""Range of L/T. The search takes about 0.1 s inside this range, and many times as long outside."""


@dataclass(frozen=True, slots=True)
class Optimum:
    """The result of the search.

    gains: the optimal gains.
    J: the criterion there; lower is better, and values are comparable for one model and horizon only.
    evaluations: the number of evaluations of the criterion.
    """

    gains: Gains
    J: float
    evaluations: int


def optimise(
    model: FOPDT,
    start: Gains | None = None,
    horizon_factor: float = 10.0,
    horizon_s: float | None = None,
    scale_free: bool | None = None,
) -> Optimum:
    """The PI that minimises criterion (7) on this model; Kp is positive whatever the sign of K.

    start: the start of the search, by default the Ziegler-Nichols PI of the model.
    horizon_s: the length of the step response, s; by default horizon_factor*(T + L).
    scale_free: whether time is weighted in units of T; by default True for T < 5 s, where the printed criterion depends
    on the unit of time.
    """
    if start is None or start.Ti == 0.0:
        ku, pu = ultimate_point(model)
        start = Gains(Kp=ku / 2.2, Ti=pu / 1.2)
    criterion = Criterion(model, horizon_s or horizon_factor * (model.T + model.L), scale_free)

    def cost(x: Reals) -> float:
        return criterion(math.exp(float(x[0])), math.exp(float(x[1])))

    best: Reals = np.log(np.array([start.Kp, start.Ti]))
    while (J := cost(best)) >= UNSTABLE:
        best = best + np.array([math.log(0.7), 0.0])
    for size, xatol, fatol in ((0.15, 5e-4, 1e-5), (0.03, 5e-4, 1e-5), (0.004, 1e-5, 1e-8)):
        # J has kinks where two corners are equal; a second, smaller simplex frees a search stuck there, a third
        # refines it
        simplex = best + np.array([[0.0, 0.0], [size, 0.0], [0.0, size]])
        found = minimize(
            cost,
            best,
            method="Nelder-Mead",
            options={"initial_simplex": simplex, "xatol": xatol, "fatol": fatol * J, "maxfev": 200},
        )
        best, J = np.asarray(found.x, dtype=float), float(found.fun)
    return Optimum(Gains(Kp=math.exp(best[0]), Ti=math.exp(best[1])), J, criterion.evaluations)


class Criterion:
    """The criterion J(Kp, Ti) of one model; the parts that do not depend on the controller are computed once."""

    def __init__(self, model: FOPDT, horizon_s: float, scale_free: bool | None = None) -> None:
        if model.L <= 0.0:
            raise ValueError("criterion (7) needs a model with dead time")
        if scale_free is None:
            scale_free = model.T < SCALE_FREE_BELOW_S
        low, high = 1.0 - SPREAD, 1.0 + SPREAD
        k, t, dead = np.meshgrid([low, high], [low, high], [low, high], indexing="ij")
        self.K, self.dead = abs(model.K) * k.ravel(), model.L * dead.ravel()
        self.lag = model.T * t.ravel() / self.dead
        self.itae_unit = (SCALE_FREE_BELOW_S / model.T) ** 2 if scale_free else 1.0
        self.evaluations = 0
        self._prepare_frequency()
        self._prepare_time(horizon_s)

    def __call__(self, Kp: float, Ti: float) -> float:
        """The value of J; if a corner is unstable it is above UNSTABLE, and grows with the distance from stability."""
        self.evaluations += 1
        sensitivity, excess = self._frequency(Kp, Ti)
        if excess > 0.0:
            return UNSTABLE * excess
        itae, overshoot = self._time(Kp, Ti)
        w_itae, w_overshoot, w_ms = WEIGHTS
        return float(np.max(w_itae * self.itae_unit * itae + w_overshoot * overshoot + w_ms * sensitivity))

    def _prepare_frequency(self) -> None:
        # one grid in radians per dead time serves all corners
        jw = 1j * np.geomspace(0.02, 20.0, MS_POINTS)
        plant = self.K[:, None] * np.exp(-jw) / (self.lag[:, None] * jw + 1.0)
        self.proportional, self.integral = plant, plant / (jw * self.dead[:, None] ** -1)

    def _frequency(self, Kp: float, Ti: float) -> tuple[Reals, float]:
        """Ms of each corner, and the gain by which the worst unstable corner exceeds its limit, 0 if all are stable."""
        L = Kp * self.proportional + (Kp / Ti) * self.integral
        above = L.imag > 0.0
        # Nyquist: net crossings of the real axis left of -1
        beyond = L.real[:, :-1] < -1.0
        net = ((above[:, 1:] & ~above[:, :-1]) & beyond).sum(axis=1) - ((above[:, :-1] & ~above[:, 1:]) & beyond).sum(
            axis=1
        )
        if net.any():
            crossing = beyond & (above[:, 1:] != above[:, :-1]) & (net != 0)[:, None]
            return np.empty(0), float(np.max(-L.real[:, :-1][crossing]))
        one_plus = 1.0 + L
        return 1.0 / np.sqrt(np.min(one_plus.real**2 + one_plus.imag**2, axis=1)), 0.0

    def _prepare_time(self, horizon_s: float) -> None:
        """Prepares the map of one dead time, for deviations from the final state and with time in dead times.

        The equations are lag*e' = -e - K*q(one dead time ago), q = Kp*(e + j/Ti) and j' = e; the state is (e at the
        nodes, j at the start).
        """
        shortest = float(self.lag.min())
        nodes = 10 + 2 * math.ceil(1.0 / shortest)
        x = 0.5 * (1.0 - np.cos(np.pi * np.arange(nodes) / (nodes - 1)))
        basis = chebyshev.chebvander(2.0 * x - 1.0, nodes - 1)
        to_coefficients = np.linalg.inv(basis)
        areas = np.array([0.5 * _antiderivative(c, x) for c in np.eye(nodes)]).T @ to_coefficients
        slopes = np.array([2.0 * chebyshev.chebval(2.0 * x - 1.0, chebyshev.chebder(c)) for c in np.eye(nodes)]).T
        slopes = slopes @ to_coefficients

        corners, size = len(self.K), nodes + 1
        self.free = np.zeros((corners, size, size))
        self.by_kp = np.zeros((corners, size, size))
        self.by_ki = np.zeros((corners, size, size))
        for i in range(corners):
            # collocation, the first row replaced by the value at the start
            operator = self.lag[i] * slopes + np.eye(nodes)
            operator[0] = np.eye(nodes)[0]
            inverse = np.linalg.inv(operator)
            self.free[i, :nodes, nodes - 1] = inverse[:, 0]
            driven = -self.K[i] * inverse
            driven[:, 0] = 0.0
            self.by_kp[i, :nodes, :nodes] = driven
            self.by_ki[i, :nodes, :nodes] = self.dead[i] * driven @ areas
            self.by_ki[i, :nodes, nodes] = self.dead[i] * driven.sum(axis=1)
            self.free[i, nodes, :nodes] = areas[-1]
            self.free[i, nodes, nodes] = 1.0

        fine = max(12, math.ceil(10.0 / shortest))
        middle = (np.arange(fine) + 0.5) / fine
        self.to_fine = np.concatenate(
            (chebyshev.chebvander(2.0 * middle - 1.0, nodes - 1) @ to_coefficients, np.zeros((fine, 1))), axis=1
        )
        length = horizon_s / self.dead
        self.blocks = math.ceil(float(length.max()))
        start = np.arange(self.blocks)[None, None, :] + (np.arange(fine) / fine)[None, :, None]
        inside = np.clip((length[:, None, None] - start) * fine, 0.0, 1.0)
        midpoint = start + 0.5 * inside / fine
        self.time_weights = np.asarray(self.dead[:, None, None] ** 2 * midpoint * inside / fine)

    def _time(self, Kp: float, Ti: float) -> tuple[Reals, Reals]:
        """The ITAE (s^2) and the overshoot (a fraction) of each corner."""
        advance = self.free + Kp * self.by_kp + (Kp / Ti) * self.by_ki
        corners, size, _ = advance.shape
        # in the first dead time e = 1, while j starts at its deviation from the final value
        states = np.ones((corners, size, 1))
        states[:, -1, 0] = -Ti / (self.K * Kp * self.dead)
        while states.shape[2] < self.blocks:
            states = np.concatenate((states, advance @ states[:, :, : self.blocks - states.shape[2]]), axis=2)
            if states.shape[2] < self.blocks:
                advance = advance @ advance
        error = self.to_fine @ states
        overshoot = np.maximum(-error.min(axis=(1, 2)), 0.0)
        itae = np.einsum("ijk,ijk->i", np.abs(error), self.time_weights)
        return itae, overshoot


def _antiderivative(c: Reals, x: Reals) -> Reals:
    """The antiderivative, zero at -1, of a Chebyshev series on [-1, 1], at the points 2x - 1."""
    return np.asarray(chebyshev.chebval(2.0 * x - 1.0, chebyshev.chebint(c, lbnd=-1.0)))


def robust(model: FOPDT, *, horizon_s: float | None = None, scale_free: bool | None = None) -> Setting:
    """The setting of the robust PI.

    horizon_s: the length of the step response, s, by default 10 (T + L).
    scale_free: whether time is weighted in units of T; by default True for T < 5 s, where the printed criterion depends
    on the unit of time.
    """
    ratio_within(model, *RATIO, "the robust PI")
    if horizon_s is None:
        horizon_s = 10.0 * (model.T + model.L)
    positive("horizon_s", horizon_s, "s")
    found = optimise(model, horizon_s=horizon_s, scale_free=scale_free)
    return setting(found.gains.Kp, found.gains.Ti, chosen={"horizon_s": horizon_s})

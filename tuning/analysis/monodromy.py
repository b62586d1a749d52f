"""A loop with dead time as a linear map from one dead time to the next.

During one dead time the plant's input is already known, so all signals are smooth, and the error is represented by its
values at Chebyshev points. The plant is advanced exactly for an input that is a polynomial, however short its lags. The
map to the next dead time is a matrix that is affine in Kp, Ki and Kd. Its powers give the response, its eigenvalues are
exp(s*L) for the roots s of the loop, and a sum over its powers gives the integral of the squared error over all time.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.polynomial import chebyshev
from scipy.linalg import expm

from loopwright.tuning.analysis.state_space import state_space
from loopwright.tuning.models import Complexes, Model, Reals, sign

MAX_NODES = 64
LOCAL = 6


class DeadTimeLoop:
    """The maps of one model (L > 0) under many controllers u = Kp*e + Ki*int(e) + Kd*e'; Kp, Ki, Kd of shape (p,).

    A state is (plant states at the end of a dead time, error at the nodes in it, integral part at its start), all as
    deviations from rest at the set-point; its length is `size`. Gains are for a plant of positive gain.
    Raises ValueError for a model without dead time.
    """

    def __init__(self, model: Model) -> None:
        if model.L <= 0.0:
            raise ValueError("a model with dead time is needed")
        plant = state_space(model)
        self.L, self.direction = model.L, sign(model)
        fastest = float(np.abs(np.linalg.eigvals(plant.a)).max()) * model.L
        # Chebyshev points crowd at the ends as their square: the root of the fastest lag's rate is enough
        count = min(MAX_NODES, 10 + math.ceil(4.0 * math.sqrt(fastest)))
        n = len(plant.b)
        self.order, self.nodes, self.size = n, count, n + count + 1
        self.errors = slice(n, n + count)
        self.at = 0.5 * (1.0 - np.cos(np.pi * np.arange(count) / (count - 1)))
        self._to_series = np.linalg.inv(chebyshev.chebvander(2.0 * self.at - 1.0, count - 1))

        areas = self.areas(self.at)
        self._whole_area = areas[-1]
        slopes = np.array([chebyshev.chebval(2.0 * self.at - 1.0, chebyshev.chebder(c)) for c in np.eye(count)]).T
        self.slopes = 2.0 / self.L * slopes @ self._to_series
        free, driven = self._plant(plant.a, plant.b)
        out = np.einsum("k,ikl->il", plant.c, free)
        through = np.einsum("k,ikj->ij", plant.c, driven) + plant.d * np.eye(count)

        receives = np.zeros((self.size, count))
        receives[:n] = driven[-1]
        receives[self.errors] = -through
        receives *= self.direction
        base = np.zeros((self.size, self.size))
        base[:n, :n] = free[-1]
        base[self.errors, :n] = -out
        base[-1, -1] = 1.0
        base[:, -1] += receives.sum(axis=1)
        by_kp, by_ki, by_kd = (np.zeros_like(base) for _ in range(3))
        by_kp[:, self.errors] = receives
        by_ki[:, self.errors] = receives @ areas
        by_ki[-1, self.errors] = areas[-1]
        by_kd[:, self.errors] = receives @ self.slopes
        self._parts = np.stack((base, by_kp, by_ki, by_kd))

        powers = [np.linalg.matrix_power(plant.a, i) for i in range(n + 1)]
        self._of_states = np.array([plant.c @ power for power in powers])
        self._markov = self.direction * np.array([plant.d, *(plant.c @ power @ plant.b for power in powers)])

        rest, u = plant.rest()
        self.u_rest = self.direction * u
        self._start = np.concatenate((-rest, np.ones(count), [-self.u_rest]))
        self._kick = np.concatenate((self.direction * plant.b, np.zeros(count + 1)))

    def maps(self, Kp: Reals, Ki: Reals, Kd: Reals | None = None) -> Reals:
        """The maps, shape (p, size, size): the state of the next dead time is map @ state."""
        gains = np.stack((np.ones_like(Kp), Kp, Ki, np.zeros_like(Kp) if Kd is None else Kd))
        return np.tensordot(gains.T, self._parts, axes=1)

    def start(self, Kp: Reals, Kd: Reals | None = None) -> Reals:
        """The states of the first dead time after a unit set-point step from rest, shape (p, size), with the impulse
        that Kd makes of the step."""
        kick = np.zeros_like(Kp) if Kd is None else Kd
        return np.asarray(self._start + kick[:, None] * self._kick)

    def values(self, at: Reals) -> Reals:
        """The matrix from the error at the nodes to the error at fractions `at` of the dead time, shape (len(at),
        nodes)."""
        return np.asarray(chebyshev.chebvander(2.0 * at - 1.0, self.nodes - 1) @ self._to_series)

    def areas(self, at: Reals) -> Reals:
        """The matrix from the error at the nodes to its integral since the dead time began, s, shape (len(at),
        nodes)."""
        series = [chebyshev.chebint(c, lbnd=-1.0) for c in np.eye(self.nodes)]
        areas = np.array([chebyshev.chebval(2.0 * at - 1.0, c) for c in series]).T
        return np.asarray(0.5 * self.L * areas @ self._to_series, dtype=np.float64)

    def rates(self, before: Reals, after: Reals, Kp: Reals, Ki: Reals) -> Reals:
        """The derivatives of PV up to the plant's order at the end of the dead time with the states `after`.

        before: the states of the dead time before.
        The result has the shape (p, order), in PV units per s, s^2 and so on. It comes from the plant's equations, as
        derivatives of the polynomial would lose all digits in a short dead time.
        """
        # the last node is the end
        error = before[:, self.errors]
        value = error[:, -1]
        inputs = [Kp * value + Ki * (error @ self._whole_area) + before[:, -1]]
        found = []
        for i in range(1, self.order + 1):
            error = error @ self.slopes.T
            inputs.append(Kp * error[:, -1] + Ki * value)
            value = error[:, -1]
            rate = after[:, : self.order] @ self._of_states[i]
            for j, each in enumerate(inputs):
                # exactly zero where the plant does not pass this derivative on
                if (passed := self._markov[i - j]) != 0.0:
                    rate = rate + passed * each
            found.append(rate)
        return np.stack(found, axis=1)

    def squares(self, maps: Reals, start: Reals) -> tuple[Reals, Reals]:
        """The integrals of e^2 and of e'^2 over all time, each of shape (p,); every loop must be stable.

        A value is infinite where a loop is too close to instability. The jump of e at t = 0 is not part of e'.
        """
        points, weights = np.polynomial.legendre.leggauss(self.nodes)
        value = self.values(0.5 * (points + 1.0))
        mass = value.T @ (0.5 * self.L * weights[:, None] * value)
        forms = np.zeros((2, 1, self.size, self.size))
        forms[0, 0, self.errors, self.errors] = mass
        forms[1, 0, self.errors, self.errors] = self.slopes.T @ mass @ self.slopes
        total, power = np.broadcast_to(forms, (2, *maps.shape)), maps
        with np.errstate(over="ignore", invalid="ignore"):
            for _ in range(60):
                total = total + power.transpose(0, 2, 1) @ total @ power
                power = power @ power
                if float(np.abs(power).max()) < 1e-12:
                    break
            e, rate = np.einsum("pi,fpij,pj->fp", start, total, start)
        return np.where(np.isfinite(e), e, np.inf), np.where(np.isfinite(rate), rate, np.inf)

    def roots(self, maps: Reals) -> Complexes:
        """The rightmost roots of each loop, 1/s, shape (p, size), by falling real part; the last ones are not accurate.

        Imaginary parts are known up to a multiple of 2*pi/L.
        """
        found = np.linalg.eigvals(maps).astype(np.complex128)
        ordered = np.take_along_axis(found, np.argsort(-np.abs(found), axis=1), axis=1)
        return np.asarray((np.log(np.maximum(np.abs(ordered), 1e-300)) + 1j * np.angle(ordered)) / self.L)

    def _plant(self, a: Reals, b: Reals) -> tuple[Reals, Reals]:
        """The matrices from the initial state, shape (nodes, n, n), and from the input, shape (nodes, n, nodes), to the
        plant states at the nodes."""
        n = len(b)
        free, driven = np.zeros((self.nodes, n, n)), np.zeros((self.nodes, n, self.nodes))
        free[0] = np.eye(n)
        # between two nodes the input is taken as a polynomial of degree five there: exact but for rounding
        inside = 0.5 * (1.0 - np.cos(np.pi * (np.arange(LOCAL) + 0.5) / LOCAL))
        to_derivatives = np.linalg.inv(np.vander(inside, LOCAL, increasing=True))
        to_derivatives *= np.array([math.factorial(j) for j in range(LOCAL)])[:, None]
        for i, width in enumerate(np.diff(self.at)):
            augmented = np.zeros((n + LOCAL, n + LOCAL))
            augmented[:n, :n] = a * width * self.L
            augmented[:n, n] = b * width * self.L
            augmented[n : n + LOCAL - 1, n + 1 :] = np.eye(LOCAL - 1)
            step = expm(augmented)
            local = to_derivatives @ self.values(self.at[i] + width * inside)
            free[i + 1] = step[:n, :n] @ free[i]
            driven[i + 1] = step[:n, :n] @ driven[i] + step[:n, n:] @ local
        return free, driven

"""Pole placement with a quadratic criterion: the shape of the dominant roots is prescribed, their size is searched.

    roots  s = alpha*(-1 +/- j*mu),  for a PID also  s = -k1*alpha;     J = integral of (e^2 + tau^2 * e'^2) dt

For each alpha the prescribed roots determine the gains by a linear system. The chosen alpha minimises J of a unit
set-point step among the alphas with positive gains and a stable loop. Source: M. Horbiichuk, M. Vasylenchuk, I. Yednak,
A. Lahoida, "Devising a combined method for setting PI/PID controller parameters for oil and gas facilities",
Eastern-European Journal of Enterprise Technologies 1(2(133)), 2025, the pole equations and J of its three plant orders.

This module does the same for any order and with exact dead time: each prescribed root must satisfy C(s)*G(s) = -1, and
J comes from a Lyapunov equation. On the paper's three orders the results are those of the paper.

The selection among several minima is an addition to the paper, which takes the minimum in an interval chosen by hand.
Here the minimum of smallest J is taken whose other roots all decay at 0.8*alpha or faster; with a slower root the shape
mu would not describe the response.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar

from loopwright.tuning.analysis.monodromy import DeadTimeLoop
from loopwright.tuning.analysis.state_space import gain_unit, normalised, time_sum
from loopwright.tuning.gains import Gains
from loopwright.tuning.models import Complexes, Model, Reals, TransferFunction
from loopwright.tuning.reasons import Reason, Refused
from loopwright.tuning.rules.setting import Setting

MU = (0.01, 10.0)
K1 = (0.01, 100.0)
GRID = 400
INSIDE = 200
SLOWER = 0.8
SHOWN = 8
STABLE_BY = 1e-9
"""Smallest decay rate of a stable loop, in units of one over all lags and the dead time together, for rounding
errors."""
CONTROLLERS = ("pi", "pid")


@dataclass(frozen=True, slots=True)
class Minimum:
    """One local minimum of J.

    alpha: the size of the prescribed roots, 1/s.
    gains: the ISA gains; the derivative of a PID acts on the error, without filter.
    J0, J1: the integral of e^2, s, and of e'^2, 1/s.
    J: the criterion J0 + tau^2*J1, s.
    left_over: the roots that were not prescribed, 1/s, the slowest first, at most eight.
    """

    alpha: float
    gains: Gains
    J0: float
    J1: float
    J: float
    left_over: tuple[complex, ...]

    @property
    def dominant(self) -> bool:
        """Whether no left-over root is slower than 0.8*alpha."""
        return all(-root.real >= SLOWER * self.alpha for root in self.left_over)


@dataclass(frozen=True, slots=True)
class PolePlacement:
    """The result of pole placement for all alphas.

    admissible: the admissible intervals of alpha, 1/s, ends included, up to the largest alpha searched; may be empty.
    minima: the local minima of J by rising alpha; may be empty.
    """

    admissible: tuple[tuple[float, float], ...]
    minima: tuple[Minimum, ...]


def s_plane(
    model: Model,
    *,
    controller: str = "pi",
    mu: float = 1.0,
    tau_s: float | None = None,
    k1: float = 1.2,
    alpha_per_s: float | None = None,
) -> Setting:
    """The PI or PID whose dominant roots have the shape mu and the size of smallest J; b = 1, for a PID c = 1 and Tf =
    0.

    controller: "pi" or "pid".
    mu: the ratio of imaginary to real part of the pair, 0.01 to 10; the damping ratio is 1/sqrt(1 + mu^2).
    tau_s: the weight of the error's rate, s, close to the desired time constant of the closed loop; by default a
    quarter of all lags and the dead time together.
    k1: the ratio of the real root of a PID to the pair's real part, 0.01 to 100.
    alpha_per_s: the pair's real part, 1/s, for pole placement without a search.
    Raises Refused, BAD_INPUT, for a bad argument, a model that `design` does not take, when no alpha (or not the given
    one) has positive gains and a stable loop, or when J has no minimum.
    """
    if tau_s is None:
        tau_s = 0.25 * time_sum(model)
    search = _search(model, controller, mu, tau_s, k1)
    if alpha_per_s is not None:
        if not 0.0 < alpha_per_s < math.inf:
            raise Refused(Reason.BAD_INPUT, f"alpha_per_s {alpha_per_s}: a positive number is accepted")
        if not search.is_admissible(np.array([alpha_per_s * search.unit]))[0]:
            shown = ", ".join(f"{low:.4g} to {high:.4g}" for low, high in search.design().admissible)
            raise Refused(
                Reason.BAD_INPUT,
                f"alpha_per_s {alpha_per_s} with mu {mu}: a gain is not positive or the loop not stable; "
                f"{shown or 'no alpha'} 1/s is accepted",
            )
        found = PolePlacement((), (search.minimum(alpha_per_s * search.unit),))
    else:
        found = search.design()
        if not found.admissible:
            raise Refused(
                Reason.BAD_INPUT,
                f"mu {mu}, k1 {k1}: roots of this shape have positive gains and a stable loop at no size; "
                f"another mu{' or k1' if controller == 'PID' else ''} may be accepted",
            )
    if not found.minima:
        raise Refused(
            Reason.BAD_INPUT,
            f"mu {mu}, tau_s {tau_s}: J has no least value but falls to where a gain or the stability ends "
            "(a PI on an integrating model does so: its integral action only costs at a set-point step); "
            "another mu or a PID may be accepted",
        )
    dominant = [each for each in found.minima if each.dominant]
    best = min(dominant or found.minima, key=lambda each: each.J)
    notes = []
    if not dominant:
        slowest = -best.left_over[0].real
        notes.append(f"A root of {slowest:.3g} 1/s is slower than the prescribed ones: the answer creeps.")
    elif (minimum := min(found.minima, key=lambda each: each.J)) is not best:
        notes.append(f"J is lower at alpha = {minimum.alpha:.3g} 1/s, but there a slower root rules; not taken.")
    chosen = {"alpha_per_s": best.alpha, "mu": mu, "tau_s": tau_s, "J_s": best.J, "J0_s": best.J0, "J1_per_s": best.J1}
    if controller == "pid":
        chosen["k1"] = k1
        notes.append("The derivative acts on the error without a filter: check the loop again with its filter.")
    return Setting(best.gains, chosen, tuple(notes))


def design(model: Model, *, controller: str, mu: float, tau_s: float, k1: float = 1.2) -> PolePlacement:
    """The admissible alphas and all local minima of J on them; arguments as for `s_plane`.

    alpha is searched from 0.01 to 100 over all lags and the dead time together, not beyond 10/L. More poles than zeros
    are needed: none for a PI without dead time, one for a PI with it or a PID without, two for a PID with it. Raises
    Refused otherwise and for bad arguments.
    """
    return _search(model, controller, mu, tau_s, k1).design()


def _search(model: Model, controller: str, mu: float, tau_s: float, k1: float) -> _Search:
    if controller not in CONTROLLERS:
        raise Refused(Reason.BAD_INPUT, f"controller {controller!r}: one of {', '.join(CONTROLLERS)} is accepted")
    unit = time_sum(model)
    if unit <= 0.0:
        raise Refused(Reason.BAD_INPUT, "the model has neither lag nor dead time: no root is too fast for it")
    if not 0.0 < tau_s < math.inf:
        raise Refused(Reason.BAD_INPUT, f"tau_s {tau_s}: a positive number is accepted")
    for name, value, (low, high) in (("mu", mu, MU), ("k1", k1, K1)):
        if not low <= value <= high:
            raise Refused(Reason.BAD_INPUT, f"{name} {value}: {low} to {high} is accepted")
    pid = controller == "pid"
    excess, needed = len(model.den) - len(model.num), int(pid) + int(model.L > 0.0)
    if excess < needed:
        raise Refused(
            Reason.BAD_INPUT,
            f"{excess} more poles than zeros: for a {controller} on this model at least {needed} are accepted",
        )
    return _Search(model, unit, mu, k1 if pid else None, tau_s / unit)


class _Search:
    """The search on one plant, scaled to a gain of one and with times in units of `unit` (s); alphas have shape
    (p,)."""

    def __init__(self, model: Model, unit: float, mu: float, k1: float | None, tau: float) -> None:
        plant = normalised(model, unit)
        self.unit, self.per_gain = unit, gain_unit(model, unit)
        self.plant, self.tau = plant, tau
        self.shape = np.array([-1.0 + 1j * mu] if k1 is None else [-1.0 + 1j * mu, -k1 + 0j])
        self.loop: _RationalLoops | _DelayedLoops = _DelayedLoops(plant) if plant.L > 0.0 else _RationalLoops(plant)

    def gains(self, alpha: Reals) -> Reals:
        """The Kp, Ki, Kd that place the prescribed roots, shape (p, 3); not finite where there are none."""
        s = alpha[:, None] * self.shape
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            wanted = -s * np.polyval(self.plant.den, s) / np.polyval(self.plant.num, s) * np.exp(self.plant.L * s)
        # Kp*s + Ki + Kd*s^2 = wanted at each root: real and imaginary part of the pair, real part of the real one
        terms = np.stack((s, np.ones_like(s), s * s), axis=2)[:, :, : 1 + len(self.shape)]
        rows = np.concatenate((terms[:, :1].imag, terms.real), axis=1)
        sides = np.concatenate((wanted[:, :1].imag, wanted.real), axis=1)
        found = np.zeros((len(alpha), 3))
        found[:, : rows.shape[2]] = np.nan
        finite = np.isfinite(sides).all(axis=1)
        found[finite, : rows.shape[2]] = np.linalg.solve(rows[finite], sides[finite][:, :, None])[:, :, 0]
        return found

    def is_admissible(self, alpha: Reals) -> NDArray[np.bool_]:
        gains = self.gains(alpha)
        good = np.asarray(np.isfinite(gains).all(axis=1) & (gains[:, : 1 + len(self.shape)] > 0.0).all(axis=1))
        if good.any():
            good[good] = self.loop.stable(gains[good])
        return good

    def admissible(self) -> list[tuple[float, float]]:
        # faster roots than 10/L have died out before the loop answers: others decide, at vanishing gains
        highest = min(100.0, 10.0 / self.plant.L) if self.plant.L > 0.0 else 100.0
        grid = np.geomspace(0.01, highest, GRID)
        good = self.is_admissible(grid)
        edges = np.flatnonzero(good[1:] != good[:-1])
        ends = [float(grid[0])] if good[0] else []
        ends += [self._edge(float(grid[i]), float(grid[i + 1])) for i in edges]
        ends += [float(grid[-1])] if good[-1] else []
        return list(zip(ends[::2], ends[1::2], strict=True))

    def _edge(self, low: float, high: float) -> float:
        """The last admissible alpha between one that is and one that is not."""
        rising = not bool(self.is_admissible(np.array([low]))[0])
        for _ in range(50):
            middle = 0.5 * (low + high)
            if bool(self.is_admissible(np.array([middle]))[0]) == rising:
                high = middle
            else:
                low = middle
        return high if rising else low

    def local_minima(self, low: float, high: float) -> list[float]:
        """Every local minimum of J inside an interval."""
        grid = np.geomspace(low, high, INSIDE)[1:-1]
        grid = np.concatenate(([low], grid, [high]))
        J0, J1 = self.loop.squares(self.gains(grid))
        J = J0 + self.tau**2 * J1
        found = []
        for i in np.flatnonzero((J[1:-1] < J[:-2]) & (J[1:-1] <= J[2:])) + 1:
            minimum = minimize_scalar(
                self._J, bounds=(grid[i - 1], grid[i + 1]), method="bounded", options={"xatol": 1e-9 * float(grid[i])}
            )
            found.append(float(minimum.x))
        return found

    def _J(self, alpha: float) -> float:
        J0, J1 = self.loop.squares(self.gains(np.array([alpha])))
        return float(J0[0] + self.tau**2 * J1[0])

    def design(self) -> PolePlacement:
        intervals = self.admissible()
        return PolePlacement(
            admissible=tuple((low / self.unit, high / self.unit) for low, high in intervals),
            minima=tuple(self.minimum(alpha) for low, high in intervals for alpha in self.local_minima(low, high)),
        )

    def minimum(self, alpha: float) -> Minimum:
        """The gains, the criterion and the other roots at one alpha."""
        unit = self.unit
        gains = self.gains(np.array([alpha]))
        J0, J1 = (float(each[0]) for each in self.loop.squares(gains))
        left = list(self.loop.roots(gains)[0])
        for root in alpha * np.concatenate((self.shape, self.shape[:1].conj())):
            away = np.array(left) - root
            if self.plant.L > 0.0:
                # imaginary parts are known up to a whole turn in one dead time
                turn = 2.0 * math.pi / self.plant.L
                away -= 1j * turn * np.round(away.imag / turn)
            left.pop(int(np.argmin(np.abs(away))))
        Kp, Ki, Kd = (float(each) for each in gains[0])
        return Minimum(
            alpha=alpha / unit,
            gains=Gains(Kp=Kp / self.per_gain, Ti=Kp / Ki * unit, Td=Kd / Kp * unit, c=1.0 if Kd > 0.0 else 0.0),
            J0=J0 * unit,
            J1=J1 / unit,
            J=(J0 + self.tau**2 * J1) * unit,
            left_over=tuple(complex(root) / unit for root in sorted(left, key=lambda root: -root.real)[:SHOWN]),
        )


class _RationalLoops:
    """Loops without dead time, described by their polynomials P = s*A + N*B; the error of a unit step is A/P."""

    def __init__(self, plant: TransferFunction) -> None:
        self.a, self.b = np.asarray(plant.den), np.asarray(plant.num)

    def polynomials(self, gains: Reals) -> Reals:
        """The polynomials P, shape (p, n + 2), with a leading coefficient that is not zero."""
        size = len(self.a) + 1
        total = np.zeros((len(gains), size))
        total[:, :-1] = self.a
        for power, gain in enumerate((gains[:, 1], gains[:, 0], gains[:, 2])):
            if (top := size - power - len(self.b)) < 0:
                break  # no derivative on a model that passes jumps on
            total[:, top : top + len(self.b)] += gain[:, None] * self.b
        return total

    def _companions(self, P: Reals) -> Reals:
        n = P.shape[1] - 1
        companions = np.zeros((len(P), n, n))
        companions[:, 0] = -P[:, 1:] / P[:, :1]
        companions[:, 1:, :-1] = np.eye(n - 1)
        return companions

    def roots(self, gains: Reals) -> Complexes:
        return np.linalg.eigvals(self._companions(self.polynomials(gains))).astype(np.complex128)

    def stable(self, gains: Reals) -> NDArray[np.bool_]:
        return np.asarray(self.roots(gains).real.max(axis=1) < -STABLE_BY)

    def squares(self, gains: Reals) -> tuple[Reals, Reals]:
        """The integrals of e^2 and of e'^2 after t = 0, each of shape (p,); infinite at the limit of stability."""
        P = self.polynomials(gains)
        e = np.broadcast_to(self.a, (len(P), len(self.a))) / P[:, :1]
        # the jump at t = 0 is not a rate: s*E - e(0+)
        rate = e[:, :1] * -P / P[:, :1]
        rate[:, :-1] += e
        A, identity = self._companions(P), np.eye(len(self.a))
        size = len(self.a) ** 2
        # A W + W A' = -b b', all loops at once
        system = np.einsum("pij,kl->pikjl", A, identity) + np.einsum("ij,pkl->pikjl", identity, A)
        side = np.zeros((len(P), size, 1))
        side[:, 0] = -1.0
        W = _solved(system.reshape(-1, size, size), side).reshape(A.shape)
        J0, J1 = (np.einsum("pi,pij,pj->p", f, W, f) for f in (e, rate[:, 1:]))
        return np.where(np.isnan(J0), np.inf, J0), np.where(np.isnan(J1), np.inf, J1)


def _solved(systems: Reals, sides: Reals) -> Reals:
    """The solutions of linear systems, NaN where one is singular. At an end of the admissible alphas, where gains go to
    infinity, rounding decides whether a system is singular."""
    try:
        return np.asarray(np.linalg.solve(systems, sides))
    except np.linalg.LinAlgError:
        if len(systems) == 1:
            return np.full(sides.shape, np.nan)
        return np.concatenate([_solved(systems[i : i + 1], sides[i : i + 1]) for i in range(len(systems))])


class _DelayedLoops:
    """Loops with dead time, described by their map from one dead time to the next."""

    def __init__(self, plant: TransferFunction) -> None:
        self.loop = DeadTimeLoop(plant)

    def _maps(self, gains: Reals) -> Reals:
        return self.loop.maps(gains[:, 0], gains[:, 1], gains[:, 2])

    def roots(self, gains: Reals) -> Complexes:
        return self.loop.roots(self._maps(gains))

    def stable(self, gains: Reals) -> NDArray[np.bool_]:
        return np.asarray(self.loop.roots(self._maps(gains))[:, 0].real < -STABLE_BY)

    def squares(self, gains: Reals) -> tuple[Reals, Reals]:
        """The integrals of e^2 and of e'^2 after t = 0, each of shape (p,)."""
        return self.loop.squares(self._maps(gains), self.loop.start(gains[:, 0], gains[:, 2]))

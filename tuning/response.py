"""Time responses of a loop with exact dead time to a step of the set-point or of the load.

Plant and controller without the dead time are one linear system in state space. Its input, the measured PV, comes back
a dead time later: PV over the next dead time follows from PV over the last one (method of steps). The system is
discretised exactly for an input that is linear between the steps; a dead time is a whole number of steps, so every
jump and kink of the response falls between two of its blocks, where it does no harm. Without dead time the closed loop
itself is discretised, exactly.

An ideal derivative (Tf = 0) is the exact one: it acts through a changed output of the plant's state, no filter is
slipped in. The impulse that it puts into MV when the set-point steps (c > 0) reaches PV, but no figure of MV counts it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.fft import next_fast_len
from scipy.linalg import matrix_balance, toeplitz

from tuning.figures import StepFigures, response_figures
from tuning.gains import Gains
from tuning.models import Model, Reals, TransferFunction, integrators, sign, time_constants
from tuning.reasons import Reason, Refused
from tuning.stability import is_stable, open_loop

MAX_STEPS = 40_000
LONGER = 24
SMALL_BLOCK = 100
"""States of a block up to which all blocks come from powers of one matrix instead of one convolution each."""


@dataclass(frozen=True, slots=True)
class Response:
    """t: s.  y: PV change, PV units.  u: MV change, MV units. The loop has positive gain whatever the model's sign.

    t never decreases: an instant at which y or u jumps is there twice, just before and just after the jump.
    """

    t: Reals
    y: Reals
    u: Reals


def step_figures(
    model: Model,
    gains: Gains,
    horizon: float | None = None,
    dt: float | None = None,
    load: bool = False,
    band: float = 0.02,
) -> StepFigures:
    """Figures of the loop's answer to a unit set-point step (or a unit step at the plant's input).

    horizon, dt: s; see `step_response` for the defaults.  band: of settling, a fraction of the final change (load: of
    the peak). Raises Refused: NOT_ROBUST for an unstable loop, BAD_INPUT as `step_response`.
    """
    _require_stable(model, gains)
    response = step_response(model, gains, horizon, dt, load)
    final = final_value(model, gains, load)
    most = float(np.max(np.abs(response.y))) if load else final
    return response_figures(
        response.t,
        response.y,
        response.u,
        final=0.0 if load else final,
        reference=0.0 if load else 1.0,
        band=band * most,
        final_u=_final_control(model, gains, load),
    )


def final_value(model: Model, gains: Gains, load: bool) -> float:
    """Where PV of the stable loop ends after a unit step, PV units."""
    if gains.Ti > 0.0:
        return 0.0 if load else 1.0
    if integrators(model):
        return 1.0 / gains.Kp if load else gains.b
    k = gains.Kp * abs(model.static_gain)
    return abs(model.static_gain) / (1.0 + k) if load else gains.b * k / (1.0 + k)


def step_response(
    model: Model, gains: Gains, horizon: float | None = None, dt: float | None = None, load: bool = False
) -> Response:
    """The loop from rest under a unit step of the set-point, or (load) of the plant's input, at t = 0.

    horizon: s, by default until the response has come to rest.  dt: s, at most; by default a hundredth of the dead time
    and of the crossover's radian, unless that is more than 40,000 steps. A dead time has four steps at least;
    one that is shorter than 2*dt and than a 20,000th of the horizon is taken as its second-order Pade approximant.

    Raises Refused: NOT_ROBUST for an unstable loop when no horizon is given, or when its response overflows; BAD_INPUT
    for gains that are none or an ideal derivative on a bi-proper plant.
    """
    for name, value in (("horizon", horizon), ("dt", dt)):
        if value is not None and not (math.isfinite(value) and value > 0.0):
            raise Refused(Reason.BAD_INPUT, f"{name} = {value} s: must be positive")
    if horizon is not None:
        return _simulated(model, gains, horizon, dt or _fine(model, gains, horizon), load)
    _require_stable(model, gains)
    final = final_value(model, gains, load)
    # a slow tail that counts shows at the record's end and doubles it
    horizon = 20.0 * (model.L + 1.0 / _crossover(model, gains))
    for _ in range(LONGER):
        found = _simulated(model, gains, horizon, dt or _fine(model, gains, horizon), load)
        away = np.abs(found.y - final)
        late = found.t >= 0.8 * horizon
        if float(np.max(away[late])) <= 1e-4 * float(np.max(away)):
            break
        horizon *= 2.0
    return found


def _require_stable(model: Model, gains: Gains) -> None:
    if not is_stable(model, gains):
        raise Refused(Reason.NOT_ROBUST, f"the loop of Kp {gains.Kp:.4g}, Ti {gains.Ti:.4g} s is unstable")


def _crossover(model: Model, gains: Gains) -> float:
    """About the highest frequency at which the loop gain is one, rad/s; the fastest lag's where it never is."""
    N, D = open_loop(model, gains)
    corners = np.abs(np.concatenate((np.roots(N), np.roots(D), [1.0 / model.L if model.L > 0.0 else 0.0])))
    corners = corners[corners > 0.0]
    if not len(corners):
        return abs(float(N[-1] / D[0]))
    w = np.geomspace(1e-4 * float(corners.min()), 1e4 * float(corners.max()), 400)
    above = np.abs(np.polyval(N, 1j * w) / np.polyval(D, 1j * w)) >= 1.0
    # an ideal derivative may hold the gain above one for good
    ends = np.flatnonzero(above[:-1] & ~above[1:])
    return float(w[ends[-1]]) if len(ends) else float(corners.min())


def _fine(model: Model, gains: Gains, horizon: float) -> float:
    step = min(0.01 / _crossover(model, gains), horizon / 2000.0)
    if model.L > 0.0:
        step = min(step, model.L / 100.0)
    return max(step, horizon / MAX_STEPS)


def _final_control(model: Model, gains: Gains, load: bool) -> float:
    """Where MV of the stable loop ends, MV units."""
    if load and (gains.Ti > 0.0 or integrators(model)):
        return -1.0
    if integrators(model):
        return 0.0
    static = abs(model.static_gain)
    return (final_value(model, gains, load) - (static if load else 0.0)) / static


def _simulated(model: Model, gains: Gains, horizon: float, dt: float, load: bool) -> Response:
    if 0.0 < model.L < 2.0 * min(dt, horizon / MAX_STEPS):
        model = _without_dead_time(model)
    delay = max(4, math.ceil(model.L / dt - 1e-9)) if model.L > 0.0 else 0
    if delay:
        dt = model.L / delay
    steps = math.ceil(horizon / dt - 1e-9)
    loop = _Loop(model, gains, load)
    with np.errstate(over="ignore", invalid="ignore"):
        blocks = loop.delayed(steps, delay, dt) if delay else loop.immediate(steps, dt)
        found = _joined(blocks, _control(blocks, gains, dt, 0.0 if load else 1.0), dt, steps)
    if not (np.isfinite(found.y).all() and np.isfinite(found.u).all()):
        raise Refused(Reason.NOT_ROBUST, f"the response grows beyond all bounds within {horizon:g} s")
    return found


def _without_dead_time(model: Model) -> TransferFunction:
    L = model.L
    return TransferFunction(
        tuple(np.polymul(model.num, [L * L / 12.0, -L / 2.0, 1.0])),
        tuple(np.polymul(model.den, [L * L / 12.0, L / 2.0, 1.0])),
    )


class _Loop:
    """x' = a x + b*y(measured), PV to be measured = c x + d*y(measured); the last state is the step itself, one."""

    def __init__(self, model: Model, gains: Gains, load: bool) -> None:
        g = gains
        open_loop(model, g)
        A, B, C, D = _companion(model)
        n = len(B)
        filtered = g.Td > 0.0 and g.Tf > 0.0
        order = n + 3
        integral, lag, one = n, n + 1, n + 2
        setpoint, extra = (0.0, 1.0) if load else (1.0, 0.0)
        kd = g.Kp * g.Td / g.Tf if filtered else 0.0
        # u = by_state x + by_y y(measured)
        by_state, by_y = np.zeros(order), -g.Kp - kd
        by_state[integral], by_state[lag] = 1.0, -kd
        by_state[one] = (g.Kp * g.b + kd * g.c) * setpoint
        into = by_state.copy()
        into[one] += extra
        self.a, self.b = np.zeros((order, order)), np.zeros(order)
        self.a[:n, :n] = A
        self.a[:n] += np.outer(B, into)
        self.b[:n] = B * by_y
        self.c, self.d = np.zeros(order), D * by_y
        self.c[:n] = C
        self.c += D * into
        if g.Ti > 0.0:
            self.a[integral, one], self.b[integral] = g.Kp / g.Ti * setpoint, -g.Kp / g.Ti
        if filtered:
            self.a[lag, lag], self.a[lag, one], self.b[lag] = -1.0 / g.Tf, g.c * setpoint / g.Tf, -1.0 / g.Tf
        elif g.Td > 0.0:
            # the plant's state less B*k*(c*r - y) has no derivative in its equation (D = 0: see open_loop)
            k, moved = g.Kp * g.Td, A @ B
            self.a[:n, one] += moved * k * g.c * setpoint
            self.b[:n] -= moved * k
            self.c[one] += float(C @ B) * k * g.c * setpoint
            self.d -= float(C @ B) * k

    def immediate(self, steps: int, dt: float) -> Reals:
        """PV of one block of steps + 1 samples, shape (1, steps + 1): nothing is delayed."""
        closed = self.c / (1.0 - self.d)
        advance = _transition((self.a + np.outer(self.b, closed)) * dt)
        start = np.zeros(len(self.b))
        start[-1] = 1.0
        return np.asarray(closed @ _powers(advance, start, steps + 1))[None, :]

    def delayed(self, steps: int, delay: int, dt: float) -> Reals:
        """PV in blocks of a dead time, shape (blocks, delay + 1); both ends of a block belong to it."""
        order = len(self.b)
        augmented = np.zeros((order + 2, order + 2))
        augmented[:order, :order] = self.a * dt
        augmented[:order, order] = self.b * dt
        augmented[order, order + 1] = 1.0
        full = _transition(augmented)
        a = full[:order, :order]
        b1 = full[:order, order + 1]
        b0 = full[:order, order] - b1
        # what the input at one sample has done k steps later
        spread0, spread1 = _powers(a, b0, delay), _powers(a, b1, delay + 1)
        free = _powers(a.T, self.c, delay + 1).T
        kernel = self.c @ spread1
        begun = kernel.copy()
        kernel[0] += self.d
        kernel[1:] += self.c @ spread0
        # the state at the block's end
        ends = np.zeros((order, delay + 1))
        ends[:, :-1] += spread0[:, ::-1]
        ends[:, 1:] += spread1[:, delay - 1 :: -1] if delay > 1 else spread1[:, :1]
        whole = np.linalg.matrix_power(a, delay)
        blocks = math.ceil(steps / delay)
        state = np.zeros(order)
        state[-1] = 1.0
        if delay + 1 + order <= SMALL_BLOCK:
            driven = toeplitz(kernel, np.zeros(delay + 1))
            driven[:, 0] -= begun
            advance = np.block([[driven, free], [ends, whole]])
            return np.ascontiguousarray(_powers(advance, np.append(np.zeros(delay + 1), state), blocks)[: delay + 1].T)
        y = np.zeros((blocks, delay + 1))
        length = next_fast_len(2 * delay + 1, real=True)
        spectrum = np.fft.rfft(kernel, length)
        for k in range(1, blocks):
            last = y[k - 1]
            driven = np.fft.irfft(np.fft.rfft(last, length) * spectrum, length)[: delay + 1]
            y[k] = free @ state + driven - begun * last[0]
            state = whole @ state + ends @ last
        return y


def _companion(model: Model) -> tuple[Reals, Reals, Reals, float]:
    """(A, B, C, D) of the model without dead time and with positive gain, balanced; time in s."""
    den = np.asarray(model.den)
    num = np.concatenate((np.zeros(len(den) - len(model.num)), model.num)) * sign(model) / den[0]
    den = den / den[0]
    lags = time_constants(model)
    unit = float(np.exp(np.mean(np.log(lags)))) if len(lags) else 1.0
    scale = unit ** np.arange(len(den))
    den, num = den * scale, num * scale
    order = len(den) - 1
    A = np.zeros((order, order))
    A[0] = -den[1:]
    A[1:, :-1] = np.eye(order - 1)
    C = num[1:] - den[1:] * num[0]
    balanced, (weights, _) = matrix_balance(A, permute=False, separate=True)
    B = np.zeros(order)
    B[0] = 1.0 / weights[0]
    return np.asarray(balanced, dtype=float) / unit, B / unit, C * weights, float(num[0])


def _transition(a: Reals) -> Reals:
    """exp(a), by scaling, Taylor and squaring: scipy's takes milliseconds for matrices as small as these."""
    size = float(np.max(np.sum(np.abs(a), axis=1)))
    halvings = max(0, math.ceil(math.log2(size)) + 1) if size > 0.0 else 0
    scaled = a / 2.0**halvings
    one = np.eye(len(a))
    found = one
    # of a size up to 1/2, fifteen terms leave 1e-17
    for k in range(15, 0, -1):
        found = one + scaled @ found / k
    for _ in range(halvings):
        found = found @ found
    return np.asarray(found)


def _powers(a: Reals, x: Reals, count: int) -> Reals:
    """x, a x, a^2 x, ...: shape (len(x), count), by doubling."""
    found = np.empty((len(x), count))
    found[:, 0] = x
    done = 1
    while done < count:
        more = min(done, count - done)
        found[:, done : done + more] = a @ found[:, :more]
        done += more
        a = a @ a
    return found


def _control(y: Reals, gains: Gains, dt: float, setpoint: float) -> Reals:
    """MV for PV in blocks; signals are linear between the samples of a block."""
    g = gains
    u = g.Kp * (g.b * setpoint - y)
    if g.Ti > 0.0:
        areas = (0.5 * dt) * (2.0 * setpoint - y[:, 1:] - y[:, :-1])
        inside = np.cumsum(areas, axis=1)
        before = np.concatenate(([0.0], np.cumsum(inside[:-1, -1])))
        u += g.Kp / g.Ti * before[:, None]
        u[:, 1:] += g.Kp / g.Ti * inside
    if g.Td > 0.0 and g.Tf > 0.0:
        v = g.c * setpoint - y
        u += g.Kp * g.Td / g.Tf * (v - _lagged(v, g.Tf / dt))
    elif g.Td > 0.0:
        u -= g.Kp * g.Td * np.gradient(y, dt, axis=1, edge_order=2)
    return u


def _lagged(v: Reals, steps: float) -> Reals:
    """v in blocks behind a first-order lag of so many steps, from rest."""
    decay = math.exp(-1.0 / steps)
    w1 = 1.0 - steps * (1.0 - decay)
    w0 = 1.0 - decay - w1
    found = np.zeros_like(v)
    found[:, 1:] = w0 * v[:, :-1] + w1 * v[:, 1:]
    # found[n] += decay found[n - 1] for all n, by doubling: scipy's lfilter costs 0.2 s of import
    shift = 1
    while shift < v.shape[1] and (weight := decay**shift) > 1e-20:
        found[:, shift:] += weight * found[:, :-shift]
        shift *= 2
    fading = decay ** np.arange(v.shape[1])
    start = 0.0
    for block in found:
        block += start * fading
        start = float(block[-1])
    return found


def _joined(y: Reals, u: Reals, dt: float, steps: int) -> Response:
    """The blocks in a row; where one ends and the next begins without a jump, one sample of the two is left out."""
    blocks, width = y.shape
    jumps = np.zeros(blocks - 1, dtype=bool)
    for signal in (y, u):
        jumps |= np.abs(signal[1:, 0] - signal[:-1, -1]) > 1e-7 * max(float(np.max(signal)), -float(np.min(signal)))
    count = steps + 1
    if not jumps.any():
        rows = [np.append(signal[:, :-1], signal[-1, -1])[:count] for signal in (y, u)]
        return Response(np.arange(count, dtype=np.float64) * dt, *rows)
    t = (np.arange(blocks)[:, None] * (width - 1) + np.arange(width)) * dt
    kept = t <= (steps + 0.5) * dt
    kept[:-1, -1] &= jumps
    return Response(t[kept], y[kept], u[kept])

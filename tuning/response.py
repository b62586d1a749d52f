"""Time responses of a loop with dead time, and the figures engineers read from a step response.

The plant is discretised exactly for an input that is linear between the steps, the dead time is a whole number of
steps, the controller's integral is the trapezoidal rule: second order in the step throughout. A bi-proper plant passes
the jumps of its input on, so every signal is kept just before and just after each step.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.integrate import trapezoid
from scipy.linalg import expm

from tuning.gains import Gains
from tuning.models import Model, Reals, time_constants

MAX_STEPS = 40_000


@dataclass(frozen=True, slots=True)
class StepFigures:
    """Of a response to a step of the set-point (of the load: only IAE, ITAE, peak and settling mean something).

    overshoot_pct: of the final change, not below 0.  settling_s: into 2 % of the final change (load: of the peak) for
    good; infinite if not within the record.  rise_s: 10 to 90 %; infinite if never.  IAE, ITAE: of the error to the
    set-point, in PV units * s and PV units * s^2, for the step as made.  peak: largest PV change along the step.
    """

    overshoot_pct: float
    settling_s: float
    rise_s: float
    IAE: float
    ITAE: float
    peak: float


@dataclass(frozen=True, slots=True)
class Response:
    """t: s.  y: PV change.  u: MV change. Values just after each instant."""

    t: Reals
    y: Reals
    u: Reals


def step_figures(
    model: Model, gains: Gains, horizon: float | None = None, dt: float | None = None, load: bool = False
) -> StepFigures:
    """Figures of the loop's answer to a unit set-point step (or a unit step at the plant's input).

    horizon, dt: s; see `step_response` for the defaults. The loop must be stable for the figures to mean anything.
    """
    response = step_response(model, gains, horizon, dt, load)
    if load:
        return _figures(response.t, response.y, final=0.0, reference=0.0, band=0.02 * float(np.max(np.abs(response.y))))
    final = 1.0
    if gains.Ti == 0.0:
        k = gains.Kp * abs(model.static_gain)
        final = gains.b * k / (1.0 + k)
    return _figures(response.t, response.y, final=final, reference=1.0, band=0.02 * final)


def step_response(
    model: Model, gains: Gains, horizon: float | None = None, dt: float | None = None, load: bool = False
) -> Response:
    """The loop from rest under a unit step of the set-point, or (load) of the plant's input, at t = 0.

    horizon: s, by default ten times the plant's lags and dead time together, longer for a sluggish loop.
    dt: s, at most; by default a hundredth of the dead time or of the slowest lag, whichever is less.
    """
    lags = time_constants(model)
    if horizon is None:
        horizon = 10.0 * (float(lags.sum()) + model.L)
        if gains.Ti > 0.0:
            horizon = max(horizon, 5.0 * gains.Ti * (1.0 + 1.0 / (gains.Kp * abs(model.static_gain))))
    if dt is None:
        dt = min(float(lags.max()), model.L if model.L > 0.0 else math.inf) / 100.0
        dt = max(dt, horizon / MAX_STEPS)
    delay = max(1, math.ceil(model.L / dt - 1e-9)) if model.L > 0.0 else 0
    if delay:
        dt = model.L / delay
    steps = math.ceil(horizon / dt - 1e-9)
    loop = _Loop(model, gains, dt)
    y, u = loop.delayed(steps, delay, load) if delay else loop.immediate(steps, load)
    return Response(np.arange(steps + 1, dtype=np.float64) * dt, y, u)


def figures_of(t: Reals, y: Reals, step: float, y0: float) -> StepFigures:
    """Figures of a recorded set-point step of size `step` (PV units, either sign) made at t[0] from rest at y0.

    Where measurement noise shows, overshoot, rise and settling are read from a moving mean over a tenth of the rise,
    and the settling band is at least three times the noise left in it.
    """
    time = np.asarray(t, dtype=float) - float(t[0])
    change = (np.asarray(y, dtype=float) - y0) / step
    # differences over one sample hardly contain the response, so their median size is the noise's (sqrt 2 * 0.6745)
    noise = float(np.median(np.abs(np.diff(change, 2)))) / (math.sqrt(6.0) * 0.6745)
    smooth, band = change, 0.02
    if noise > 0.002:
        rough = _rise(time, _moving_mean(change, 5))
        dt = (time[-1] - time[0]) / (len(time) - 1)
        width = int(min(rough, float(time[-1]) / 5.0) / 10.0 / dt) | 1
        smooth = _moving_mean(change, max(width, 5))
        band = max(band, 3.0 * noise / math.sqrt(max(width, 5)))
    found = _figures(time, smooth, final=1.0, reference=1.0, band=band)
    error = np.abs(1.0 - change)
    size = abs(step)
    return StepFigures(
        overshoot_pct=found.overshoot_pct,
        settling_s=found.settling_s,
        rise_s=found.rise_s,
        IAE=size * float(trapezoid(error, time)),
        ITAE=size * float(trapezoid(time * error, time)),
        peak=size * found.peak,
    )


def _figures(t: Reals, y: Reals, *, final: float, reference: float, band: float) -> StepFigures:
    error = np.abs(reference - y)
    outside = np.flatnonzero(np.abs(y - final) > band)
    if not len(outside):
        settling = 0.0
    elif outside[-1] == len(y) - 1:
        settling = math.inf
    else:
        i = int(outside[-1])
        a, b = abs(y[i] - final), abs(y[i + 1] - final)
        settling = float(t[i] + (t[i + 1] - t[i]) * (a - band) / (a - b))
    peak = float(np.max(y))
    return StepFigures(
        overshoot_pct=max(0.0, 100.0 * (peak / final - 1.0)) if final else 0.0,
        settling_s=settling,
        rise_s=_rise(t, y / final) if final else math.inf,
        IAE=float(trapezoid(error, t)),
        ITAE=float(trapezoid(t * error, t)),
        peak=peak,
    )


def _rise(t: Reals, y: Reals) -> float:
    """From 10 to 90 % of one, s."""
    at = []
    for level in (0.1, 0.9):
        above = np.flatnonzero(y >= level)
        if not len(above):
            return math.inf
        i = int(above[0])
        at.append(float(t[0]) if i == 0 else float(np.interp(level, y[i - 1 : i + 1], t[i - 1 : i + 1])))
    return at[1] - at[0]


def _moving_mean(y: Reals, width: int) -> Reals:
    """Centred, the ends held."""
    half = width // 2
    padded = np.pad(y, half, mode="edge")
    return np.convolve(padded, np.full(2 * half + 1, 1.0 / (2 * half + 1)), "valid")


class _Loop:
    """One step of the loop: x' = A x + b0*u(just after n) + b1*u(just before n+1), y = c x + d*u."""

    def __init__(self, model: Model, gains: Gains, dt: float) -> None:
        self.dt, self.gains = dt, gains
        sign = math.copysign(1.0, model.static_gain)
        order = len(model.den) - 1
        den = np.asarray(model.den) / model.den[0]
        num = np.concatenate((np.zeros(len(den) - len(model.num)), model.num)) * sign / model.den[0]
        # time in steps and balanced companion form keep the exponential well conditioned for lags far apart
        scale = dt ** np.arange(order + 1)
        den, num = den * scale, num * scale
        self.d = float(num[0])
        self.c = num[1:] - den[1:] * num[0]
        a = np.zeros((order, order))
        a[0] = -den[1:]
        a[1:, :-1] = np.eye(order - 1)
        weights = 1.0 / np.maximum(np.abs(_ramp(den, order)), 1e-300)
        a = a * weights[:, None] / weights[None, :]
        self.c = self.c / weights
        augmented = np.zeros((order + 2, order + 2))
        augmented[:order, :order] = a
        augmented[0, order] = weights[0]
        augmented[order, order + 1] = 1.0
        full = expm(augmented)
        self.a = full[:order, :order]
        self.b1 = full[:order, order + 1]
        self.b0 = full[:order, order] - self.b1

    def delayed(self, steps: int, delay: int, load: bool) -> tuple[Reals, Reals]:
        """The plant's input of the next `delay` steps is known: advance by whole dead times, one convolution each."""
        order = len(self.b0)
        free = np.empty((delay + 1, order))
        free[0] = self.c
        to_end0, to_end1 = np.empty((delay, order)), np.empty((delay, order))
        x0, x1 = self.b0, self.b1
        for k in range(delay):
            to_end0[delay - 1 - k], to_end1[delay - 1 - k] = x0, x1
            x0, x1 = self.a @ x0, self.a @ x1
            free[k + 1] = free[k] @ self.a
        impulse0, impulse1 = to_end0[::-1] @ self.c, to_end1[::-1] @ self.c
        power = np.linalg.matrix_power(self.a, delay)

        blocks = math.ceil(steps / delay)
        after, before = np.zeros(blocks * delay + 1), np.zeros(blocks * delay + 1)
        y = np.zeros(blocks * delay + 1)
        x = np.zeros(order)
        controller = _Controller(self.gains, self.dt, 0.0 if load else 1.0)
        extra = 1.0 if load else 0.0
        past_after, past_before = np.zeros(delay), np.zeros(delay + 1)
        for block in range(blocks):
            here = slice(block * delay, (block + 1) * delay + 1)
            driven = np.convolve(impulse0, past_after)[:delay] + np.convolve(impulse1, past_before[1:])[:delay]
            out = free @ x
            out[1:] += driven
            y_after = out[:-1] + self.d * past_after
            y_before = out[1:] + self.d * past_before[1:]
            x = power @ x + past_after @ to_end0 + past_before[1:] @ to_end1
            u_after, u_before = controller.advance(y_after, y_before)
            y[here][:-1] = y_after
            y[(block + 1) * delay] = y_before[-1]
            after[here][:-1], before[here][1:] = u_after, u_before
            past_after = u_after + extra
            past_before = np.concatenate(([0.0], u_before + extra))
        after[-1] = before[-1]
        return y[: steps + 1], after[: steps + 1]

    def immediate(self, steps: int, load: bool) -> tuple[Reals, Reals]:
        """Without dead time input and output of one instant depend on each other: a linear equation each step."""
        y, u = np.zeros(steps + 1), np.zeros(steps + 1)
        controller = _Controller(self.gains, self.dt, 0.0 if load else 1.0)
        extra = 1.0 if load else 0.0
        x = np.zeros(len(self.b0))
        offset, slope = controller.now()
        # u = offset - slope*y and y = c x + d*(u + extra)
        y[0] = self.d * (offset + extra) / (1.0 + self.d * slope)
        u[0] = offset - slope * y[0]
        through = float(self.c @ self.b1) + self.d
        for n in range(steps):
            x = self.a @ x + self.b0 * (u[n] + extra)
            known = float(self.c @ x)
            offset, slope = controller.ahead(float(y[n]))
            y[n + 1] = (known + through * (offset + extra)) / (1.0 + through * slope)
            u[n + 1] = offset - slope * y[n + 1]
            x = x + self.b1 * (u[n + 1] + extra)
            controller.commit(float(y[n]), float(y[n + 1]))
        return y, u


def _ramp(den: Reals, order: int) -> Reals:
    """Sizes of the companion states at constant input: powers of the geometric mean of the poles."""
    mean = max(abs(float(den[-1])), 1e-300) ** (1.0 / order)
    return np.asarray(mean ** -np.arange(1.0, order + 1.0))


class _Controller:
    """The ISA controller in continuous time, its signals linear between the steps; the set-point steps at t = 0."""

    def __init__(self, gains: Gains, dt: float, setpoint: float) -> None:
        self.gains, self.dt, self.sp = gains, dt, setpoint
        self.integral = 0.0
        self.per_step = gains.Kp / gains.Ti * dt if gains.Ti > 0.0 else 0.0
        # a derivative without filter cannot be built: its filter is then one step
        filter_steps = max(gains.Tf, dt) / dt
        self.decay = math.exp(-1.0 / filter_steps)
        self.w1 = 1.0 - filter_steps * (1.0 - self.decay)
        self.w0 = 1.0 - self.decay - self.w1
        self.kd = gains.Kp * gains.Td / (filter_steps * dt)
        self.filtered = 0.0

    def advance(self, y_after: Reals, y_before: Reals) -> tuple[Reals, Reals]:
        """u just after each step and just before the next, for y just after each step and just before the next."""
        g = self.gains
        areas = self.per_step * (self.sp - 0.5 * (y_after + y_before))
        sums = self.integral + np.cumsum(areas)
        starts = np.concatenate(([self.integral], sums[:-1]))
        self.integral = float(sums[-1])
        u_after = g.Kp * (g.b * self.sp - y_after) + starts
        u_before = g.Kp * (g.b * self.sp - y_before) + sums
        if self.kd > 0.0:
            for n in range(len(y_after)):
                v, w = g.c * self.sp - float(y_after[n]), g.c * self.sp - float(y_before[n])
                u_after[n] += self.kd * (v - self.filtered)
                self.filtered = self.decay * self.filtered + self.w0 * v + self.w1 * w
                u_before[n] += self.kd * (w - self.filtered)
        return u_after, u_before

    def now(self) -> tuple[float, float]:
        """(offset, slope) of u = offset - slope*y at this instant."""
        g = self.gains
        offset = g.Kp * g.b * self.sp + self.integral + self.kd * (g.c * self.sp - self.filtered)
        return offset, g.Kp + self.kd

    def ahead(self, y: float) -> tuple[float, float]:
        """(offset, slope) of u = offset - slope*y(one step on), given y now."""
        g = self.gains
        integral = self.integral + self.per_step * (self.sp - 0.5 * y)
        filtered = self.decay * self.filtered + self.w0 * (g.c * self.sp - y) + self.w1 * g.c * self.sp
        offset = g.Kp * g.b * self.sp + integral + self.kd * (g.c * self.sp - filtered)
        return offset, g.Kp + 0.5 * self.per_step + self.kd * (1.0 - self.w1)

    def commit(self, y: float, y_next: float) -> None:
        """One step on: what `ahead` assumed has happened."""
        g = self.gains
        self.integral += self.per_step * (self.sp - 0.5 * (y + y_next))
        self.filtered = self.decay * self.filtered + self.w0 * (g.c * self.sp - y) + self.w1 * (g.c * self.sp - y_next)

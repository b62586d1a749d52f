"""The time responses of a loop with exact dead time to a set-point step or to a load disturbance.

`tuning.analysis.closed_loop` computes PV; MV follows from PV by the controller's equation.

An ideal derivative (Tf = 0) is exact: it acts on a changed output of the plant's state, without an added filter. The
impulse that it puts into MV when the set-point steps (c > 0) reaches PV, but no figure of MV counts it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from loopwright.tuning.analysis.closed_loop import ClosedLoop
from loopwright.tuning.analysis.stability import is_stable, open_loop
from loopwright.tuning.analysis.step_figures import StepFigures, response_figures
from loopwright.tuning.gains import AnyGains, Gains, as_gains
from loopwright.tuning.models import AnyModel, Model, Reals, TransferFunction, as_model, integrators
from loopwright.tuning.reasons import Reason, Refused

MAX_STEPS = 40_000
LONGER = 24
"""Largest number of times that a default record is doubled."""


@dataclass(frozen=True, slots=True)
class Response:
    """A time response. The loop has positive gain whatever the model's sign.

    t: the times, s, shape (N,). They never decrease: a time at which y or u jumps is there twice, just before and just
    after the jump.
    y: the change of PV, PV units.
    u: the change of MV, MV units.
    """

    t: Reals
    y: Reals
    u: Reals


def step_figures(
    model: AnyModel,
    gains: AnyGains,
    horizon: float | None = None,
    dt: float | None = None,
    load: bool = False,
    band: float = 0.02,
) -> StepFigures:
    """The figures of the loop's answer to a unit set-point step, or (load) to a unit load disturbance.

    horizon, dt: the length and the step of the simulation, s; see `step_response` for the defaults.
    band: the settling band, as a fraction of the final change (after a load disturbance: of the peak).
    Raises Refused: NOT_ROBUST for an unstable loop, BAD_INPUT as `step_response`. Raises TypeError as that.
    """
    model, gains = as_model(model), as_gains(gains)
    _require_stable(model, gains)
    response = step_response(model, gains, horizon, dt, load)
    final = final_value(model, gains, load)
    maximum = float(np.max(np.abs(response.y))) if load else final
    return response_figures(
        response.t,
        response.y,
        response.u,
        final=0.0 if load else final,
        reference=0.0 if load else 1.0,
        band=band * maximum,
        final_u=_final_control(model, gains, load),
    )


def final_value(model: Model, gains: Gains, load: bool) -> float:
    """The final value of PV of the stable loop after a unit step, PV units."""
    if gains.Ti > 0.0:
        return 0.0 if load else 1.0
    if integrators(model):
        return 1.0 / gains.Kp if load else gains.b
    k = gains.Kp * abs(model.static_gain)
    return abs(model.static_gain) / (1.0 + k) if load else gains.b * k / (1.0 + k)


def step_response(
    model: AnyModel, gains: AnyGains, horizon: float | None = None, dt: float | None = None, load: bool = False
) -> Response:
    """The response of the loop from rest to a unit set-point step, or (load) to a unit load disturbance, at t = 0.

    horizon: the length of the response, s; by default until the response has come to rest.
    dt: the longest step, s; by default a hundredth of the dead time and of the crossover's radian, unless that is more
    than 40,000 steps. A dead time has at least four steps. A dead time that is shorter than 2*dt and than a 20,000th of
    the horizon is replaced by its second-order Pade approximant.

    Raises Refused: NOT_ROBUST for an unstable loop when no horizon is given, or when its response overflows; BAD_INPUT
    for gains out of range or an ideal derivative on a bi-proper plant. Raises TypeError for what is no model or has no
    gains.
    """
    model, gains = as_model(model), as_gains(gains)
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
    """About the highest frequency at which the loop gain is one, rad/s; a corner frequency where there is none."""
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
    """The final value of MV of the stable loop, MV units."""
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
    loop = ClosedLoop(model, gains, load)
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


def _control(y: Reals, gains: Gains, dt: float, setpoint: float) -> Reals:
    """MV for PV in blocks, both of shape (blocks, samples); signals are linear between the samples of a block."""
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
    """The signal v, in blocks, behind a first-order lag with a time constant in steps, from rest."""
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
    """The blocks joined to one response; where two blocks meet without a jump, one of the two samples is left out."""
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

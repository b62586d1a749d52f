"""What PV and MV of a loop will do, by a model and the record so far: moves of the set-point are sized by it.

The model is driven by the MV of the record; what it leaves of PV at the end (load disturbances, drift) is taken to
stay. Then the loop is simulated sample by sample, several moves of the set-point side by side, with the controller's
law of the device: an error acts on the integral from the next sample on, MV ends at its limits and discharges the
integral by back-calculation (K. J. Astrom, T. Hagglund, PID Controllers, 1995, section 3.5).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from loopwright.tuning.analysis.exponential import exponentials
from loopwright.tuning.analysis.state_space import canonical_form
from loopwright.tuning.gains import Gains
from loopwright.tuning.models import Model, Reals, monic, sign

OFFSET_SAMPLES, OFFSET_OF_HORIZON = 3, 0.02
"""The deviation of PV from the model is the mean of this number of samples, or of this part of the horizon."""


@dataclass(frozen=True, slots=True, eq=False)
class Past:
    """The record so far, as deviations from rest.

    Ts: the sample time, s.
    sp, pv, mv: set-point, PV and MV at each sample, PV and MV units, shape (N,); MV is held from its sample on.
    low, high: the limits of MV, as deviations from rest, MV units.
    action: +1 for a controller whose MV falls as PV rises, else -1.
    gains: the gains in effect.
    sp_step_max: the largest move of the set-point within one sample, PV units.
    """

    Ts: float
    sp: Reals
    pv: Reals
    mv: Reals
    low: float
    high: float
    action: float
    gains: Gains
    sp_step_max: float = math.inf


@dataclass(frozen=True, slots=True, eq=False)
class Course:
    """The simulated course of PV (without noise) and of the MV that the controller asks for, before its limits, shape
    (samples, moves) each."""

    pv: Reals
    mv: Reals


class _Plant:
    """The model, sample by sample, with the exact hold and dead time; several inputs side by side."""

    def __init__(self, model: Model, Ts: float) -> None:
        space = canonical_form(*monic(model))
        order = len(space.b)
        L = model.L / Ts
        self.delay, part = int(L), L - int(L)
        block = np.zeros((order + 1, order + 1))
        block[:order, :order], block[:order, order] = space.a * Ts, space.b * Ts
        late, early = exponentials(np.array([block * (1.0 - part), block * part]))
        self.A = late[:order, :order] @ early[:order, :order]
        self.now, self.before = late[:order, order], late[:order, :order] @ early[:order, order]
        self.C, self.D = space.c, space.d

    def past(self, u: Reals) -> tuple[Reals, Reals]:
        """PV at each sample of the record, shape (N,), and the state at its last one."""
        m, x = self.delay, np.zeros(len(self.C))
        held = np.concatenate((np.zeros(m + 2), u))
        pv = np.empty(len(u))
        for k in range(len(u)):
            pv[k] = self.C @ x + self.D * held[k + 1]
            if k < len(u) - 1:
                x = self.A @ x + self.now * held[k + 2] + self.before * held[k + 1]
        return pv, x


class _Law:
    """The controller's law from the end of the record on, for several loops side by side."""

    def __init__(self, gains: Gains, past: Past, loops: int) -> None:
        Ts, g = past.Ts, gains
        self.gain, self.b, self.c = past.action * g.Kp, g.b, g.c
        self.per_sample = self.gain * Ts / g.Ti if g.Ti else 0.0
        tracking = math.sqrt(g.Ti * g.Td) if g.Td else g.Ti
        self.track = Ts / max(tracking, Ts) if g.Ti else 0.0
        self.decay, self.kick = g.Tf / (g.Tf + Ts), self.gain * g.Td / (g.Tf + Ts)
        self.low, self.high = past.low, past.high
        moved = self.c * past.sp - past.pv
        derivative = 0.0
        if self.kick and gains == past.gains:
            for change in np.diff(moved):
                derivative = self.decay * derivative + self.kick * change
        error = float(past.sp[-1] - past.pv[-1])
        # MV before its limits is not in the record: where the record ends at a limit, MV is taken to leave it at once
        integral = float(past.mv[-1]) - self.gain * float(self.b * past.sp[-1] - past.pv[-1]) - derivative
        self.integral = np.full(loops, integral + (self.per_sample * error if gains == past.gains else 0.0))
        self.derivative, self.last = np.full(loops, derivative), np.full(loops, moved[-1])

    def step(self, sp: Reals, pv: Reals) -> tuple[Reals, Reals]:
        """MV before and after its limits."""
        wanted = self.integral + self.gain * (self.b * sp - pv)
        if self.kick:
            moved = self.c * sp - pv
            self.derivative = self.decay * self.derivative + self.kick * (moved - self.last)
            self.last = moved
            wanted = wanted + self.derivative
        output = np.minimum(np.maximum(wanted, self.low), self.high)
        self.integral = self.integral + self.per_sample * (sp - pv) + self.track * (output - wanted)
        return wanted, output


@dataclass(frozen=True, slots=True, eq=False)
class SetpointTurn:
    """A turn of the set-point that follows when PV has gone far enough.

    at: the PV that has to be passed, as a deviation from rest, PV units, shape (moves,).
    up: whether PV has to rise above it; else it has to fall below.
    setpoints: the set-points after the turn, shape (moves,).
    """

    at: Reals
    up: bool
    setpoints: Reals


def forecast(
    model: Model, past: Past, gains: Gains, setpoints: Reals, samples: int, turn: SetpointTurn | None = None
) -> Course:
    """The course of the loop after the record, for several moves of the set-point.

    model: the process model, without the delay of the sampling.
    gains: the gains from the next sample on; other gains than those in effect take over without a bump.
    setpoints: the set-point from the next sample on, or where its ramp ends, as a deviation from rest, PV units, shape
    (moves,).
    samples: the number of samples to simulate.
    """
    plant, law, moves = _Plant(model, past.Ts), _Law(gains, past, len(setpoints)), len(setpoints)
    modelled, state = plant.past(past.mv)
    over = max(OFFSET_SAMPLES, int(OFFSET_OF_HORIZON * samples))
    offset = float(np.mean((past.pv - modelled)[-over:]))
    x = np.repeat(state[:, None], moves, axis=1)
    waiting = np.concatenate((np.zeros(plant.delay + 2), past.mv))[-plant.delay - 2 :]
    u = np.concatenate((np.repeat(waiting[:, None], moves, axis=1), np.zeros((samples, moves))))
    pv, mv = np.empty((samples, moves)), np.empty((samples, moves))
    sp = np.full(moves, past.sp[-1])
    for k in range(samples):
        x = plant.A @ x + plant.now[:, None] * u[k + 1] + plant.before[:, None] * u[k]
        pv[k] = plant.C @ x + plant.D * u[k + 1] + offset
        sp = sp + np.clip(setpoints - sp, -past.sp_step_max, past.sp_step_max)
        mv[k], u[k + plant.delay + 2] = law.step(sp, pv[k])
        if turn is not None:
            passed = pv[k] >= turn.at if turn.up else pv[k] <= turn.at
            setpoints = np.where(passed, turn.setpoints, setpoints)
    return Course(pv, mv)


def pv_of(model: Model, mv: Reals, Ts: float) -> Reals:
    """PV that MV makes by a model, from rest. mv: as a deviation from rest, shape (N,). Ts: the sample time, s."""
    return _Plant(model, Ts).past(mv)[0]


def oscillation(model: Model, Ts: float, high: float, low: float, samples: int) -> Reals:
    """MV of a relay without hysteresis, as a deviation from rest, shape (samples,); it begins with its higher side.

    high, low: the amplitudes of the two sides, MV units, both positive.
    """
    plant, rising = _Plant(model, Ts), sign(model) > 0.0
    x = np.zeros(len(plant.C))
    held = np.zeros(samples + plant.delay + 2)
    mv, side = np.empty(samples), True
    for k in range(samples):
        pv = float(plant.C @ x + plant.D * held[k + 1])
        if pv:
            side = (pv < 0.0) is rising
        mv[k] = held[k + plant.delay + 2] = high if side else -low
        x = plant.A @ x + plant.now * held[k + 2] + plant.before * held[k + 1]
    return mv

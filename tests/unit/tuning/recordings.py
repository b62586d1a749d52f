"""Recorded tests of simulated plants: the exact simulator and the controller of the devices, not the tuning library."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from loopwright.controller.channel import Channel, Mode, Parameters, RelaySettings, Settings
from loopwright.plantsim.plant import LinearPlant

Reals = NDArray[np.float64]
MV, PV, FIRST_MOVE = 30.0, 50.0, 50


@dataclass(frozen=True, slots=True)
class Loop:
    """num, den: of a plant without its dead time.  Kp, Ti: a PI with which its loop is quiet.  PV moves by about 1."""

    num: tuple[float, ...]
    den: tuple[float, ...]
    L: float
    Kp: float
    Ti: float

    def plant(self, Ts: float, noise: float, seed: int) -> LinearPlant:
        return LinearPlant(self.num, self.den, self.L, Ts, mv_nominal=MV, pv_nominal=PV, noise_std=noise, seed=seed)


@dataclass(frozen=True, slots=True)
class SampledPieces:
    """A record that a fit takes, with the scales that suit samples of 0.1 s of these plants."""

    u: Reals
    y: Reals
    block: int
    pieces: tuple[int, ...]
    u_earlier: tuple[Reals, ...] = ()
    Ts: float = 0.1
    input_range: float = 1.0
    output_range: float = 1.0
    period: float = 60.0
    max_dead_time: float = 60.0


FIRST_ORDER = Loop((2.0,), (10.0, 1.0), 2.03, 1.5, 8.0)
NEGATIVE = Loop((-1.5,), (8.0, 1.0), 2.0, 1.0, 8.0)
PROMPT = Loop((1.0,), (5.0, 1.0), 0.0, 1.0, 3.0)
TWO_LAGS = Loop((2.0,), (50.0, 15.0, 1.0), 1.04, 1.0, 12.0)
EQUAL_LAGS = Loop((2.0,), (25.0, 10.0, 1.0), 1.0, 0.7, 8.0)
COMPLEX_POLES = Loop((1.0,), (9.0, 1.8, 1.0), 1.77, 0.2, 3.0)
INTEGRATES = Loop((0.1,), (1.0, 0.0), 1.0, 3.0, 20.0)
INTEGRATES_WITH_LAG = Loop((0.1,), (3.0, 1.0, 0.0), 1.23, 1.5, 30.0)
INVERSE_RESPONSE = Loop((-2.0, 1.0), (20.0, 9.0, 1.0), 1.0, 0.5, 9.0)
FIVE_LAGS = Loop((1.0,), (1.0, 5.0, 10.0, 10.0, 5.0, 1.0), 0.0, 0.8, 4.0)


def step(samples: int = 600) -> Reals:
    return np.where(np.arange(samples) < FIRST_MOVE, 0.0, 1.0)


def moves(samples: int = 600, held: int = 30, seed: int = 1) -> Reals:
    """Up, down or back at random, at rest first."""
    levels = np.random.default_rng(seed).integers(-1, 2, samples // held + 1).astype(float)
    levels[:2] = 0.0, 1.0
    return np.repeat(levels, held)[:samples]


def open_loop(
    loop: Loop, change: Sequence[float] | Reals, Ts: float = 0.1, noise: float = 0.0, seed: int = 1
) -> tuple[Reals, Reals, Reals]:
    """(t, u, y) under these changes of MV."""
    plant = loop.plant(Ts, noise, seed)
    u = MV + np.asarray(change, dtype=float)
    y = np.array([plant.pv, *(plant.step(float(mv)) for mv in u[:-1])])
    return np.arange(len(u)) * Ts, u, y


def closed_loop(
    loop: Loop,
    relay: bool = False,
    samples: int = 600,
    Ts: float = 0.1,
    noise: float = 0.0,
    seed: int = 1,
    load: float = 0.0,
    load_at: int = 0,
) -> tuple[Reals, Reals, Reals]:
    """(t, u, y) of a set-point step of 1, or of a relay, after a time at rest. load: MV units, from that sample on."""
    plant = loop.plant(Ts, noise, seed)
    integrates = loop.den[-1] == 0.0
    reverse = loop.num[-1] * loop.den[-2 if integrates else -1] > 0.0
    channel = Channel(Ts, Settings(reverse=reverse), Parameters(loop.Kp, loop.Ti), PV, Mode.AUTOMATIC, MV)
    u, y = [], []
    pv = plant.pv
    for k in range(samples):
        if k == FIRST_MOVE and relay:
            channel.start_relay(RelaySettings(1.0, 0.02, MV, samples, 0.0, 100.0))
        elif k == FIRST_MOVE:
            channel.setpoint = PV + 1.0
        if load and k == load_at:
            plant.disturbance = load
        u.append(channel.step(pv))
        y.append(pv)
        pv = plant.step(u[-1])
    return np.arange(samples) * Ts, np.array(u), np.array(y)

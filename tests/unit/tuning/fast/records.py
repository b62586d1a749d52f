"""Fast records from the devices' own simulator and controller: rest, then a biased relay."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from loopwright.controller.channel import Channel, Mode, Parameters, RelaySettings, Settings
from loopwright.plantsim.plant import LinearPlant
from loopwright.tuning.analysis.margins import ultimate_point
from loopwright.tuning.fast.record import Excitation, ExperimentRecord, oscillation_period
from loopwright.tuning.models import TransferFunction, sign

LISTENED = 130


@dataclass(frozen=True, slots=True)
class Bench:
    """A plant and a sample time of about an eightieth of its ultimate period."""

    num: tuple[float, ...]
    den: tuple[float, ...]
    L: float
    Ts: float

    @property
    def model(self) -> TransferFunction:
        return TransferFunction(self.num, self.den, self.L)


FIRST = Bench((2.0,), (10.0, 1.0), 2.03, 0.1)
THREE_LAGS = Bench((1.0,), (2.0, 7.0, 7.0, 2.0), 0.53, 0.07)
FIVE_LAGS = Bench((1.0,), (1.0, 5.0, 10.0, 10.0, 5.0, 1.0), 0.0, 0.1)
INVERSE = Bench((-1.0, 1.0), (2.0, 3.0, 1.0), 0.5, 0.09)
INTEGRATES = Bench((0.3,), (2.0, 1.0, 0.0), 1.0, 0.12)
NEGATIVE = Bench((-1.5,), (8.0, 1.0), 2.0, 0.09)
BENCHES = {
    "first order": FIRST,
    "three lags": THREE_LAGS,
    "five lags": FIVE_LAGS,
    "inverse response": INVERSE,
    "integrates": INTEGRATES,
    "negative gain": NEGATIVE,
}


def record(
    bench: Bench,
    noise: float = 0.0,
    switches: int = 6,
    seed: int = 1,
    load: float = 0.0,
    load_at: int = 0,
    drift: float = 0.0,
    below: float = 1.0,
) -> ExperimentRecord:
    """Amplitudes +1, -1/2. noise: PV units.  load: MV units, from the sample load_at on.  drift: of PV, per sample.

    below: the plant's gain below rest, as a part of that above.
    """
    plant = LinearPlant(bench.num, bench.den, bench.L, bench.Ts, noise_std=noise, seed=seed)
    channel = Channel(
        bench.Ts, Settings(-5.0, 5.0, 0.0, reverse=sign(bench.model) > 0.0), Parameters(1.0), 0.0, Mode.MANUAL
    )
    u: list[float] = []
    y: list[float] = []
    switched: list[int] = []
    while len(switched) < switches and len(u) < 5000:
        k = len(u)
        if k == LISTENED:
            channel.start_relay(RelaySettings(1.0, 2.2 * noise, 0.0, 10_000, -1e9, 1e9, 0.5, 3 if noise else 1))
        if load and k == load_at:
            plant.disturbance = load
        y.append(plant.pv + drift * k)
        u.append(channel.step(y[-1]))
        if k > LISTENED and u[-1] != u[-2]:
            switched.append(k)
        plant.step(u[-1] if u[-1] > 0.0 else below * u[-1])
    return ExperimentRecord(
        bench.Ts, np.array(u), np.array(y), sign(bench.model), LISTENED, len(u), len(switched),
        oscillation_period(switched),
    )  # fmt: skip


def pulse_record(
    bench: Bench,
    Kp: float,
    Ti: float,
    noise: float,
    below: float = 1.0,
    seed: int = 1,
    end: float = 1.0,
    share: float = 0.0,
    later: float = 0.0,
    load: float = 0.0,
    periods: float = 3.0,
    load_lasts: float = math.inf,
    changed: float = 1.0,
    cubic: float = 0.0,
) -> ExperimentRecord:
    """Pulses of the set-point by 1 up, down and up, turned after 0.7 and 1.7 ultimate periods, over three periods.

    below: the plant's gain below rest, as a part of that above.  end: the gain at the end over that at rest.
    share, later: a second path, a part of the first one, ultimate periods later.  load: MV units, 1.3 periods
    before the end, for so many periods.  periods: the length of the test.  changed: the gain from the last turn on,
    which is the record's step, over that before.  cubic: MV moves the plant as MV (1 + cubic MV^2) would.
    """
    plant = LinearPlant(bench.num, bench.den, bench.L, bench.Ts, noise_std=noise, seed=seed)
    channel = Channel(bench.Ts, Settings(-50.0, 50.0, 0.0), Parameters(Kp, Ti), 0.0, Mode.AUTOMATIC)
    period = ultimate_point(bench.model)[1] / bench.Ts
    u, y = [], []
    samples, step = LISTENED + round(periods * period), LISTENED + math.ceil(1.7 * period)
    for k in range(samples):
        channel.setpoint = 0.0 if k < LISTENED else -1.0 if 0.7 < (k - LISTENED) / period < 1.7 else 1.0
        since = (k - samples) / period + 1.3
        plant.disturbance = load if 0.0 <= since < load_lasts else 0.0
        y.append(plant.pv)
        u.append(channel.step(y[-1]))
        gain = 1.0 + (end - 1.0) * max(k - LISTENED, 0) / (samples - LISTENED)
        gain *= changed if k >= step else 1.0
        moved = (u[-1] if u[-1] > 0.0 else below * u[-1]) * (1.0 + cubic * u[-1] ** 2)
        before = k - round(later * period)
        plant.step(gain * moved + (share * u[before] if share and before >= 0 else 0.0))
    at, pv = np.array(u), np.array(y)
    rest = slice(LISTENED)
    return ExperimentRecord(
        bench.Ts, at - at[rest].mean(), pv - pv[rest].mean(), 1.0, LISTENED, len(u), 2,
        period, (step,) if changed != 1.0 else (), Excitation.SETPOINT,
    )  # fmt: skip

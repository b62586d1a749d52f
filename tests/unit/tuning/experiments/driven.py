"""Our own controller in a loop, with everything that may come between its law and the record of it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from loopwright.controller.channel import Channel, RelaySettings, Settings
from loopwright.controller.pid import Parameters
from loopwright.plantsim.plant import LinearPlant
from loopwright.protocol.real32 import nearest, shortest
from loopwright.tuning.experiments.control_law import ControlLaw
from loopwright.tuning.experiments.control_record import ControlPiece, ControlRecord, control_record
from loopwright.tuning.experiments.primitives import Facts, Trace
from loopwright.tuning.gains import Gains
from loopwright.tuning.plan import Mode, Sample

TS = 0.1
REST = 50.0
"""MV at which PV is 0."""


@dataclass(frozen=True, slots=True)
class Drive:
    """How a loop is driven.

    said, tried: the gains, and those that take over after two thirds; None where none do.
    noise, quantum: of PV. low, high, rate: limits of MV, and of its rate per s; 0 for none.
    step, ramp: of the set-point, PV units, and PV units per s.
    lost: part of the samples that do not arrive. frozen: PV stands still for a tenth of the time.
    relay: a relay runs for a sixth of the time. reverse: the action.
    """

    said: Gains
    tried: Gains | None = None
    noise: float = 0.01
    quantum: float = 0.0
    low: float = 0.0
    high: float = 100.0
    rate: float = 0.0
    step: float = 1.0
    ramp: float = 0.0
    lost: float = 0.0
    frozen: bool = False
    relay: bool = False
    reverse: bool = True
    samples: int = 600
    seed: int = 1

    def facts(self) -> Facts:
        return Facts(TS, 20.0, self.low, self.high, 1.0, self.said, self.reverse)


def driven(drive: Drive) -> ControlRecord:
    """What the record of such a loop shows of its controller; all values are those of a bus."""
    random = np.random.default_rng(drive.seed)
    sign = 1.0 if drive.reverse else -1.0
    plant = LinearPlant([sign], [5.0, 1.0], 1.0, TS, noise_std=drive.noise, seed=drive.seed)
    settings = Settings(
        drive.low, drive.high, rate_limit_per_s=drive.rate, pv_low=-1e6, pv_high=1e6, reverse=drive.reverse
    )
    channel = Channel(TS, settings, _parameters(drive.said), 0.0, Mode.AUTOMATIC, REST)
    trace, lost_before = Trace(), 0
    pv = plant.pv
    changes = _changes(drive.samples, random)
    trial = 2 * drive.samples // 3
    held, begun, target = 0.0, drive.samples, 0.0
    for k in range(drive.samples):
        if drive.relay and k == drive.samples // 3:
            channel.start_relay(RelaySettings(3.0, 0.05, channel.mv, 10**6, -1e9, 1e9))
        if drive.relay and k == drive.samples // 2:
            channel.command_mode(Mode.AUTOMATIC)
        if drive.tried is not None and k == trial:
            channel.try_gains(_parameters(drive.tried))
            begun = len(trace)
        if k in changes or k == trial:
            target = nearest(float(random.uniform(-1.0, 1.0)) * drive.step)
        move = target - channel.setpoint
        channel.setpoint += math.copysign(min(abs(move), drive.ramp * TS), move) if drive.ramp else move
        frozen = drive.frozen and 0.4 < k / drive.samples < 0.5
        held = held if frozen else pv
        seen = nearest(round(held / drive.quantum) * drive.quantum if drive.quantum else held)
        mv = channel.step(seen)
        sp = nearest(channel.setpoint)
        channel.setpoint = sp
        if random.random() >= drive.lost or k in (0, trial):
            sample = Sample(k * TS, shortest(sp), seen, nearest(mv), channel.mode)
            for j in range(lost_before):
                trace.filled.append(len(trace))
                before = k - lost_before + j
                trace.add(sample._replace(t=before * TS, pv=0.5 * (seen + trace.pv[-1]), mv=trace.mv[-1]))
            lost_before = 0
            trace.add(sample)
        else:
            lost_before += 1
        pv = plant.step(nearest(mv) - REST)
    old: Sequence[tuple[int, int, Gains]] = [(0, begun, drive.said)]
    new = [(begun, len(trace), drive.tried)] if drive.tried is not None else []
    return control_record(drive.facts(), trace, [*old, *new] if new else [(0, len(trace), drive.said)])


def random_drive(seed: int) -> Drive:
    """A drive in which each thing that may happen does so now and then."""
    random = np.random.default_rng([seed, 7])

    def now_and_then() -> bool:
        return bool(random.random() < 0.3)

    gains = [_gains(random) for _ in range(2)]
    drive = Drive(
        said=gains[0],
        tried=gains[1] if random.random() < 0.5 else None,
        noise=float(random.choice([0.0, 0.005, 0.02])),
        quantum=float(random.choice([0.0, 0.0, 0.05, 0.1])),
        rate=float(random.uniform(1.0, 30.0)) if now_and_then() else 0.0,
        step=float(random.choice([0.0, 1.0, 5.0])),
        ramp=float(random.uniform(0.02, 1.0)) if now_and_then() else 0.0,
        lost=0.03 if now_and_then() else 0.0,
        frozen=now_and_then(),
        relay=now_and_then(),
        reverse=not now_and_then(),
        samples=int(random.integers(200, 1500)),
        seed=seed,
    )
    return replace(drive, low=47.0, high=53.0) if now_and_then() else drive


def _gains(random: np.random.Generator) -> Gains:
    Td = nearest(float(random.uniform(0.1, 0.8))) if random.random() < 0.4 else 0.0
    Tf = nearest(Td / 10.0) if random.random() < 0.8 else 0.0
    weights = [nearest(float(random.choice([0.0, 0.5, 1.0]))) for _ in range(2)]
    return Gains(nearest(float(random.uniform(0.3, 4.0))), nearest(float(random.uniform(2.0, 20.0))), Td, Tf, *weights)


def _changes(samples: int, random: np.random.Generator) -> set[int]:
    return set(random.integers(samples // 6, samples, size=5).tolist())


def _parameters(gains: Gains) -> Parameters:
    return Parameters(gains.Kp, gains.Ti, gains.Td, gains.Tf, gains.b, gains.c)


def recorded(
    gains: Gains, law: ControlLaw, rest: bool = False, noise: float = 0.01, mv_step: float = 0.0
) -> ControlRecord:
    """A closed loop around a lag of 5 s, sample by sample, with a law in place of the said one."""
    random, n = np.random.default_rng(3), 400
    sp = np.zeros(n) if rest else np.repeat([0.0, 1.0, -1.0, 1.0], n // 4)
    pv, mv = np.zeros(n), np.zeros(n)
    x, seen, line = 0.0, 0.0, [0.0] * 10
    integral = d = last = 0.0
    said, lag = law.gains, law.filter_s
    for k in range(n):
        pv[k] = x + noise * random.standard_normal()
        seen += (pv[k] - seen) * TS / (lag + TS)
        moved = said.c * sp[k] - seen
        d = (said.Tf * d + said.Kp * said.Td * (moved - last)) / (said.Tf + TS) if said.Td else 0.0
        last = moved
        u = said.Kp * (said.b * sp[k] - seen) + integral + d
        integral += said.Kp * TS / said.Ti * (sp[k] - seen)
        mv[k] = round(u / mv_step) * mv_step if mv_step else u
        line.append(mv[k])
        x += (line.pop(0) - x) * TS / 5.0
    return ControlRecord(TS, True, (ControlPiece(gains, sp[40:], pv[40:], mv[40:]),))

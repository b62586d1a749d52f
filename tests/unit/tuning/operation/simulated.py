"""Operation of a loop in simulated time, as a stretch."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from loopwright.controller.channel import Channel, Settings
from loopwright.controller.pid import Parameters
from loopwright.plantsim.plant import LinearPlant, TwoPaths
from loopwright.tuning.gains import Gains
from loopwright.tuning.models import TransferFunction
from loopwright.tuning.operation.accepted_model import AcceptedModel
from loopwright.tuning.operation.history import Stretch
from loopwright.tuning.plan import Mode

PLANT = TransferFunction((2.0,), (3.0, 4.0, 1.0), 1.0)
GAINS = Gains(0.53, 4.0)
"""Of Ms 1.6 on the plant."""
PU, TS = 5.92, 0.1
MODEL = AcceptedModel(PLANT, GAINS, PU, 0.5 * TS)


def periods(count: float) -> int:
    """The samples of so many ultimate periods."""
    return round(count * PU / TS)


def operated(
    moves: Mapping[int, float],
    samples: int,
    *,
    share: float = 0.0,
    later_s: float = 0.0,
    gain: Callable[[int], float] = lambda n: 1.0,
    dead_time_s: float = 0.0,
    load: Callable[[int], float] = lambda n: 0.0,
    noise: float = 0.01,
    seed: int = 1,
) -> Stretch:
    """The operation. moves: changes of the set-point, by sample. share, later_s: of a second path."""
    longer = PLANT.L + dead_time_s
    first = LinearPlant(PLANT.num, PLANT.den, longer, TS, noise_std=noise, seed=seed)
    second = LinearPlant([share * each for each in PLANT.num], PLANT.den, longer + later_s, TS)
    plant = TwoPaths(first, second)
    settings = Settings(mv_low=-1e3, mv_high=1e3, pv_low=-1e3, pv_high=1e3)
    channel = Channel(TS, settings, Parameters(GAINS.Kp, GAINS.Ti), 0.0, int(Mode.AUTOMATIC), 0.0)
    rows, pv = [], plant.pv
    for n in range(samples):
        channel.setpoint += moves.get(n, 0.0)
        mv = channel.step(pv)
        rows.append((mv, pv, channel.setpoint))
        pv = plant.step(gain(n) * (mv + load(n)))
    columns = np.array(rows).T
    return Stretch(0.0, TS, columns[0], columns[1], columns[2], GAINS)

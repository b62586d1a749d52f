"""A loop that is operated: a plant of plantsim under a controller, as the listener hears it."""

from __future__ import annotations

import random
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

from loopwright.controller.channel import Channel, Settings
from loopwright.controller.pid import Parameters
from loopwright.plantsim.plant import LinearPlant
from loopwright.service.listening.bins import GAP_BEFORE
from loopwright.service.listening.heard_loop import Heard
from loopwright.service.listening.listening import History
from loopwright.service.listening.rings import Rings
from loopwright.tuning.gains import Gains
from loopwright.tuning.models import TransferFunction
from loopwright.tuning.plan import Mode

SP = 50.0


@dataclass(frozen=True)
class Operated:
    """A plant with this dead time, two lags of 4 and 2 of these, and a gain of 1; its PI. Times in s."""

    L: float = 1.0
    Ts: float = 0.1
    gains: Gains = field(default_factory=lambda: Gains(1.5, 6.0))

    @property
    def plant(self) -> TransferFunction:
        """The plant as a sampled controller meets it."""
        return TransferFunction((1.0,), (8.0 * self.L**2, 6.0 * self.L, 1.0), self.L + 0.5 * self.Ts)

    def heard(
        self,
        moves: Mapping[int, float],
        samples: int,
        end_s: float,
        noise: float = 0.01,
        load: Callable[[int], float] = lambda n: 0.0,
        unknown: range = range(0),
        mode: Callable[[int], int] = lambda n: int(Mode.AUTOMATIC),
        lost: range = range(0),
        jitter_s: float = 0.0,
    ) -> Rings:
        """What the listener has after so many samples, the last of them at `end_s`.

        moves: changes of the set-point, by sample.  unknown: samples whose gains are not known.  lost: samples that
        are not heard.
        """
        process = LinearPlant((1.0,), (8.0 * self.L**2, 6.0 * self.L, 1.0), self.L, self.Ts, noise_std=noise, seed=1)
        channel = Channel(self.Ts, Settings(), Parameters(self.gains.Kp, self.gains.Ti), SP, int(Mode.AUTOMATIC), 50.0)
        rings, drawn, gap = Rings(), random.Random(1), GAP_BEFORE
        known = rings.number_of((self.gains.Kp, self.gains.Ti, 0.0, 0.0, 1.0, 0.0))
        pv = SP + process.pv
        for n in range(samples):
            channel.setpoint += moves.get(n, 0.0)
            mv = channel.step(pv)
            at_s = end_s - (samples - 1 - n) * self.Ts + drawn.uniform(0.0, jitter_s)
            if n not in lost:
                rings.put(at_s, n + 1, pv, mv, channel.setpoint, 0 if n in unknown else known, mode(n), gap)
            gap = GAP_BEFORE if n in lost else 0
            pv = SP + process.step(mv - 50.0 + load(n))
        return rings


class HeardBefore:
    """A listening that has heard this, and nothing of any other loop; of present values it has none."""

    def __init__(self, rings: Rings, no_data: str | None = None) -> None:
        self._rings, self._not_heard = rings, no_data
        self.heard: dict[str, Heard] = {}

    def why_not_heard(self, tag: str) -> str | None:
        return self._not_heard

    def history(self, tag: str, from_s: float, to_s: float, points: int) -> History:
        return History(self._rings.rows(from_s, to_s, points), self._not_heard)

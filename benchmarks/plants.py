"""The plants that are tuned: 70 of the Astrom-Hagglund batch, the 50 models, the linearised reactor."""

from __future__ import annotations

import json
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.signal import ss2tf

from loopwright.plantsim import reactor
from loopwright.tuning.analysis.margins import ultimate_point
from loopwright.tuning.models import TransferFunction

SAMPLES_PER_PERIOD = 80
REACTOR = "reactor"


@dataclass(frozen=True, slots=True)
class Plant:
    name: str
    num: tuple[float, ...]
    den: tuple[float, ...]
    L: float
    Ku: float
    Pu: float
    samples: int = SAMPLES_PER_PERIOD

    @property
    def Ts(self) -> float:
        return self.Pu / self.samples

    def model(self) -> TransferFunction:
        """With the sampled controller's half sample."""
        return TransferFunction(self.num, self.den, self.L + 0.5 * self.Ts)


def plants() -> list[Plant]:
    batch = json.loads((Path(__file__).parent.parent / "tests/data/plants-batch.json").read_text())["processes"]
    found = [Plant(p["id"], tuple(p["num"]), tuple(p["den"]), p["delay"], p["Ku"], p["Tu"]) for p in batch]
    for m in json.loads((files("loopwright.plantsim") / "models-50.json").read_text())["models"]:
        found.append(plant_of(f"model-{m['id']}", TransferFunction(tuple(m["num"]), tuple(m["den"]), m["delay"])))
    found.append(plant_of(REACTOR, linear_reactor()))
    return found


def plant_of(name: str, model: TransferFunction) -> Plant:
    Ku, Pu = ultimate_point(model)
    return Plant(name, model.num, model.den, model.L, Ku, Pu)


def linear_reactor() -> TransferFunction:
    """The reactor around its steady state, by central differences; its actuator and sensor with it."""
    at = np.array([*reactor.STEADY_STATE, reactor.MV_NOMINAL])

    def slope(x: NDArray[np.float64]) -> NDArray[np.float64]:
        a, b, c, h, T, opening = map(float, x)
        return np.array(reactor.derivative((a, b, c, h, T), opening, reactor.INLET))

    moves = np.diag(1e-5 * at)
    jacobian = np.array([(slope(at + m) - slope(at - m)) / (2.0 * m.sum()) for m in moves]).T
    num, den = ss2tf(jacobian[:, :5], jacobian[:, 5:], np.eye(5)[2:3], np.zeros((1, 1)))
    lagged = np.convolve(den, (reactor.ACTUATOR_LAG_S, 1.0))
    return TransferFunction(tuple(num[0][1:]), tuple(lagged), reactor.SENSOR_DELAY_S)

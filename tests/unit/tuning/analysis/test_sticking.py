"""A loop that cycles by its sticking valve, simulated with a PI and a plant of its own, sample by sample."""

import numpy as np
import pytest

from loopwright.tuning.analysis.sticking import Sticking, find_sticking

TS = 0.25


def cycle(stiction: float, load: float = 0.0, samples: int = 2000) -> Sticking | None:
    """What is found in a flow loop under PI with such a valve, and a load that swings."""
    random, K, T, Kp, Ti = np.random.default_rng(5), 1.0, 3.0, 0.4, 4.0
    flow, at, integral, kept = 0.0, 0.0, 0.0, np.empty((samples, 2))
    line = [0.0] * 4
    for k in range(samples):
        pv = flow + 0.05 * random.standard_normal()
        integral += Kp * (0.7 - pv) * TS / Ti
        mv = Kp * (0.7 - pv) + integral
        at = mv if abs(mv - at) > stiction else at
        line.append(at + load * np.sin(2.0 * np.pi * k * TS / 60.0))
        flow += (K * line.pop(0) - flow) * -np.expm1(-TS / T)
        kept[k] = mv, pv
    half = samples // 2
    return find_sticking(TS, *kept[half:].T)


@pytest.mark.parametrize("size", [1.0, 1.7])
def test_the_size_of_the_stiction_is_found(size: float) -> None:
    found = cycle(size)
    assert found is not None and found.size == pytest.approx(size, rel=0.2)


@pytest.mark.parametrize("load", [0.0, 2.0])
def test_a_sound_valve_does_not_stick(load: float) -> None:
    assert cycle(0.0, load) is None

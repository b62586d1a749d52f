"""The first guesses of the time of a load disturbance, of many models and times at once, against one fit each."""

from __future__ import annotations

import numpy as np
import pytest

from loopwright.tuning.identification.disturbances import rss_by_load_time
from loopwright.tuning.identification.output_error import DisturbanceHypothesis, Fit
from loopwright.tuning.identification.structures import FIRST, SECOND, Structure
from tests.unit.tuning.recordings import COMPLEX_POLES, PV, SampledPieces, moves, open_loop


@pytest.mark.parametrize("pieces", [(300,), (120, 180), (150, 2, 148)], ids=str)
@pytest.mark.parametrize("block", [1, 3])
@pytest.mark.parametrize("structure", [FIRST, SECOND], ids=lambda s: s.name)
@pytest.mark.parametrize("loads", [0, 1])
def test_every_time_leaves_what_a_fit_with_a_load_at_that_time_leaves(
    structure: Structure, block: int, pieces: tuple[int, ...], loads: int
) -> None:
    u = moves(300)
    fit = Fit(SampledPieces(u, open_loop(COMPLEX_POLES, u, noise=0.05)[2] - PV, block, pieces))
    rates = [[-2.0], [-3.5]] if structure is FIRST else [[-1.5, -4.0], [-0.5, -3.0]]
    thetas = np.array([[*each, L, *[45.0] * loads] for each, L in zip(rates, (6.0, 11.4), strict=True)])
    shifts = np.arange(0, fit.samples - 12, 7)
    found = rss_by_load_time(fit, structure, thetas, shifts)
    hypothesis = DisturbanceHypothesis(loads + 1)
    for theta, rss in zip(thetas, found, strict=True):
        one_by_one = [fit.fitted(structure, hypothesis, np.append(theta, m * block)).linear.rss for m in shifts]
        assert rss == pytest.approx(one_by_one, rel=1e-5)

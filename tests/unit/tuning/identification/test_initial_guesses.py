from __future__ import annotations

import numpy as np
import pytest

from loopwright.tuning.identification.initial_guesses import starts
from loopwright.tuning.identification.output_error import NOT_AT_REST_INITIALLY, UNDISTURBED
from loopwright.tuning.identification.problem import IdentificationProblem
from loopwright.tuning.identification.record import recorded_test
from loopwright.tuning.identification.structures import FIRST, SECOND, SECOND_WITH_ZERO, Structure
from tests.unit.tuning.recordings import COMPLEX_POLES, FIRST_ORDER, INVERSE_RESPONSE, Loop, moves, open_loop


@pytest.mark.parametrize("nuisance", [False, True])
@pytest.mark.parametrize(
    ("structure", "loop"),
    [(FIRST, FIRST_ORDER), (SECOND, COMPLEX_POLES), (SECOND_WITH_ZERO, INVERSE_RESPONSE)],
    ids=lambda p: p.name if isinstance(p, Structure) else "",
)
def test_the_dead_time_is_the_best_of_all_tried_one_by_one(structure: Structure, loop: Loop, nuisance: bool) -> None:
    change = moves(300)
    t, u, y = open_loop(loop, change, noise=0.05)
    fit = IdentificationProblem(recorded_test(t, u, y)).full_fit
    best = starts(structure, change, y, 60, nuisance, 1)[0]
    hypothesis = NOT_AT_REST_INITIALLY if nuisance else UNDISTURBED
    plain = [fit.fitted(structure, hypothesis, np.append(best[:-1], float(m))).linear.rss for m in range(61)]
    assert best[-1] == int(np.argmin(plain))


def test_starts_differ() -> None:
    found = starts(SECOND, moves(300), open_loop(COMPLEX_POLES, moves(300))[2], 60, False, 3)
    assert len(found) == 3
    for i in range(3):
        for j in range(i):
            assert np.abs(found[i] - found[j]).max() > 0.1

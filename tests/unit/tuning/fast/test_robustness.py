"""Ms of any gains on the model of a record, beside that on the true plant."""

from __future__ import annotations

from dataclasses import replace

import pytest

from loopwright.tuning.analysis.margins import margins
from loopwright.tuning.fast.design.design import DesignSpec
from loopwright.tuning.fast.evaluation.evaluation import Evaluation, evaluate
from loopwright.tuning.fast.evaluation.robustness import KnownMs, known_Ms
from loopwright.tuning.gains import Gains
from loopwright.tuning.models import TransferFunction
from tests.unit.tuning.fast.records import FIRST, record

PLANT = TransferFunction(FIRST.num, FIRST.den, FIRST.L + 0.5 * FIRST.Ts)


@pytest.fixture(scope="module")
def evaluation() -> Evaluation:
    return evaluate(record(FIRST, 0.01 * record(FIRST).output_range), DesignSpec(1.6))


@pytest.mark.parametrize(
    "gains", [Gains(0.3, 10.0), Gains(1.8, 6.0), Gains(2.0), Gains(1.5, 8.0, 0.8, 0.1)], ids=["PI", "hot", "P", "PID"]
)
def test_the_true_Ms_is_within_the_uncertainty(evaluation: Evaluation, gains: Gains) -> None:
    found = known_Ms(evaluation, gains)
    assert found.Ms is not None and found.uncertainty is not None and 0.0 < found.uncertainty < 0.3
    true = margins(PLANT, gains)
    assert true.stable and abs(found.Ms - true.Ms) < found.uncertainty + 0.01


def test_of_an_unstable_loop_and_of_gains_that_the_analysis_does_not_take_nothing_is_known(
    evaluation: Evaluation,
) -> None:
    assert not margins(PLANT, Gains(9.0, 5.0)).stable
    assert known_Ms(evaluation, Gains(9.0, 5.0)) == KnownMs(None, None)
    biproper = replace(evaluation, model=TransferFunction((1.0, 1.0), (2.0, 1.0), 1.0))
    assert known_Ms(biproper, Gains(0.3, 10.0, 1.0)) == KnownMs(None, None), "an ideal derivative"

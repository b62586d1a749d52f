from __future__ import annotations

import numpy as np
import pytest

from loopwright.tuning.gains import Gains
from loopwright.tuning.operation.history import Stretch, parts_at_rest, require_operator, setpoint_changes
from loopwright.tuning.reasons import Reason, Refused


def stretch(sp: list[float]) -> Stretch:
    column = np.array(sp)
    return Stretch(100.0, 0.5, np.zeros(len(sp)), column.copy(), column, Gains(1.0, 10.0))


def test_a_change_is_looked_at_from_before_its_move_to_some_time_after() -> None:
    (change,) = setpoint_changes(stretch([5.0] * 20 + [7.0] * 50), before=8, after=40, smallest=1.0)
    assert (change.first, change.move, change.end) == (12, 20, 60)
    assert change.size == 2.0
    assert change.t_s == 110.0


def test_moves_soon_after_each_other_are_one_change_and_of_overlapping_ones_the_first_is_taken() -> None:
    sp = [0.0] * 20 + [1.0] * 10 + [-1.0] * 30 + [0.0] * 60
    first, second = setpoint_changes(stretch(sp), before=8, after=35, smallest=0.5)
    assert (first.first, first.move, first.end) == (12, 20, 55)
    assert first.size == 1.0
    assert (second.first, second.move, second.end) == (55, 60, 95)


@pytest.mark.parametrize(
    "sp",
    [
        pytest.param([0.0] * 30, id="no move"),
        pytest.param([0.0] * 3 + [1.0] * 60, id="too soon after the beginning"),
        pytest.param([0.0] * 20 + [1.0] * 30, id="not followed to the end"),
        pytest.param([0.0] * 20 + [0.2] * 60, id="too small"),
    ],
)
def test_what_is_not_looked_at(sp: list[float]) -> None:
    assert setpoint_changes(stretch(sp), before=8, after=40, smallest=0.5) == []


def test_parts_at_rest_begin_some_time_after_a_move_and_end_before_the_next() -> None:
    sp = [0.0] * 25 + [1.0] * 40 + [2.0] * 15
    assert parts_at_rest(stretch(sp), length=10, after=12) == [
        slice(0, 10),
        slice(10, 20),
        slice(37, 47),
        slice(47, 57),
    ]


def test_a_set_point_that_moves_all_the_time_is_another_controllers() -> None:
    driven = [float(k // 2) for k in range(400)]
    with pytest.raises(Refused, match="199 of 400 samples") as refused:
        require_operator([stretch(driven)])
    assert refused.value.reason is Reason.SETPOINT_IS_DRIVEN
    require_operator([stretch([0.0] * 200 + [1.0] * 200)])

"""A historian's file of a loop in operation: what it proposes, and the files that do not show the loop itself."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from loopwright.service.observing.exported import exported
from loopwright.service.observing.observed import ObservationState
from loopwright.service.offline.csv_record.record import Record
from loopwright.tuning.analysis.margins import margins
from loopwright.tuning.gains import Gains
from loopwright.tuning.models import FOPDT, TransferFunction
from loopwright.tuning.operation.export import action_of, require_raw
from loopwright.tuning.operation.history import Stretch
from loopwright.tuning.reasons import Reason, Refused
from tests.rehearsal.test_observe import ASKED, LAG, PI, TS, changes, operated

SP = changes([0.8, -0.3, 0.6], 200.0)
HEARD = operated(LAG, PI, SP)
DIRECT = operated(replace(LAG, K=-LAG.K), PI, SP)


def record(of: Stretch) -> Record:
    return Record(TS * np.arange(len(of.sp)), of.mv, of.pv, of.sp)


def refusal(stretch: Stretch) -> str:
    with pytest.raises(Refused) as refused:
        require_raw(stretch)
        action_of(stretch)
    assert refused.value.reason is Reason.BAD_INPUT
    return refused.value.detail


@pytest.mark.parametrize(("heard", "reverse", "K"), [(HEARD, True, LAG.K), (DIRECT, False, -LAG.K)])
def test_a_file_of_raw_values_gives_the_gains_asked_for(heard: Stretch, reverse: bool, K: float) -> None:
    found = exported(record(heard), PI, ASKED)
    assert found.state is ObservationState.PROPOSAL, found.detail
    assert found.reverse_acting is reverse
    assert found.proposed is not None
    assert found.model is not None
    assert found.model.num[-1] / found.model.den[-1] == pytest.approx(K, rel=0.05)
    assert [each.t_s for each in found.changes_used] == pytest.approx([200.0, 400.0, 600.0])
    proposed = Gains(found.proposed.gains.Kp, found.proposed.gains.Ti)
    true = TransferFunction(LAG.num, LAG.den, LAG.L + 0.5 * TS)
    assert margins(true, proposed).Ms == pytest.approx(1.6, abs=0.05)


def test_rounded_values_are_no_straight_lines() -> None:
    rounded = replace(HEARD, mv=np.round(HEARD.mv, 2), pv=np.round(HEARD.pv, 2))
    require_raw(rounded)
    assert action_of(rounded)


@pytest.mark.parametrize("every", [4, 10])
def test_interpolated_values_are_refused(every: int) -> None:
    k = np.arange(len(SP))
    kept = k[::every]
    lines = replace(HEARD, mv=np.interp(k, kept, HEARD.mv[kept]), pv=np.interp(k, kept, HEARD.pv[kept]))
    assert "goes on in a straight line" in refusal(lines)
    in_pv = replace(HEARD, pv=np.round(lines.pv, 4))
    assert "PV goes on in a straight line" in refusal(in_pv)


def test_values_that_are_stored_by_exception_are_refused() -> None:
    mv, pv = HEARD.mv.copy(), HEARD.pv.copy()
    for column, band in ((mv, 0.05), (pv, 0.05)):
        for k in range(1, len(column)):
            if abs(column[k] - column[k - 1]) < band:
                column[k] = column[k - 1]
    assert "OP repeats its value" in refusal(replace(HEARD, mv=mv, pv=pv))


@pytest.mark.parametrize(("late", "said"), [(2, "2 sample(s) after"), (-1, "1 sample(s) before")])
def test_a_column_that_is_late_is_named(late: int, said: str) -> None:
    assert said in refusal(replace(HEARD, mv=np.roll(HEARD.mv, late)))


@pytest.mark.parametrize(
    ("gains", "said"),
    [(Gains(2.0, 9.0), "0.5 times as far"), (Gains(1.0, 0.2), "does not follow")],
)
def test_gains_that_are_not_those_in_effect_are_noticed(gains: Gains, said: str) -> None:
    assert said in refusal(replace(HEARD, gains=gains))


def test_a_file_without_set_point_or_with_few_samples_is_refused() -> None:
    with pytest.raises(Refused, match="no column of SP"):
        exported(replace(record(HEARD), sp=None), PI, ASKED)
    short = Record(*(column[:50] for column in (TS * np.arange(len(SP)), HEARD.mv, HEARD.pv, HEARD.sp)))
    with pytest.raises(Refused, match="at least 100"):
        exported(short, PI, ASKED)


def test_a_slow_plant_logged_while_it_rests_is_no_line() -> None:
    rest = operated(FOPDT(1.0, 50.0, 5.0), PI, np.zeros(400), noise=0.0)
    assert "repeats its value" in refusal(rest)

"""Which samples the law alone gave."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from loopwright.tuning.experiments.control_record import MIN_SAMPLES, control_record, rows_without_limit
from loopwright.tuning.experiments.primitives import Facts, Trace
from loopwright.tuning.gains import Gains
from loopwright.tuning.plan import Mode, Sample
from tests.unit.tuning.experiments.driven import TS, Drive, driven

OLD, NEW = Gains(1.0, 5.0), Gains(2.0, 5.0)
FACTS = Facts(TS, 20.0, 0.0, 100.0, 1.0, OLD)
N = 100


def trace(**columns: list[float]) -> Trace:
    """Samples whose MV nowhere comes twice; its fastest move is to sample 1."""
    mv = [50.0 + 0.01 * k**1.1 for k in range(N)]
    mv[0] = 49.0
    found = Trace()
    for k in range(N):
        at = {name: column[k] for name, column in columns.items()}
        found.add(Sample(k * TS, 0.0, 0.1 * k, mv[k], Mode.AUTOMATIC)._replace(**at))
    return found


def lengths(found: Trace, *gains: tuple[int, int, Gains]) -> list[int]:
    return [len(each.mv) for each in control_record(FACTS, found, gains or [(0, len(found), OLD)]).pieces]


def test_all_but_the_start_of_an_undisturbed_record() -> None:
    assert lengths(trace()) == [N - 2], "the first sample follows none, and the second may be limited in its rate"


def test_a_sample_that_is_missing_ends_a_piece() -> None:
    found = trace()
    for column in (found.t, found.sp, found.pv, found.mv, found.mode):
        del column[40]
    assert lengths(found) == [38, N - 42], "the one after a gap is left out"


def test_what_was_filled_in_is_left_out_with_the_sample_after_it() -> None:
    found = trace()
    found.filled = [40, 41]
    assert lengths(found) == [38, N - 43]


def test_another_mode_is_left_out() -> None:
    modes = [float(Mode.EXPERIMENT if 30 <= k < 50 else Mode.AUTOMATIC) for k in range(N)]
    assert lengths(trace(mode=modes)) == [28, N - 50]


def test_a_pv_that_is_no_number_is_left_out() -> None:
    pv = [float("nan") if k == 50 else 0.1 * k for k in range(N)]
    assert lengths(trace(pv=pv)) == [48, N - 52]


def test_gains_that_change_begin_a_piece() -> None:
    pieces = control_record(FACTS, trace(), [(0, 40, OLD), (45, N, NEW)]).pieces
    assert [(len(each.mv), each.gains) for each in pieces] == [(38, OLD), (55, NEW)]


def test_a_limit_ends_a_piece() -> None:
    mv = [100.0 if 40 <= k < 45 else 50.0 + 0.01 * k**1.1 for k in range(N)]
    assert lengths(trace(mv=mv)) == [39, N - 45]


def test_a_limit_that_only_the_device_has_shows_in_a_value_that_comes_again() -> None:
    record = driven(Drive(OLD, low=49.5, high=50.5, noise=0.02, step=5.0))
    wide = control_record(replace(FACTS), trace(), [(0, N, OLD)])
    assert wide.samples and record.samples
    for piece in record.pieces:
        assert piece.mv.max() < 50.5 and piece.mv.min() > 49.5


def test_short_rows_tell_nothing() -> None:
    modes = [float(Mode.AUTOMATIC if k % (MIN_SAMPLES + 1) else Mode.MANUAL) for k in range(N)]
    assert set(lengths(trace(mode=modes))) == {MIN_SAMPLES}
    modes = [float(Mode.AUTOMATIC if k % MIN_SAMPLES else Mode.MANUAL) for k in range(N)]
    assert lengths(trace(mode=modes)) == []


def test_a_loop_in_manual_shows_nothing_of_its_controller() -> None:
    assert control_record(FACTS, trace(mode=[float(Mode.MANUAL)] * N), [(0, N, OLD)]).samples == 0


def test_an_mv_that_stands_still_shows_nothing() -> None:
    assert lengths(trace(mv=[50.0] * N)) == []


def test_normal_operation_is_cut_at_what_may_be_a_limit_of_the_rate() -> None:
    mv = np.array([50.0 + 0.01 * k**1.1 for k in range(N)])
    mv[50:] += 3.0
    assert rows_without_limit(mv) == [slice(1, 50), slice(51, N)]

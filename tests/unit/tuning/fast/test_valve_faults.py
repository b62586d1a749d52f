"""Faulty valves: what they make of MV."""

from __future__ import annotations

import numpy as np
import pytest

from loopwright.tuning.fast.score_tests.valve_faults import backlash, find_valve_fault, saturation, stiction
from loopwright.tuning.fast.structure_choice import choose_structure
from loopwright.tuning.identification.output_error import Fit
from tests.unit.tuning.fast.records import BENCHES, record

U = np.array([0.0, 1.0, 0.9, 0.7, 0.4, 0.5, -0.5, -0.45, 0.0])


def test_play_follows_behind() -> None:
    assert backlash(U, 0.2) == pytest.approx([0.0, 0.8, 0.8, 0.8, 0.6, 0.6, -0.3, -0.3, -0.2])


def test_a_sticking_valve_jumps_to_MV() -> None:
    assert stiction(U, 0.4) == pytest.approx([0.0, 1.0, 1.0, 1.0, 0.4, 0.4, -0.5, -0.5, 0.0])


def test_an_end_is_an_end() -> None:
    assert saturation(U, 0.6) == pytest.approx([0.0, 0.6, 0.6, 0.6, 0.4, 0.5, -0.5, -0.45, 0.0])


def test_a_fault_of_no_size_changes_nothing() -> None:
    assert backlash(U, 0.0) == pytest.approx(U)
    assert stiction(U, 0.0) == pytest.approx(U)


def test_a_fit_that_missed_the_minimum_is_no_faulty_valve() -> None:
    """A search for faults finds better parameters on its way: they would explain the record without one."""
    fit = Fit(record(BENCHES["three lags"], 1e-5))
    best = choose_structure(fit).best
    off = best.theta.copy()
    off[0] += 3.0
    missed = fit.fitted(best.structure, best.hypothesis, off)
    assert missed.bic > best.bic + 100.0
    assert find_valve_fault(fit, missed) is None

"""A record of several pieces, each with a level and a start of its own: noise-free pieces give the plant exactly."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import cont2discrete, dlsim, tf2ss

from loopwright.tuning.fast.record import Excitation, ExperimentRecord
from loopwright.tuning.identification.disturbances import by_bic, fit_structures
from loopwright.tuning.identification.output_error import UNDISTURBED, DisturbanceHypothesis, Fit
from loopwright.tuning.identification.projection import Projection
from loopwright.tuning.identification.structures import FIRST, SECOND, SECOND_WITH_FEED_THROUGH, Structure
from loopwright.tuning.models import Reals

K, T1, T2, DELAY, TS = 2.0, 8.0, 3.0, 6, 0.25
LENGTHS = (301, 260, 347)


def of_the_plant(u: Reals, load: Reals) -> Reals:
    """PV of K/((T1 s + 1)(T2 s + 1)) with a dead time of whole samples, by scipy."""
    system = cont2discrete(tf2ss([K], np.polymul([T1, 1.0], [T2, 1.0])), TS)
    late = np.concatenate((np.zeros(DELAY), u[: len(u) - DELAY])) + load
    return np.asarray(dlsim(system, late)[1][:, 0])


def record(load: float = 0.0, known_before: int = 0) -> ExperimentRecord:
    """Three pieces cut from one simulation, so that none begins at rest; the levels are moved apart.

    known_before: the number of samples before each piece of which MV is known.
    """
    random = np.random.default_rng(5)
    u = np.repeat(random.choice((-1.0, 0.0, 1.0), size=60), 25)
    step = np.where(np.arange(len(u)) >= 900, load, 0.0)
    y = of_the_plant(u, step)
    starts = (150, 500, 800)
    cut = [slice(start, start + length) for start, length in zip(starts, LENGTHS, strict=True)]
    y_of = [y[piece] + level for piece, level in zip(cut, (0.3, -0.2, 0.1), strict=True)]
    # MV before a piece is taken for its first value, and what it had been is in the start of the piece
    return ExperimentRecord(
        Ts=TS, u=np.concatenate([u[piece] for piece in cut]), y=np.concatenate(y_of), direction=1.0,
        listened=LENGTHS[0], excited=sum(LENGTHS), turns=2, period=60.0,
        excitation=Excitation.OBSERVE, lengths=LENGTHS,
        u_earlier=tuple(u[piece.start - known_before : piece.start] for piece in cut) if known_before else (),
    )  # fmt: skip


def test_the_plant_is_found_from_pieces_that_do_not_begin_at_rest() -> None:
    fit = Fit(record())
    best = min(fit_structures(fit, UNDISTURBED, structures=(FIRST, SECOND)), key=by_bic)
    model = fit.model(best)
    assert best.structure == SECOND
    # MV of a piece before its first sample reaches PV for a dead time longer: the pieces' first samples are off by it
    assert model.static_gain == pytest.approx(K, rel=0.02)
    assert sorted(-1.0 / np.roots(model.den).real) == pytest.approx([T2, T1], rel=0.05)
    assert pytest.approx(DELAY * TS, abs=0.5 * TS) == model.L


@pytest.mark.parametrize("structure", [SECOND, SECOND_WITH_FEED_THROUGH], ids=lambda each: each.name)
def test_mv_before_each_piece_gives_the_plant_exactly(structure: Structure) -> None:
    fit = Fit(record(known_before=DELAY + 1))
    start = np.array([np.log(1.1 * (1.0 / T1 + 1.0 / T2)), np.log(0.9 / (T1 * T2)), DELAY + 0.4])
    best = fit.search(structure, UNDISTURBED, [start])
    model = fit.model(best)
    assert best.rms < 1e-6
    assert model.static_gain == pytest.approx(K, rel=1e-4)
    assert sorted(-1.0 / np.roots(model.den).real) == pytest.approx([T2, T1], rel=1e-3)
    # a zero and a feed-through stand for a part of the dead time between samples
    assert structure is not SECOND or pytest.approx(DELAY * TS, abs=1e-3 * TS) == model.L


def test_each_piece_keeps_whole_blocks() -> None:
    fit = Fit(record())
    assert fit.block == 1
    longer = Fit(ExperimentRecord(**{**_fields(record()), "period": 260.0}))
    assert longer.block == 3
    assert [piece.stop - piece.start for piece in longer.pieces] == [300, 258, 345]
    assert [rows.stop - rows.start for rows in longer.rows] == [100, 86, 115]


def test_a_load_disturbance_ends_with_the_piece_that_it_begins_in() -> None:
    fit = Fit(record())
    at = LENGTHS[0] + 40.0
    theta = np.array([np.log(1.0 / T1 + 1.0 / T2), np.log(1.0 / (T1 * T2)), DELAY, at])
    hypothesis = DisturbanceHypothesis(load_disturbances=1)
    columns = fit.regressors(SECOND, hypothesis, theta[None]).dense()[0]
    first = fit.first_load(SECOND, hypothesis)
    moved = np.flatnonzero(np.any(columns[:, first : first + SECOND.order] != 0.0, axis=1))
    assert LENGTHS[0] + 40 <= moved[0] <= LENGTHS[0] + 42
    assert moved[-1] == LENGTHS[0] + LENGTHS[1] - 1


def test_levels_and_starts_belong_to_one_piece_each() -> None:
    fit = Fit(record())
    theta = np.array([[np.log(1.0 / T1), DELAY]])
    columns = fit.regressors(FIRST, UNDISTURBED, theta).dense()[0]
    assert columns.shape == (sum(LENGTHS), 1 + 3 + 3)
    for i, rows in enumerate(fit.rows):
        for column in (columns[:, 1 + i], columns[:, 4 + i]):
            assert np.all(column[: rows.start] == 0.0)
            assert np.all(column[rows.stop :] == 0.0)
        assert np.all(columns[rows, 1 + i] == 1.0)


@pytest.mark.parametrize("loads", [0, 1])
@pytest.mark.parametrize("drift", [False, True])
def test_what_belongs_to_one_piece_is_known_under_every_hypothesis(loads: int, drift: bool) -> None:
    fit = Fit(record())
    hypothesis = DisturbanceHypothesis(load_disturbances=loads, drift=drift)
    theta = np.array([np.log(1.0 / T1 + 1.0 / T2), np.log(1.0 / (T1 * T2)), DELAY, *[LENGTHS[0] + 40.0] * loads])
    found = fit.regressors(SECOND, hypothesis, theta[None])
    columns, places = found.dense()[0], fit.places(SECOND, hypothesis)
    assert places.own.shape == (len(LENGTHS), 1 + drift + SECOND.order)
    for rows, own in zip(fit.rows, places.own, strict=True):
        outside = np.delete(columns[:, own], rows, axis=0)
        assert np.all(outside == 0.0) and np.all(np.any(columns[:, own] != 0.0, axis=0))
    first = fit.first_load(SECOND, hypothesis)
    expected = [*range(SECOND.inputs), *range(first, first + SECOND.order * loads)]
    assert places.common.tolist() == expected
    assert sorted([*places.common, *places.own.ravel()]) == list(range(columns.shape[1]))


def test_a_piece_of_fewer_samples_than_regressors_is_explained_whole() -> None:
    whole = record()
    fit = Fit(replace(whole, u=whole.u[:503], y=whole.y[:503], excited=503, lengths=(300, 3, 200)))
    theta = np.array([np.log(1.0 / T1 + 1.0 / T2), np.log(1.0 / (T1 * T2)), DELAY])
    found = fit.fitted(SECOND, UNDISTURBED, theta)
    projected = Projection.of(fit.regressors(SECOND, UNDISTURBED, theta[None]), fit.y)
    assert projected.rest[0] == pytest.approx(found.linear.residual, abs=1e-9)


def _fields(found: ExperimentRecord) -> dict[str, object]:
    return {name: getattr(found, name) for name in found.__dataclass_fields__}

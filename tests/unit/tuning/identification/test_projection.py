"""The projection piece by piece against that of all regressors at once, and against numpy's least squares."""

from __future__ import annotations

import numpy as np
import pytest

from loopwright.tuning.identification.projection import Projection
from loopwright.tuning.identification.regressors import OwnColumns, PieceRows, Regressors
from loopwright.tuning.models import Reals

LENGTHS = {
    "of one length": (30, 30, 30),
    "the first longer": (40, 25, 25),
    "of several lengths": (30, 45, 15),
    "one length apart": (35, 20, 35),
}
SAMPLES, SETS = 90, np.arange(4)
COMMON = np.array([0, 1, 5])
OWN = np.array([[2 + i, 6 + 2 * i, 7 + 2 * i] for i in range(3)])
"""Two common regressors, a level of each piece, another common one, and two more regressors of each piece."""


@pytest.fixture(params=LENGTHS)
def places(request: pytest.FixtureRequest) -> OwnColumns:
    return OwnColumns(PieceRows(LENGTHS[request.param]), COMMON, OWN)


def regressors(places: OwnColumns, seed: int = 1) -> Regressors:
    random = np.random.default_rng(seed)
    own = tuple(random.normal(size=(len(SETS), equal.length, OWN.shape[1])) for equal in places.rows.equal)
    common = random.normal(size=(len(SETS), SAMPLES, len(COMMON)))
    common[:, :, 0] *= 1e3
    return Regressors(common, own, places)


def output() -> Reals:
    return np.random.default_rng(5).normal(size=SAMPLES)


def test_each_regressor_stands_in_its_place_and_in_the_rows_of_its_piece(places: OwnColumns) -> None:
    given = regressors(places)
    dense = given.dense()
    assert dense.shape == (len(SETS), SAMPLES, 12)
    assert np.array_equal(dense[:, :, COMMON], given.common)
    of_piece = [own for equal, own in zip(places.rows.equal, given.own, strict=True) for _ in range(3)[equal.pieces]]
    begin = 0
    for piece, length in enumerate(places.rows.lengths):
        mine = dense[:, :, OWN[piece]]
        assert np.array_equal(mine[:, begin : begin + length], of_piece[piece])
        assert not np.any(np.delete(mine, slice(begin, begin + length), axis=1))
        begin += length


def test_pieces_of_one_length_that_follow_each_other_are_one_view_of_the_signals(places: OwnColumns) -> None:
    signals = np.random.default_rng(3).normal(size=(2, SAMPLES, 3))
    pieces = [piece for equal in places.rows.equal for piece in np.swapaxes(equal.lines(signals), 0, 1)]
    begins = np.cumsum((0, *places.rows.lengths))
    for piece, begin, end in zip(pieces, begins, begins[1:], strict=False):
        assert np.array_equal(piece, signals[:, begin:end]) and np.shares_memory(piece, signals)
    assert len(pieces) == 3 and begins[-1] == SAMPLES
    assert places.rows.piece.tolist() == [i for i, length in enumerate(places.rows.lengths) for _ in range(length)]


def test_lines_that_are_filled_up_at_their_beginnings_become_signals(places: OwnColumns) -> None:
    lengths = places.rows.lengths
    lines = np.random.default_rng(3).normal(size=(2, 3, max(lengths), 4))
    expected = np.concatenate([lines[:, i, max(lengths) - length :] for i, length in enumerate(lengths)], axis=1)
    assert np.array_equal(places.rows.of_ends(lines), expected)


def test_coefficients_and_residual_are_those_of_least_squares(places: OwnColumns) -> None:
    given, y = regressors(places), output()
    columns = given.dense()
    found = Projection.of(given, y)
    for i in SETS:
        expected, (rss,), *_ = np.linalg.lstsq(columns[i], y, rcond=None)
        assert found.linear[i] == pytest.approx(expected, rel=1e-9, abs=1e-18)
        assert found.rest[i] == pytest.approx(y - columns[i] @ expected, abs=1e-12)
        assert found.rss[i] == pytest.approx(rss, rel=1e-12)
    assert given.times(found.linear) == pytest.approx(y - found.rest, abs=1e-12)


def test_what_is_left_of_a_signal_is_that_of_all_regressors_at_once(places: OwnColumns) -> None:
    given, y = regressors(places), output()
    signals = np.random.default_rng(2).normal(size=(2, SAMPLES, 3))
    before = signals.copy()
    by_pieces = Projection.of(given, y).beyond(signals, SETS[1:3])
    at_once = Projection.of(Regressors(given.dense()), y).beyond(signals, SETS[1:3])
    assert by_pieces == pytest.approx(at_once, abs=1e-12)
    assert np.array_equal(signals, before)


@pytest.mark.parametrize("of_piece", [True, False])
def test_a_regressor_that_others_make_up_leaves_the_residual(places: OwnColumns, of_piece: bool) -> None:
    given, y = regressors(places), output()
    of_one = given.own[0] if of_piece else given.common
    without = Projection.of(given, y).rss
    of_one[:, :, 2] = 0.0
    less = Projection.of(given, y)
    of_one[:, :, 2] = 2.0 * of_one[:, :, 1]
    again = Projection.of(given, y)
    columns = given.dense()
    for i in SETS:
        others = np.delete(columns[i], OWN[places.rows.equal[0].pieces, 2] if of_piece else COMMON[2], axis=1)
        rss = np.linalg.lstsq(others, y, rcond=None)[1]
        assert np.isfinite(again.linear).all() and np.isfinite(less.linear).all()
        assert [again.rss[i], less.rss[i]] == pytest.approx([rss[0]] * 2, rel=1e-9)
        assert columns[i] @ again.linear[i] == pytest.approx(y - again.rest[i], abs=1e-12)
        assert np.sum((y - columns[i] @ again.linear[i]) ** 2) == pytest.approx(rss, rel=1e-9)
    assert (without < again.rss).all()


def test_a_piece_of_fewer_rows_than_regressors_is_explained_whole() -> None:
    places = OwnColumns(PieceRows((40, 2, 48)), COMMON, OWN)
    given, y = regressors(places), output()
    found = Projection.of(given, y)
    for i, columns in enumerate(given.dense()):
        expected = np.linalg.lstsq(columns, y, rcond=None)[0]
        assert found.rest[i] == pytest.approx(y - columns @ expected, abs=1e-11)
        assert found.rest[i, 40:42] == pytest.approx([0.0, 0.0], abs=1e-11)


def test_sets_are_replaced_in_all_that_is_known_of_them(places: OwnColumns) -> None:
    first, second, y = regressors(places), regressors(places, 3), output()
    found, other = Projection.of(regressors(places), y), Projection.of(second, y)
    better = np.array([False, True, False, True])
    found.replace(SETS[better], other, better)
    signals = np.random.default_rng(4).normal(size=(4, SAMPLES, 2))
    expected = [Projection.of(each, y) for each in (first, second)]
    for i in SETS:
        of = expected[int(better[i])]
        assert found.rss[i] == pytest.approx(of.rss[i], rel=1e-12)
        assert found.beyond(signals, SETS)[i] == pytest.approx(of.beyond(signals, SETS)[i], abs=1e-12)
        assert found.linear[i] == pytest.approx(of.linear[i], rel=1e-9)

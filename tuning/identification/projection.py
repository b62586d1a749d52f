"""The best linear fit of one output by many sets of regressors, and what is left of a signal beyond a set.

The bases of the regressors that belong to one piece of the record are found once for all consecutive pieces of one
length, and the other regressors are made orthogonal to them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from loopwright.tuning.identification.regressors import Flags, OwnColumns, Regressors, Rows
from loopwright.tuning.models import Reals

REDUNDANT = 1e-10
"""Size of a direction, in columns of unit length, below which it is a linear combination of the others."""


@dataclass(frozen=True, slots=True, eq=False)
class Projection:
    """The best linear fit of y by each set of regressors.

    places: which of the regressors belong to one piece; None where none does.
    own: an orthonormal basis of the regressors of each group of equal pieces, shape (sets, length, directions); empty
    where no regressor belongs to one piece.
    common: an orthonormal basis of the other regressors, orthogonal to those of the pieces, shape (sets, N, others).
    linear: the linear coefficients, shape (sets, columns).
    rest: the residual, shape (sets, N).
    """

    places: OwnColumns | None
    own: tuple[Reals, ...]
    common: Reals
    linear: Reals
    rest: Reals

    @staticmethod
    def of(regressors: Regressors, y: Reals) -> Projection:
        """The projection of y, shape (N,), on each set."""
        lengths, places = _lengths(regressors.common), regressors.places
        common = regressors.common / lengths[:, None]
        rest = np.repeat(y[None, :, None], len(common), axis=0)
        if places is None:
            factors = _Factors.of(common)
            linear = factors.coefficients(_take_out(factors.basis, rest)[:, None])[:, 0, :, 0] / lengths
            return Projection(None, (), factors.basis, linear, rest[:, :, 0])
        signals = np.concatenate((rest, common), axis=2)
        own, solutions = [], []
        for equal, columns in zip(places.rows.equal, regressors.own, strict=True):
            factors = _Factors.of(columns / (own_lengths := _lengths(columns))[:, None])
            along = _take_out(factors.basis[:, None], equal.lines(signals))
            own.append(factors.basis)
            # these are the coefficients for y and for each of the other regressors
            solutions.append(factors.coefficients(along) / own_lengths[:, None, :, None])
        rest = signals[:, :, :1].copy()
        factors = _Factors.of(signals[:, :, 1:])
        found = factors.coefficients(_take_out(factors.basis, rest)[:, None])[:, 0]
        linear = np.empty((len(common), places.common.size + places.own.size))
        linear[:, places.common] = found[:, :, 0] / lengths
        for equal, solution in zip(places.rows.equal, solutions, strict=True):
            without = solution[..., 0] - (solution[..., 1:] @ found[:, None])[..., 0]
            linear[:, places.own[equal.pieces]] = without
        return Projection(places, tuple(own), factors.basis, linear, rest[:, :, 0])

    @property
    def rss(self) -> Reals:
        return np.asarray(np.einsum("bi,bi->b", self.rest, self.rest))

    def beyond(self, signals: Reals, which: Rows) -> Reals:
        """What is left of the signals, shape (sets, N, signals), beyond the regressors of these sets."""
        left = signals.copy()
        if self.places is not None:
            for equal, basis in zip(self.places.rows.equal, self.own, strict=True):
                _take_out(basis[which, None], equal.lines(left))
        _take_out(self.common[which], left)
        return left

    def replace(self, where: Rows, by: Projection, which: Flags) -> None:
        """Puts sets of another projection in the place of sets of this one."""
        for mine, other in zip(self._arrays(), by._arrays(), strict=True):
            mine[where] = other[which]

    def _arrays(self) -> Sequence[Reals]:
        return *self.own, self.common, self.linear, self.rest


@dataclass(frozen=True, slots=True, eq=False)
class _Factors:
    """Regressors as the product of an orthonormal basis and of square matrices.

    basis: shape (sets, N, directions), 0 where a direction is redundant.
    square: shape (sets, directions, directions).
    seen: whether no direction is redundant, shape (sets,).
    """

    basis: Reals
    square: Reals
    seen: Flags

    @staticmethod
    def of(columns: Reals) -> _Factors:
        """columns: regressors of about unit length, shape (sets, N, columns)."""
        rows = columns.shape[1]
        # a piece may have fewer rows than regressors: rows of zeros make the factor square
        if rows < columns.shape[2]:
            columns = np.pad(columns, ((0, 0), (0, columns.shape[2] - rows), (0, 0)))
        basis, square = np.linalg.qr(columns)
        seen = np.abs(np.einsum("bii->bi", square)).min(axis=1, initial=np.inf) > REDUNDANT
        for i in np.flatnonzero(~seen):
            directions, sizes, turned = np.linalg.svd(columns[i], full_matrices=False)
            sizes[sizes <= REDUNDANT] = 0.0
            basis[i], square[i] = directions * (sizes > 0.0), sizes[:, None] * turned
        return _Factors(basis[:, :rows], square, seen)

    def coefficients(self, along: Reals) -> Reals:
        """The coefficients of the columns, the smallest ones where a direction is redundant, in the shape of `along`.

        along: the coefficients of the basis, shape (sets, pieces, directions, signals).
        """
        sets, pieces, directions, signals = along.shape
        turned = np.swapaxes(along, 1, 2).reshape(sets, directions, pieces * signals)
        if self.seen.all():
            found = np.linalg.solve(self.square, turned)
        else:
            found = np.empty_like(turned)
            found[self.seen] = np.linalg.solve(self.square[self.seen], turned[self.seen])
            for i in np.flatnonzero(~self.seen):
                found[i] = np.linalg.lstsq(self.square[i], turned[i], rcond=REDUNDANT)[0]
        return np.swapaxes(found.reshape(sets, directions, pieces, signals), 1, 2)


def _lengths(columns: Reals) -> Reals:
    """The lengths of the columns of each set, 1 where a column is 0; columns: shape (sets, N, columns)."""
    lengths = np.sqrt(np.einsum("bij,bij->bj", columns, columns))
    lengths[lengths == 0.0] = 1.0
    return np.asarray(lengths)


def _take_out(basis: Reals, signals: Reals) -> Reals:
    """Takes the directions of the basis out of the signals, in place, and returns their coefficients.

    basis: shape (..., N, directions).
    signals: shape (..., N, signals).
    """
    along = np.swapaxes(basis, -1, -2) @ signals
    signals -= basis @ along
    return np.asarray(along)

"""The best linear fit of one output by many sets of regressors, and what is left of a signal beyond a set.

The bases of the regressors that belong to one piece of the record are found piece by piece, all pieces at once, and the
other regressors are made orthogonal to them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from loopwright.tuning.identification.regressors import Flags, Regressors, Rows
from loopwright.tuning.models import Reals

REDUNDANT = 1e-10
"""Size of a direction, in columns of unit length, below which it is a linear combination of the others."""


@dataclass(frozen=True, slots=True, eq=False)
class Projection:
    """The best linear fit of y by each set of regressors.

    regressors: the regressors.
    own: an orthonormal basis of the regressors of each piece, shape (sets, pieces, longest, directions); None where no
    regressor belongs to one piece.
    common: an orthonormal basis of the other regressors, orthogonal to those of the pieces, shape (sets, N, others).
    linear: the linear coefficients, shape (sets, columns).
    rest: the residual, shape (sets, N).
    """

    regressors: Regressors
    own: Reals | None
    common: Reals
    linear: Reals
    rest: Reals

    @staticmethod
    def of(regressors: Regressors, y: Reals) -> Projection:
        """The projection of y, shape (N,), on each set."""
        lengths = _lengths(regressors.common)
        common = regressors.common / lengths[:, None]
        rest = np.empty((len(common), len(y), 1))
        rest[:, :, 0] = y
        if regressors.own is None or regressors.places is None:
            factors = _Factors.of(common)
            linear = factors.coefficients(_take_out(factors.basis, rest))[:, :, 0]
            return Projection(regressors, None, factors.basis, linear / lengths, rest[:, :, 0])
        places = regressors.places
        own_lengths = _lengths(regressors.own)
        own = _Factors.of(regressors.own / own_lengths[:, :, None])
        signals = places.rows.table(np.concatenate((rest, common), axis=2))
        # the directions of y and, for each of the other regressors, of that
        solutions = own.coefficients(_take_out(own.basis, signals))
        signals = places.rows.record(signals)
        rest = np.ascontiguousarray(signals[:, :, :1])
        factors = _Factors.of(signals[:, :, 1:])
        found = factors.coefficients(_take_out(factors.basis, rest))
        linear = np.empty((len(common), places.common.size + places.own.size))
        linear[:, places.common] = found[:, :, 0] / lengths
        linear[:, places.own] = (solutions[..., 0] - (solutions[..., 1:] @ found[:, None])[..., 0]) / own_lengths
        return Projection(regressors, own.basis, factors.basis, linear, rest[:, :, 0])

    @property
    def rss(self) -> Reals:
        return np.asarray(np.einsum("bi,bi->b", self.rest, self.rest))

    def fitted(self, which: Rows) -> Reals:
        """What these sets make of y, shape (sets, N)."""
        return self.regressors.of(which).times(self.linear[which])

    def beyond(self, signals: Reals, which: Rows) -> Reals:
        """What is left of the signals, shape (sets, N, signals), beyond the regressors of these sets."""
        if self.own is None or self.regressors.places is None:
            left = signals.copy()
        else:
            table = self.regressors.places.rows.table(signals)
            _take_out(self.own[which], table)
            left = self.regressors.places.rows.record(table)
        _take_out(self.common[which], left)
        return left

    def replace(self, where: Rows, by: Projection, which: Flags) -> None:
        """Puts sets of another projection in the place of sets of this one."""
        for mine, other in zip(self._arrays(), by._arrays(), strict=True):
            mine[where] = other[which]

    def _arrays(self) -> Sequence[Reals]:
        own = [each for each in (self.own, self.regressors.own) if each is not None]
        return self.regressors.common, *own, self.common, self.linear, self.rest


@dataclass(frozen=True, slots=True, eq=False)
class _Factors:
    """Regressors as the product of an orthonormal basis and of square matrices.

    basis: shape (..., N, directions), 0 where a direction is redundant.
    square: shape (..., directions, directions).
    seen: whether no direction is redundant, shape (...).
    """

    basis: Reals
    square: Reals
    seen: Flags

    @staticmethod
    def of(columns: Reals) -> _Factors:
        """columns: regressors of about unit length, shape (..., N, columns)."""
        basis, square = np.linalg.qr(columns)
        seen = np.abs(np.einsum("...ii->...i", square)).min(axis=-1, initial=np.inf) > REDUNDANT
        for i in zip(*np.nonzero(~seen), strict=True):
            directions, sizes, turned = np.linalg.svd(columns[i], full_matrices=False)
            sizes[sizes <= REDUNDANT] = 0.0
            basis[i], square[i] = directions * (sizes > 0.0), sizes[:, None] * turned
        return _Factors(basis, square, seen)

    def coefficients(self, along: Reals) -> Reals:
        """The coefficients of the columns for these directions, shape (..., directions, signals); the smallest ones
        where a direction is redundant."""
        if self.seen.all():
            return np.asarray(np.linalg.solve(self.square, along))
        found = np.empty_like(along)
        found[self.seen] = np.linalg.solve(self.square[self.seen], along[self.seen])
        for i in zip(*np.nonzero(~self.seen), strict=True):
            found[i] = np.linalg.lstsq(self.square[i], along[i], rcond=REDUNDANT)[0]
        return found


def _lengths(columns: Reals) -> Reals:
    """The lengths of the columns, shape (..., N, columns), 1 where a column is 0."""
    lengths = np.sqrt(np.einsum("...ij,...ij->...j", columns, columns))
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

"""The best linear fit of one output by many sets of regressors, and what is left of a signal beyond a set.

Some regressors are 0 outside a part of the rows: the level and the start of a piece of the record. Their bases are
found part by part, and the other regressors are made orthogonal to them. One factorisation of all regressors would
spend most of its time on zeros.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from loopwright.tuning.models import Reals

Rows = NDArray[np.int64]
Flags = NDArray[np.bool_]
REDUNDANT = 1e-10
"""Size of a direction, in columns of unit length, below which it is a linear combination of the others."""


@dataclass(frozen=True, slots=True, eq=False)
class LocalRegressors:
    """Regressors that are 0 outside a part of the rows.

    rows: the part; no two of them have a row in common.
    columns: the places of these regressors among all, shape (columns,).
    """

    rows: slice
    columns: Rows


@dataclass(frozen=True, slots=True, eq=False)
class Projection:
    """The best linear fit of y by each set of regressors.

    columns: the regressors, shape (sets, N, columns).
    local: which of the regressors are 0 outside which part, the same in all sets.
    bases: an orthonormal basis of the regressors of each part, shapes (sets, rows, columns).
    common: an orthonormal basis of the other regressors, orthogonal to those of the parts, shape (sets, N, others).
    linear: the linear coefficients, shape (sets, columns).
    rest: the residual, shape (sets, N).
    """

    columns: Reals
    local: Sequence[LocalRegressors]
    bases: Sequence[Reals]
    common: Reals
    linear: Reals
    rest: Reals

    @staticmethod
    def of(columns: Reals, y: Reals, local: Sequence[LocalRegressors] = ()) -> Projection:
        """The projection of y, shape (N,), on each set; columns and local as above."""
        sets, _, count = columns.shape
        lengths = np.sqrt(np.einsum("bij,bij->bj", columns, columns))
        lengths[lengths == 0.0] = 1.0
        # a view is faster than indices, and most records have one piece
        others = np.delete(np.arange(count), np.concatenate([part.columns for part in local])) if local else slice(None)
        common = columns[:, :, others] / lengths[:, None, others]
        rest = np.tile(y, (sets, 1))
        bases, solutions = list[Reals](), list[Reals]()
        for part in local:
            own = _Factors.of(columns[:, part.rows, part.columns] / lengths[:, None, part.columns])
            # the directions of y and, for each of the other regressors, of that
            along = [_take_out(own.basis, signal[:, part.rows]) for signal in (rest[:, :, None], common)]
            bases.append(own.basis)
            solutions.append(own.coefficients(np.concatenate(along, axis=2)))
        factors = _Factors.of(common)
        linear = np.empty((sets, count))
        linear[:, others] = factors.coefficients(_take_out(factors.basis, rest[:, :, None]))[:, :, 0]
        for part, found in zip(local, solutions, strict=True):
            linear[:, part.columns] = found[:, :, 0] - (found[:, :, 1:] @ linear[:, others, None])[:, :, 0]
        return Projection(columns, local, bases, factors.basis, linear / lengths, rest)

    @property
    def rss(self) -> Reals:
        return np.asarray(np.einsum("bi,bi->b", self.rest, self.rest))

    def fitted(self, which: Rows) -> Reals:
        """What these sets make of y, shape (sets, N)."""
        return np.asarray((self.columns[which] @ self.linear[which, :, None])[:, :, 0])

    def beyond(self, signals: Reals, which: Rows) -> Reals:
        """What is left of the signals, shape (sets, N, signals), beyond the regressors of these sets."""
        left = signals.copy()
        for part, basis in zip(self.local, self.bases, strict=True):
            _take_out(basis[which], left[:, part.rows])
        _take_out(self.common[which], left)
        return left

    def replace(self, where: Rows, by: Projection, which: Flags) -> None:
        """Puts sets of another projection in the place of sets of this one."""
        for mine, other in zip(self._arrays(), by._arrays(), strict=True):
            mine[where] = other[which]

    def _arrays(self) -> Sequence[Reals]:
        return self.columns, *self.bases, self.common, self.linear, self.rest


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
        basis, square = np.linalg.qr(columns)
        seen = np.abs(np.einsum("bii->bi", square)).min(axis=1, initial=np.inf) > REDUNDANT
        for i in np.flatnonzero(~seen):
            directions, sizes, turned = np.linalg.svd(columns[i], full_matrices=False)
            sizes[sizes <= REDUNDANT] = 0.0
            basis[i], square[i] = directions * (sizes > 0.0), sizes[:, None] * turned
        return _Factors(basis, square, seen)

    def coefficients(self, along: Reals) -> Reals:
        """The coefficients of the columns for these directions, shape (sets, directions, signals); the smallest ones
        where a direction is redundant."""
        if self.seen.all():
            return np.asarray(np.linalg.solve(self.square, along))
        found = np.empty_like(along)
        found[self.seen] = np.linalg.solve(self.square[self.seen], along[self.seen])
        for i in np.flatnonzero(~self.seen):
            found[i] = np.linalg.lstsq(self.square[i], along[i], rcond=REDUNDANT)[0]
        return found


def _take_out(basis: Reals, signals: Reals) -> Reals:
    """Takes the directions of the basis out of the signals, in place, and returns their coefficients.

    basis: shape (sets, N, directions).
    signals: shape (sets, N, signals).
    """
    along = np.swapaxes(basis, 1, 2) @ signals
    signals -= basis @ along
    return np.asarray(along)

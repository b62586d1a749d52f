"""Many sets of regressors of one record, those that belong to one piece of the record apart from the others.

The level, the slope and the start of a piece are 0 in all other pieces: of a record with a dozen pieces, most of a
matrix of all regressors would be zeros. Consecutive pieces of one length have the same ones, which are kept once.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import groupby

import numpy as np
from numpy.typing import NDArray

from loopwright.tuning.models import Reals

Rows = NDArray[np.int64]
Flags = NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class EqualPieces:
    """Consecutive pieces of one length.

    pieces: which pieces of the record.
    rows: their rows.
    length: the number of rows of each.
    """

    pieces: slice
    rows: slice
    length: int

    def lines(self, signals: Reals) -> Reals:
        """These pieces of signals, shape (sets, N, signals), as a view of shape (sets, pieces, length, signals)."""
        count = self.pieces.stop - self.pieces.start
        return signals[:, self.rows].reshape(len(signals), count, self.length, signals.shape[-1])


class PieceRows:
    """The rows of the pieces of a record.

    lengths: the number of rows of each piece.
    piece: the piece of each row, shape (N,).
    equal: the groups of consecutive pieces of one length.
    """

    def __init__(self, lengths: Sequence[int]) -> None:
        self.lengths = tuple(lengths)
        self.piece: Rows = np.repeat(np.arange(len(lengths)), lengths)
        self.equal: list[EqualPieces] = []
        piece = row = 0
        for length, group in groupby(self.lengths):
            count = len(list(group))
            self.equal.append(EqualPieces(slice(piece, piece + count), slice(row, row + count * length), length))
            piece, row = piece + count, row + count * length

    def of_ends(self, lines: Reals) -> Reals:
        """Returns the last rows of each piece's line, as many as the piece has, as signals of the record, shape (sets,
        N, signals); lines: shape (sets, pieces, longest, signals)."""
        found = np.empty((len(lines), len(self.piece), lines.shape[-1]))
        for equal in self.equal:
            equal.lines(found)[...] = lines[:, equal.pieces, lines.shape[2] - equal.length :]
        return found


@dataclass(frozen=True, slots=True, eq=False)
class OwnColumns:
    """Which of all regressors belong to one piece of the record.

    rows: the rows of the pieces.
    common: the places of the regressors that belong to none, shape (others,).
    own: those of each piece, shape (pieces, each).
    """

    rows: PieceRows
    common: Rows
    own: Rows


@dataclass(frozen=True, slots=True, eq=False)
class Regressors:
    """Sets of regressors.

    common: those that belong to no single piece, shape (sets, N, others).
    own: one array for each group of `places.rows.equal`, shape (sets, length, each): the regressors that every piece of
    the group has in its rows. Empty where no regressor belongs to one piece; `places` is then None.
    places: which ones belong to one piece.
    """

    common: Reals
    own: tuple[Reals, ...] = ()
    places: OwnColumns | None = None

    def dense(self) -> Reals:
        """All regressors, shape (sets, N, columns)."""
        if self.places is None:
            return self.common
        sets, samples, others = self.common.shape
        found = np.zeros((sets, samples, others + self.places.own.size))
        found[:, :, self.places.common] = self.common
        for equal, own in zip(self.places.rows.equal, self.own, strict=True):
            lines = equal.lines(found)
            for line, columns in enumerate(self.places.own[equal.pieces]):
                lines[:, line, :, columns] = np.moveaxis(own, -1, 0)
        return found

    def times(self, linear: Reals) -> Reals:
        """The sums of the regressors with these coefficients, shape (sets, columns), as shape (sets, N)."""
        if self.places is None:
            return np.asarray((self.common @ linear[:, :, None])[:, :, 0])
        found = self.common @ linear[:, self.places.common, None]
        for equal, own in zip(self.places.rows.equal, self.own, strict=True):
            lines = equal.lines(found)[..., 0]
            lines += np.swapaxes(own @ np.swapaxes(linear[:, self.places.own[equal.pieces]], 1, 2), 1, 2)
        return np.asarray(found[:, :, 0])

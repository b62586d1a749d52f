"""Many sets of regressors of one record, those that belong to one piece of the record apart from the others.

The level, the slope and the start of a piece are 0 in all other pieces: of a record with a dozen pieces, most of a
matrix of all regressors would be zeros.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from loopwright.tuning.models import Reals

Rows = NDArray[np.int64]
Flags = NDArray[np.bool_]


class PieceRows:
    """The rows of the pieces of a record, also as a table with one line for each piece, filled up with zeros at its
    end.

    lengths: the number of rows of each piece.
    piece: the piece of each row, shape (N,).
    inside: which places of the table are rows of the record, shape (pieces, longest).
    """

    def __init__(self, lengths: Sequence[int]) -> None:
        self.lengths = tuple(lengths)
        self.longest = max(lengths)
        self.piece: Rows = np.repeat(np.arange(len(lengths)), lengths)
        self.inside: Flags = np.arange(self.longest) < np.array(lengths)[:, None]
        self._full = bool(self.inside.all())

    def table(self, signals: Reals) -> Reals:
        """Signals of shape (sets, N, signals) as tables, shape (sets, pieces, longest, signals), in memory of their
        own."""
        sets, _, count = signals.shape
        shape = (sets, len(self.lengths), self.longest, count)
        if self._full:
            return signals.reshape(shape).copy()
        found = np.zeros(shape)
        found[:, self.inside] = signals
        return found

    def record(self, table: Reals) -> Reals:
        """Tables of shape (sets, pieces, longest, signals) as signals of the record, shape (sets, N, signals)."""
        if self._full:
            return table.reshape(len(table), -1, table.shape[-1])
        return np.asarray(table[:, self.inside])

    def record_of_ends(self, table: Reals) -> Reals:
        """As `record`, of a table whose lines are filled up at their beginnings."""
        if self._full:
            return self.record(table)
        return np.asarray(table[:, self.inside[:, ::-1]])


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
    own: those of each piece in its rows, 0 beyond its end, shape (sets, pieces, longest, each). None where no regressor
    belongs to one piece; `places` is then None, too.
    places: which ones belong to one piece.
    """

    common: Reals
    own: Reals | None = None
    places: OwnColumns | None = None

    def dense(self) -> Reals:
        """All regressors, shape (sets, N, columns)."""
        if self.own is None or self.places is None:
            return self.common
        sets, samples, others = self.common.shape
        found = np.zeros((sets, samples, others + self.places.own.size))
        found[:, :, self.places.common] = self.common
        begin = 0
        for piece, length in enumerate(self.places.rows.lengths):
            found[:, begin : begin + length, self.places.own[piece]] = self.own[:, piece, :length]
            begin += length
        return found

    def times(self, linear: Reals) -> Reals:
        """The sums of the regressors with these coefficients, shape (sets, columns), as shape (sets, N)."""
        if self.own is None or self.places is None:
            return np.asarray((self.common @ linear[:, :, None])[:, :, 0])
        of_pieces = self.own @ linear[:, self.places.own][..., None]
        common = self.common @ linear[:, self.places.common][..., None]
        return np.asarray((common + self.places.rows.record(of_pieces))[:, :, 0])

    def of(self, which: Rows) -> Regressors:
        """Some of the sets."""
        return Regressors(self.common[which], None if self.own is None else self.own[which], self.places)

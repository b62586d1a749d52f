"""The history of the loops as stored: blocks of bins, see service.listening.bins for their layout."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from sqlalchemy import delete, select, tuple_

from loopwright.service.store.store import Store
from loopwright.service.store.tables import HistoryRow

_AT_ONCE = 200
_DELETED_AT_ONCE = 1000


@dataclass(frozen=True, slots=True)
class HistoryBlock:
    """A block of a loop. Times in seconds since 1970 UTC.

    after_s: time of the last sample before the block, if the listener had one: where the block before ends otherwise,
    blocks are missing.
    """

    loop: str
    after_s: float | None
    first_s: float
    last_s: float
    count: int
    data: bytes


def write(store: Store, blocks: Sequence[HistoryBlock]) -> None:
    """Stores blocks of this host's loops. A block that is there already is replaced."""
    with store.writing() as session:
        for block in blocks:
            session.merge(HistoryRow(
                loop=block.loop, after_s=block.after_s, first_s=block.first_s, last_s=block.last_s, host=store.host,
                count=block.count, data=block.data,
            ))  # fmt: skip


def read(store: Store, loop: str, from_s: float, to_s: float) -> Iterator[list[HistoryBlock]]:
    """Yields the blocks of a loop that touch this time, some at a time, in the order of time."""
    after = -1.0
    of_loop = (HistoryRow.loop == loop, HistoryRow.last_s >= from_s, HistoryRow.first_s <= to_s)
    wanted = select(HistoryRow).where(*of_loop).order_by(HistoryRow.first_s).limit(_AT_ONCE)
    while True:
        with store.reading() as session:
            rows = session.scalars(wanted.where(HistoryRow.first_s > after)).all()
        if not rows:
            return
        yield [HistoryBlock(row.loop, row.after_s, row.first_s, row.last_s, row.count, row.data) for row in rows]
        after = rows[-1].first_s


def delete_older(store: Store, before_s: float) -> int:
    """Deletes this host's blocks that ended before this time, in short transactions. Returns their number."""
    count = 0
    key = (HistoryRow.loop, HistoryRow.first_s)
    while True:
        with store.writing() as session:
            old = select(*key).where(HistoryRow.host == store.host, HistoryRow.last_s < before_s)
            found = session.execute(old.limit(_DELETED_AT_ONCE)).all()
            if not found:
                return count
            session.execute(delete(HistoryRow).where(tuple_(*key).in_([tuple(row) for row in found])))
        count += len(found)

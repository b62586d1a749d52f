"""What is known of the loops: what tests and normal operation have shown, and what of it is of an older plant."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from sqlalchemy import delete, func, select, update

from loopwright.service.results import Finding
from loopwright.service.store.store import Store
from loopwright.service.store.tables import KnowledgeRow, LoopRow

MAX_OF_A_LOOP = 20
"""Findings that are kept of a loop, the latest ones, beside the one that is what is known."""


@dataclass(frozen=True, slots=True)
class Known:
    """A finding as stored. superseded: why it is of an older plant, in words; None where it is not."""

    number: int
    finding: Finding
    superseded: str | None


def read(store: Store, loop: str) -> list[Known]:
    """Returns the findings of a loop of any host, oldest first."""
    wanted = select(KnowledgeRow).where(KnowledgeRow.loop == loop).order_by(KnowledgeRow.number)
    with store.reading() as session:
        return [Known(row.number, row.finding, row.superseded) for row in session.scalars(wanted)]


def add(
    store: Store,
    loop: str,
    finding: Finding,
    older: Mapping[int, str],
    instead_of: Sequence[int] = (),
    best: int | None = None,
) -> None:
    """Stores a finding.

    older: by number, the findings that are of an older plant because of it, with the reason.
    instead_of: the findings that it takes the place of.
    best: the finding that is kept although many are later.
    """
    of_loop = KnowledgeRow.loop == loop
    with store.writing() as session:
        session.execute(delete(KnowledgeRow).where(of_loop, KnowledgeRow.number.in_(instead_of)))
        for number, why in older.items():
            session.execute(update(KnowledgeRow).where(KnowledgeRow.number == number).values(superseded=why))
        session.add(KnowledgeRow(loop=loop, at=finding.at, finding=finding))
        session.flush()
        latest = select(KnowledgeRow.number).where(of_loop).order_by(KnowledgeRow.number.desc()).limit(MAX_OF_A_LOOP)
        superfluous = (of_loop, KnowledgeRow.number.not_in(latest), KnowledgeRow.number.is_distinct_from(best))
        session.execute(delete(KnowledgeRow).where(*superfluous))


def mark_older(store: Store, older: Mapping[int, str]) -> None:
    """Stores that findings are of an older plant. older: the reasons, by number."""
    with store.writing() as session:
        for number, why in older.items():
            session.execute(update(KnowledgeRow).where(KnowledgeRow.number == number).values(superseded=why))


def delete_older(store: Store, before: str) -> int:
    """Deletes the findings before this time, UTC as ISO 8601, but the latest of each loop, which is what is known of
    it. Loops of other hosts are left alone. Returns the number of findings."""
    foreign = select(LoopRow.tag).where(LoopRow.host != store.host)
    latest = select(func.max(KnowledgeRow.number)).group_by(KnowledgeRow.loop)
    old = (KnowledgeRow.at < before, KnowledgeRow.number.not_in(latest), KnowledgeRow.loop.not_in(foreign))
    with store.writing() as session:
        numbers = session.scalars(select(KnowledgeRow.number).where(*old)).all()
        session.execute(delete(KnowledgeRow).where(KnowledgeRow.number.in_(numbers)))
    return len(numbers)

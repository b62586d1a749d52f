"""What a request that came with an idempotency key makes or changes, noted beside the key in the same transaction."""

from __future__ import annotations

from contextvars import ContextVar
from dataclasses import dataclass

from sqlalchemy import ColumnElement, CursorResult, update
from sqlalchemy.orm import Session

from loopwright.service.store.tables import IdempotencyRow


class StillAnswering(Exception):
    """The request with this key is being answered just now."""

    def __init__(self) -> None:
        super().__init__("the request with this Idempotency-Key is still being answered: repeat it a little later")


@dataclass(frozen=True)
class Claim:
    """The right to answer the request with this key. effect: what an attempt that was cut off has made or changed."""

    principal: str
    key: str
    token: str
    effect: str | None = None

    @property
    def ours(self) -> tuple[ColumnElement[bool], ...]:
        """The row of the key, unless another has taken over."""
        row = IdempotencyRow
        return row.principal == self.principal, row.key == self.key, row.token == self.token


current: ContextVar[Claim | None] = ContextVar("claim", default=None)
"""Of the request that is being answered, where it came with a key."""


def made(session: Session, url: str) -> None:
    """Notes what the present request makes. Raises StillAnswering, and nothing is made, when a repetition at another
    gateway has taken over."""
    claim = current.get()
    if claim is not None and not _note(session, claim, url):
        raise StillAnswering


def changed(session: Session, url: str) -> None:
    """Notes what the present request changes; what it has changed first counts."""
    claim = current.get()
    if claim is not None:
        _note(session, claim, url)


def _note(session: Session, claim: Claim, url: str) -> bool:
    values: dict[str, object] = {"effect": url}
    done = session.execute(update(IdempotencyRow).where(*claim.ours, IdempotencyRow.effect.is_(None)).values(values))
    return isinstance(done, CursorResult) and done.rowcount == 1

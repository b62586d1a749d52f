"""Keys under which clients repeat a POST (the header Idempotency-Key), and the answers that they get again.

A request claims its key before anything else is done. What it makes or changes is noted beside the key in the
transaction that does so (service.store.idempotency_effects), hence a service that is killed before the answer is kept
does not do it
twice: the repetition finds what there is.
"""

from __future__ import annotations

import secrets
import zlib
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta

from sqlalchemy import delete, select, true, update
from sqlalchemy.exc import IntegrityError
from sqlalchemy.orm import Session

from loopwright.service.store.clock import stamp
from loopwright.service.store.clock_watch import STEP
from loopwright.service.store.hosts import Ages
from loopwright.service.store.idempotency_effects import Claim, StillAnswering
from loopwright.service.store.lock import HostLock
from loopwright.service.store.store import Store
from loopwright.service.store.tables import IdempotencyRow

KEPT_H = 24
"""Hours for which a key is kept at least. After a stop of more than STEP the clock may have jumped by as much: all keys
are then kept for so long from the start on."""
MAX_KEYS = 5000
"""Of one principal: the oldest answers beyond that are forgotten."""
MAX_BYTES = 16_384
"""Of one answer, compressed. A longer one is not kept: only computations have such, and they may be repeated."""


class OtherRequest(Exception):
    """The key was given with another request before."""


@dataclass(frozen=True)
class Answer:
    """A whole answer over HTTP."""

    status: int
    headers: dict[str, str]
    body: bytes


class IdempotencyKeys:
    """The keys in the database, as one process sees them. maximum: of one principal. Raises SQLAlchemyError."""

    def __init__(self, store: Store, maximum: int = MAX_KEYS, ages: Ages | None = None) -> None:
        self._store = store
        self._max = maximum
        self._ages = ages or Ages(store, STEP)
        # Tokens of the requests that this process is answering.
        self._answering: set[str] = set()

    def claim(self, principal: str, key: str, fingerprint: str, at: datetime | None = None) -> Claim | Answer:
        """The right to answer, or the answer that was kept. at: the present. Raises OtherRequest, StillAnswering."""
        token = secrets.token_hex(8)
        self._answering.add(token)  # before the database knows it: what is not among these was cut off
        claim: Claim | Answer | None = None
        try:
            claim = self._claim(principal, key, fingerprint, token, at or datetime.now(UTC))
        finally:
            if not isinstance(claim, Claim):
                self._answering.discard(token)
        return claim

    def _claim(self, principal: str, key: str, fingerprint: str, token: str, at: datetime) -> Claim | Answer:
        try:
            with self._store.writing() as session:
                self._forget(session, principal, at)
                row = session.get(IdempotencyRow, (principal, key), with_for_update=True)
                if row is None:
                    row = IdempotencyRow(principal=principal, key=key, fingerprint=fingerprint, at=stamp(at))
                    session.add(row)
                elif row.fingerprint != fingerprint:
                    raise OtherRequest
                elif row.status is not None:
                    return Answer(row.status, dict(row.headers or {}), zlib.decompress(row.body or b""))
                elif row.effect is None and not self._cut_off(session, row):
                    raise StillAnswering
                row.host, row.token = self._store.host, token
                return Claim(principal, key, token, row.effect)
        except IntegrityError as error:  # another gateway has claimed it in this moment
            raise StillAnswering from error

    def _cut_off(self, session: Session, row: IdempotencyRow) -> bool:
        """Whether the host that was answering is gone. What this host was answering before it was cut off is forgotten
        already."""
        return row.host != self._store.host and HostLock.free(session, row.host)

    def _forget(self, session: Session, principal: str, at: datetime) -> None:
        """What is too old, what was cut off on this host without an effect, and the oldest answers of too many."""
        keys = IdempotencyRow
        not_answering = keys.token.not_in(list(self._answering))
        old = self._ages.before(at, timedelta(hours=KEPT_H))
        if old is not None:
            session.execute(delete(keys).where(keys.at < stamp(old), not_answering))
        here = keys.host == self._store.host if self._store.shared else true()
        unanswered = keys.status.is_(None) & keys.effect.is_(None)
        session.execute(delete(keys).where(here, unanswered, not_answering))
        newest = select(keys.at).where(keys.principal == principal).order_by(keys.at.desc())
        last = session.scalar(newest.offset(self._max - 1).limit(1))
        if last is not None:
            session.execute(delete(keys).where(keys.principal == principal, keys.at <= last, ~unanswered))

    def keep(self, claim: Claim, answer: Answer) -> None:
        """Repetitions get this answer, unless another request has taken over."""
        body = zlib.compress(answer.body)
        if len(body) > MAX_BYTES:
            self.let_go(claim)
            return
        values = {"status": answer.status, "headers": answer.headers, "body": body}
        try:
            with self._store.writing() as session:
                session.execute(update(IdempotencyRow).where(*claim.ours).values(values))
        finally:
            self._answering.discard(claim.token)

    def let_go(self, claim: Claim) -> None:
        """There is no answer to keep: a repetition is answered anew, unless something was made or changed."""
        try:
            with self._store.writing() as session:
                session.execute(delete(IdempotencyRow).where(*claim.ours, IdempotencyRow.effect.is_(None)))
        finally:
            self._answering.discard(claim.token)

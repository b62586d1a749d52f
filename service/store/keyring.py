"""The keys in the database: made, listed, revoked, and checked at the door."""

from __future__ import annotations

import hashlib
import hmac
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta

from sqlalchemy import Engine, select
from sqlalchemy.orm import sessionmaker

from loopwright.service.security.keys import Scope, hash_key, key_id_of, matches, new_key
from loopwright.service.store import audit
from loopwright.service.store.clock import now, stamp
from loopwright.service.store.tables import KeyRow

REVOKED_WITHIN_S = 2.0
"""How long a key that was just used may still be taken for valid after it was revoked."""


ABORTS_FOR_S = 12 * 3600.0
"""How long after it was last found valid a key may abort tests while the database does not answer: a shift."""


class KeyProblem(Exception):
    """The wish about a key cannot be met; the text says why."""


@dataclass(frozen=True)
class _Right:
    """A key that was found right: its digest, when it was last compared with the database, and its row then."""

    digest: bytes
    at: float
    row: KeyRow


class Keyring:
    """Keys of one database. `wall` gives monotonic seconds.

    A key that was found right is kept as its digest, in memory: it is hashed once, and so is no other secret that comes
    with its id from then on.
    """

    def __init__(self, engine: Engine, wall: Callable[[], float] = time.monotonic) -> None:
        self._session = sessionmaker(engine, expire_on_commit=False)
        self._wall = wall
        self._right: dict[str, _Right] = {}

    def create(self, name: str, scope: Scope, valid_for: timedelta | None = None) -> tuple[KeyRow, str]:
        """A new key; its text is given here and never again. Raises KeyProblem when a valid key has the name."""
        key_id, key = new_key()
        at = datetime.now(UTC)
        row = KeyRow(
            id=key_id, name=name, scope=scope.value, hash=hash_key(key), created_at=stamp(at),
            expires_at=stamp(at + valid_for) if valid_for else None, revoked_at=None,
        )  # fmt: skip
        with self._session.begin() as session:
            if any(valid(other) for other in session.scalars(select(KeyRow).where(KeyRow.name == name))):
                raise KeyProblem(f"there is a valid key named {name!r}; choose another name, or revoke it first")
            session.add(row)
            audit.record(session, "key_create", key_id, after=_shown(row))
        return row, key

    def list(self) -> Sequence[KeyRow]:
        """Every key there ever was, oldest first."""
        with self._session() as session:
            return session.scalars(select(KeyRow).order_by(KeyRow.created_at, KeyRow.id)).all()

    def any_valid(self) -> bool:
        return any(valid(row) for row in self.list())

    def revoke(self, wanted: str) -> KeyRow:
        """Revokes the key of this id, or the valid one of this name. Raises KeyProblem when there is none."""
        with self._session.begin() as session:
            named = select(KeyRow).where((KeyRow.id == wanted) | (KeyRow.name == wanted), KeyRow.revoked_at.is_(None))
            row = session.scalars(named.order_by(KeyRow.created_at.desc())).first()
            if row is None:
                raise KeyProblem(f"there is no key {wanted!r} that could be revoked")
            before = _shown(row)
            row.revoked_at = now()
            audit.record(session, "key_revoke", row.id, before=before, after=_shown(row))
        self._right.pop(row.id, None)
        return row

    def known(self, key: str) -> KeyRow | None:
        """The key's row if it was found right within the last moments: no database, no hashing."""
        seen = self._seen(key)
        if seen is None or self._wall() - seen.at > REVOKED_WITHIN_S or not valid(seen.row):
            return None
        return seen.row

    def was_right(self, key: str) -> bool:
        """Whether the key was found right before, so that it only has to be seen that it is not revoked."""
        return self._seen(key) is not None

    def _seen(self, key: str) -> _Right | None:
        seen = self._right.get(key_id_of(key) or "")
        return seen if seen is not None and hmac.compare_digest(seen.digest, _digest(key)) else None

    def last_valid(self, key_id: str) -> KeyRow | None:
        """The row of a key that was right, as the database had it last: for an abort while the database is away. None
        where that is longer ago than ABORTS_FOR_S, or the key has expired since."""
        right = self._right.get(key_id)
        if right is None or self._wall() - right.at > ABORTS_FOR_S or not valid(right.row):
            return None
        return right.row

    def still_valid(self, key_id: str) -> bool:
        """Whether a key that was checked before is valid now: for an answer that lasts. One query."""
        with self._session() as session:
            row = session.get(KeyRow, key_id)
        if row is None or not valid(row):
            self._right.pop(key_id, None)
            return False
        right = self._right.get(key_id)
        if right is not None and right.row.hash == row.hash:
            self._right[key_id] = _Right(right.digest, self._wall(), row)
        return True

    def name_of(self, key_id: str) -> str | None:
        """The name of the key with this id, also of one that is not valid; None: there is none. One query."""
        with self._session() as session:
            row = session.get(KeyRow, key_id)
        return None if row is None else row.name

    def check(self, key: str) -> KeyRow | None:
        """The row of a valid key, else None. One query, and a hash where no key of that id was found right before."""
        key_id = key_id_of(key)
        if key_id is None:
            return None
        with self._session() as session:
            row = session.get(KeyRow, key_id)
        if row is None or not valid(row):
            self._right.pop(key_id, None)
            return None
        right, digest = self._right.get(key_id), _digest(key)
        if right is not None and right.row.hash == row.hash:
            if not hmac.compare_digest(right.digest, digest):
                return None
        elif not matches(key, row.hash):
            return None
        self._right[key_id] = _Right(digest, self._wall(), row)
        return row


def valid(row: KeyRow) -> bool:
    """Neither revoked nor expired."""
    return row.revoked_at is None and (row.expires_at is None or row.expires_at > now())


def _shown(row: KeyRow) -> dict[str, str | None]:
    return {name: getattr(row, name) for name in ("name", "scope", "expires_at", "revoked_at")}


def _digest(key: str) -> bytes:
    return hashlib.sha256(key.encode()).digest()

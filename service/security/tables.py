"""Keys and the audit log. Times are UTC as ISO 8601 text."""

from __future__ import annotations

from typing import Any

from sqlalchemy import Index
from sqlalchemy.orm import Mapped, mapped_column

from loopwright.service.store.tables import Base


class KeyRow(Base):
    """An API key. Never deleted: the audit log names it."""

    __tablename__ = "api_keys"

    id: Mapped[str] = mapped_column(primary_key=True)
    name: Mapped[str]
    scope: Mapped[str]
    hash: Mapped[str]
    created_at: Mapped[str]
    expires_at: Mapped[str | None]
    revoked_at: Mapped[str | None]


class AuditRow(Base):
    """One change. who: the key's name, `local` or `cli:USER`; said_by: what the request itself claimed."""

    __tablename__ = "audit"
    __table_args__ = (Index("audit_by_loop", "loop", "number"),)

    number: Mapped[int] = mapped_column(primary_key=True, autoincrement=True)
    at: Mapped[str]
    who: Mapped[str]
    key_id: Mapped[str | None]
    address: Mapped[str | None]
    said_by: Mapped[str | None]
    what: Mapped[str]
    subject: Mapped[str]
    loop: Mapped[str | None]
    before: Mapped[dict[str, Any] | None]
    after: Mapped[dict[str, Any] | None]

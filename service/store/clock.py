"""Wall time as the tables hold it."""

from __future__ import annotations

from datetime import UTC, datetime


def now() -> str:
    """UTC, ISO 8601, milliseconds."""
    return stamp(datetime.now(UTC))


def stamp(at: datetime) -> str:
    """The text sorts as the time does."""
    return at.astimezone(UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")

"""What the gateways that share a PostgreSQL database say of themselves, each in a row of its own.

The clock is the database's: how old a row is does not depend on whose clock is wrong.
"""

from __future__ import annotations

from dataclasses import dataclass

from sqlalchemy import text

from loopwright.service.store.store import Store

NO_DATA_S, LOST_S = 3.0, 10.0
"""Age of a gateway's row, s, above which its values are too old to be shown, and above which it does not answer."""
FORGOTTEN_D = 30.0
"""Days after which the row of a gateway that has no loops any more is deleted."""


@dataclass(frozen=True, slots=True)
class GatewaySaid:
    """The row of a gateway.

    at_s: when it was written, seconds since 1970 UTC.  age_s: how long ago, s. Both by the clock of the database.
    present, settings: JSON, see service.live.snapshot.
    """

    name: str
    at_s: float
    age_s: float
    url: str | None
    version: str
    present: str
    settings: str


def write(store: Store, url: str | None, version: str, present: str, settings: str | None) -> None:
    """Writes the row of this gateway. Raises SQLAlchemyError, FolderInUse.

    settings: None: as they were written last.
    """
    values = {"name": store.host, "url": url, "version": version, "present": present, "settings": settings}
    with store.writing() as session:
        # The row of a second ago is no loss: its commit need not wait for the server's disk.
        session.execute(text("SET LOCAL synchronous_commit = off"))
        session.execute(_WRITE, values)


def every(store: Store) -> dict[str, GatewaySaid]:
    """Returns the rows of all gateways, by name. Raises SQLAlchemyError."""
    with store.reading() as session:
        return {row.name: GatewaySaid(*row) for row in session.execute(_EVERY)}


def loops_elsewhere(store: Store) -> dict[str, tuple[str, ...]]:
    """Returns the tags of the loops of each other gateway, sorted. Raises SQLAlchemyError."""
    found: dict[str, list[str]] = {}
    with store.reading() as session:
        for tag, host in session.execute(_LOOPS_ELSEWHERE, {"name": store.host}):
            found.setdefault(host, []).append(tag)
    return {host: tuple(tags) for host, tags in found.items()}


def age_s(store: Store, host: str) -> float | None:
    """Returns how old the row of a gateway is, s; None: it has none. Raises SQLAlchemyError."""
    with store.reading() as session:
        found = session.scalar(_AGE, {"name": host})
    return None if found is None else float(found)


def forget(store: Store) -> None:
    """Deletes the rows of gateways that have no loops and have not been there for FORGOTTEN_D days. Raises
    SQLAlchemyError, FolderInUse."""
    with store.writing() as session:
        session.execute(_FORGET, {"age_s": FORGOTTEN_D * 86_400.0})


def silent(name: str, age_s: float | None) -> str:
    """Returns in words that a gateway does not answer. age_s: of its row, s; None: it has none."""
    if age_s is None:
        return f"gateway {name} does not answer: it has not run since the database was brought to this version"
    return f"gateway {name} does not answer: it was last there {_ago(age_s)} ago"


def _ago(seconds: float) -> str:
    for unit, of_s in (("days", 86_400.0), ("h", 3600.0), ("min", 60.0)):
        if seconds >= 2.0 * of_s:
            return f"{seconds / of_s:.0f} {unit}"
    return f"{seconds:.0f} s"


NOW_S = "CAST(extract(epoch FROM clock_timestamp()) AS double precision)"
"""The clock of the database, seconds since 1970 UTC."""
_WRITE = text(
    "INSERT INTO gateways (name, at_s, url, version, present, settings)"
    f" VALUES (:name, {NOW_S}, :url, :version, :present, coalesce(:settings, '{{}}'))"
    " ON CONFLICT (name) DO UPDATE SET at_s = excluded.at_s, url = excluded.url, version = excluded.version,"
    " present = excluded.present, settings = coalesce(:settings, gateways.settings)"
)
_EVERY = text(f"SELECT name, at_s, {NOW_S} - at_s AS age_s, url, version, present, settings FROM gateways")
_LOOPS_ELSEWHERE = text("SELECT tag, host FROM loops WHERE host <> :name ORDER BY host, tag")
_AGE = text(f"SELECT {NOW_S} - at_s FROM gateways WHERE name = :name")
_FORGET = text(f"DELETE FROM gateways WHERE {NOW_S} - at_s > :age_s AND name NOT IN (SELECT host FROM loops)")

"""What of a data folder can be read, and a copy of it. Nothing in the folder is changed."""

from __future__ import annotations

import shutil
import sqlite3
import tempfile
from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path

from loopwright.protocol.durable import put_in_place
from loopwright.service.store.damage import read_log
from loopwright.service.store.database import ENGINE_FILE, FILE
from loopwright.service.store.lock import FolderInUse, FolderLock


class CheckProblem(Exception):
    """What was asked for cannot be done; the text says why."""


@dataclass
class FileReport:
    """Of one file. wrong: what is damaged in it.  rows: by table, how many can be read."""

    file: Path
    wrong: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    rows: dict[str, int] = field(default_factory=dict)


def check_data(data: Path) -> list[FileReport]:
    """Of our own database and the engine's file, as far as they are there. Raises CheckProblem, OSError."""
    if not (data / FILE).exists():
        raise CheckProblem(f"{data} is not a data folder of a service: it has no {FILE}")
    try:
        lock = FolderLock(data)
    except FolderInUse:  # it writes the log while we would look at it
        return [_check(data / name, at_rest=False) for name in (FILE, ENGINE_FILE) if (data / name).exists()]
    with closing(lock):
        return [_check(data / name, at_rest=True) for name in (FILE, ENGINE_FILE) if (data / name).exists()]


def salvage(data: Path, target: Path) -> dict[str, int]:
    """Copies every row of our database that can be read into a new file, for `loopwright restore`. Returns how many of
    each table. Raises CheckProblem, OSError, FolderInUse."""
    if target.exists():
        raise CheckProblem(f"{target} exists already: choose another name")
    with closing(FolderLock(data)), tempfile.TemporaryDirectory(dir=target.parent, prefix=".salvage-") as name:
        work = Path(name)
        for path in data.glob(f"{FILE}*"):  # SQLite writes the log into the file when it is opened
            shutil.copyfile(path, work / path.name)
        made = work / "salvaged"
        try:
            with closing(sqlite3.connect(work / FILE)) as old, closing(sqlite3.connect(made)) as new:
                copied = _copy(old, new)
        except sqlite3.Error as error:
            raise CheckProblem(f"nothing can be read of {data / FILE}: {error}") from error
        made.chmod(0o600)
        put_in_place(made, target)
    return copied


def _check(file: Path, at_rest: bool) -> FileReport:
    found = FileReport(file)
    there = set(file.parent.iterdir())
    if at_rest:
        log = read_log(file)
        if log.lost:
            found.wrong.append(
                f"the write-ahead log is broken after {log.frames} pages, {log.lost} later transactions cannot be read"
            )
        elif log.interrupted:
            found.notes.append("the last write was interrupted: nothing that was answered is missing")
    try:
        with closing(sqlite3.connect(f"{file.resolve().as_uri()}?mode=ro", uri=True, timeout=30.0)) as connection:
            told = connection.execute("PRAGMA integrity_check(10)")
            found.wrong += [row[0] for row in told if row[0] != "ok"]
            for table in _tables(connection):
                found.rows[table] = len(set(_row_ids(connection, table, found.wrong)))
    except sqlite3.Error as error:
        found.wrong.append(str(error))
    if at_rest:  # whoever looks may not be the service's user, who could not write to these
        for made in set(file.parent.glob(f"{file.name}-*")) - there:
            made.unlink()
    return found


def _tables(connection: sqlite3.Connection) -> list[str]:
    wanted = "SELECT name FROM sqlite_master WHERE type = 'table' AND name NOT LIKE 'sqlite_%' ORDER BY rowid"
    return [row[0] for row in connection.execute(wanted)]


def _row_ids(connection: sqlite3.Connection, table: str, wrong: list[str]) -> Iterator[int]:
    for row in _rows(connection, table, wrong):
        yield row[0]


def _rows(connection: sqlite3.Connection, table: str, wrong: list[str]) -> Iterator[tuple[int, ...]]:
    """From the first row up to where the table is damaged, then from the last row down to there."""
    for order in ("ASC", "DESC"):
        try:
            yield from connection.execute(f'SELECT rowid, * FROM "{table}" ORDER BY rowid {order}')
            return
        except sqlite3.Error as error:
            if order == "ASC":
                wrong.append(f"table {table}: {error}")


def _copy(old: sqlite3.Connection, new: sqlite3.Connection) -> dict[str, int]:
    schema = old.execute("SELECT type, sql FROM sqlite_master WHERE sql IS NOT NULL AND name NOT LIKE 'sqlite_%'")
    statements = sorted(schema, key=lambda row: row[0] != "table")
    copied: dict[str, int] = {}
    for kind, statement in statements:
        if kind == "table":
            new.execute(statement)
    for table in _tables(new):
        columns = [row[1] for row in new.execute(f'PRAGMA table_info("{table}")')]
        names, values = ", ".join(f'"{each}"' for each in ("rowid", *columns)), ", ".join("?" * (len(columns) + 1))
        # An integer primary key is the rowid itself, and is given twice.
        insert = f'INSERT OR IGNORE INTO "{table}" ({names}) VALUES ({values})'
        with new:
            for row in _rows(old, table, []):
                new.execute(insert, row)
        copied[table] = new.execute(f'SELECT count(*) FROM "{table}"').fetchone()[0]
    with new:
        # Events and samples of jobs that cannot be read are of no use to anybody.
        for table, row_id, *_ in new.execute("PRAGMA foreign_key_check").fetchall():
            copied[table] -= new.execute(f'DELETE FROM "{table}" WHERE rowid = ?', (row_id,)).rowcount
        for kind, statement in statements:
            if kind != "table":
                new.execute(statement)
    return copied

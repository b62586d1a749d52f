"""Back-up and restore of a data folder. A back-up is one SQLite file, checked, made while the service runs."""

from __future__ import annotations

import os
import shutil
import sqlite3
import tempfile
from contextlib import closing
from datetime import UTC, datetime
from pathlib import Path

from alembic.config import Config
from alembic.script import ScriptDirectory

from loopwright.protocol.durable import put_in_place, sync
from loopwright.service.store.database import FILE, never_released
from loopwright.service.store.lock import LOCK, FolderLock
from loopwright.service.store.store import Store


class BackupProblem(Exception):
    """The back-up or restore was not done; the text says why. Nothing was changed."""


def back_up(data: Path, target: Path, replace: bool = False) -> int:
    """Copies the database of a data folder, as of one moment, to `target`. Returns its size in bytes once it is on the
    disk.

    Raises BackupProblem, OSError.
    """
    source = data / FILE
    if not source.exists():
        raise BackupProblem(f"{data} is not a data folder of a service: it has no {FILE}")
    if os.path.lexists(target) and not target.is_file():
        raise BackupProblem(f"{target} is not a file that a back-up may take the place of: name a new file")
    if _is_of(data, target):
        raise BackupProblem(
            f"{target} is in the data folder {data}, or a link to a file there: a back-up would take the place of what "
            "the service writes; name a file elsewhere"
        )
    if target.exists() and (target.resolve().parent / LOCK).exists():
        raise BackupProblem(f"{target} is a file of another service's data folder: name a file elsewhere")
    if target.exists() and not replace:
        raise BackupProblem(f"{target} exists already; --replace writes over it")
    with tempfile.TemporaryDirectory(dir=target.parent, prefix=".backup-") as folder:
        copy = Path(folder) / target.name
        try:
            with closing(sqlite3.connect(source, timeout=30.0)) as live, closing(sqlite3.connect(copy)) as made:
                live.backup(made)
                # One file, without the two others that WAL needs.
                made.execute("PRAGMA journal_mode=DELETE")
        except sqlite3.Error as error:
            raise BackupProblem(f"{source}: {error}") from error
        _check(copy)
        copy.chmod(0o600)
        put_in_place(copy, target)
    return target.stat().st_size


def restore(source: Path, data: Path, replace: bool = False) -> tuple[int, Path | None]:
    """Makes a back-up the database of a data folder; jobs that were active in it end as interrupted.

    Returns how many those were, and where the files are that were there before. Raises BackupProblem, FolderInUse,
    OSError.
    """
    if not source.is_file():
        raise BackupProblem(f"{source} is not a file")
    _check(source)
    data.mkdir(mode=0o700, parents=True, exist_ok=True)
    # Held to the end: a service that starts meanwhile must not open half of it.
    with closing(FolderLock(data)), tempfile.TemporaryDirectory(dir=data, prefix=".restore-") as name:
        there = [path for path in sorted(data.iterdir()) if path.is_file() and path.name != LOCK]
        if there and not replace:
            raise BackupProblem(f"{data} has a database already; --replace keeps it aside and takes the back-up")
        made = Path(name)
        shutil.copyfile(source, made / FILE)
        store = Store(made)  # brings it to the present revision
        interrupted = store.restored(source.name)
        store.close()
        sync(made / FILE)
        aside = None
        if there:
            aside = data / f"replaced-{datetime.now(UTC):%Y%m%dT%H%M%S.%fZ}"
            aside.mkdir(mode=0o700)
            for path in there:
                path.rename(aside / path.name)
            sync(aside)
        (made / FILE).chmod(0o600)
        put_in_place(made / FILE, data / FILE)
        return interrupted, aside


def _is_of(data: Path, target: Path) -> bool:
    """Returns whether a path is in a data folder, or is a link, symbolic or hard, to a file in it."""
    folder = data.resolve()
    if any(path.is_relative_to(folder) for path in (target.parent.resolve(), target.resolve())):
        return True
    return target.exists() and any(target.samefile(path) for path in folder.iterdir() if path.is_file())


def _check(path: Path) -> None:
    """Raises BackupProblem unless it is a whole database of ours, of this version or an older one."""
    try:
        with closing(sqlite3.connect(f"{path.resolve().as_uri()}?mode=ro", uri=True)) as connection:
            wrong = [row[0] for row in connection.execute("PRAGMA integrity_check(3)") if row[0] != "ok"]
            revision = connection.execute("SELECT version_num FROM alembic_version").fetchone()
    except sqlite3.Error as error:
        raise BackupProblem(f"{path} is not a back-up of Loopwright: {error}") from error
    if wrong:
        raise BackupProblem(f"{path} is damaged: {'; '.join(wrong)}")
    if (refused := never_released(str(revision[0]) if revision else None)) is not None:
        raise BackupProblem(f"{path} {refused}")
    config = Config()
    config.set_main_option("script_location", "loopwright.service.store:migrations")
    known = {script.revision for script in ScriptDirectory.from_config(config).walk_revisions()}
    if revision is None or revision[0] not in known:
        raise BackupProblem(f"{path} was made by another version: its revision {revision and revision[0]} is not known")

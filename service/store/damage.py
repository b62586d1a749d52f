"""Damage of an SQLite file: found before the service works on it, and noticed while it does.

What SQLite itself lets pass is the write-ahead log: from the first frame whose checksum is wrong on it drops the rest
without a word, since an interrupted write looks so. Every transaction is on the disk before the next one is written,
though: where whole transactions come after such a frame, it was no interruption.
"""

from __future__ import annotations

import logging
import sqlite3
import struct
import threading
import time
from array import array
from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

from sqlalchemy import Engine, event
from sqlalchemy.engine import ExceptionContext

log = logging.getLogger(__name__)

AT_START_S = 10.0
"""So long the start waits for the check of a file; what takes longer goes on beside the service."""
_DAMAGE = (sqlite3.SQLITE_CORRUPT, sqlite3.SQLITE_NOTADB)
_STALE = (sqlite3.SQLITE_READONLY, sqlite3.SQLITE_IOERR, sqlite3.SQLITE_CANTOPEN)
_HEADER, _FRAME = 32, 24
_MAGIC = {0x377F0682: "<", 0x377F0683: ">"}
_WORD = 0xFFFFFFFF


def is_damage(error: BaseException | None) -> bool:
    """Whether an error of SQLite says that the file is not as it was written."""
    return isinstance(error, sqlite3.Error) and _code(error) in _DAMAGE


def way_out(file: Path, what: str) -> str:
    """What is the matter with a file, and what to do."""
    return (
        f"{file} is damaged ({what}). Stop the service; `loopwright check-data --data {file.parent}` says what of it "
        f"can be read; restore the last back-up: `loopwright restore FILE --data {file.parent} --replace`"
    )


# before the file is opened
@dataclass(frozen=True)
class Log:
    """What a write-ahead log holds. frames: that count.  lost: whole transactions behind a damaged frame, which SQLite
    would drop.  interrupted: the last transaction is not whole; whoever asked for it was told nothing, unless that
    is damage, too."""

    frames: int = 0
    lost: int = 0
    interrupted: bool = False


def read_log(file: Path) -> Log:
    """The log beside a database file; it is not changed."""
    path = file.with_name(file.name + "-wal")
    if not path.exists() or path.stat().st_size <= _HEADER + _FRAME:
        return Log()
    with path.open("rb") as opened:
        header = opened.read(_HEADER)
        magic, _, page, _, salt_1, salt_2, *stored = struct.unpack(">8I", header)
        order = _MAGIC.get(magic, "<")
        sums = _sums((0, 0), header[:24], order)
        whole = magic in _MAGIC and sums == tuple(stored)
        if not whole:  # SQLite leaves all of it out; its frames say themselves whether they were any
            page, (salt_1, salt_2) = _page_size(file), struct.unpack(">2I", opened.read(_FRAME)[8:16])
            opened.seek(_HEADER)
        return _read_frames(_frames(opened, page), (salt_1, salt_2), sums if whole else None, order)


def _read_frames(
    frames: Iterator[tuple[bytes, bytes]], salts: tuple[int, int], before: tuple[int, int] | None, order: str
) -> Log:
    """before: the sums that the first frame goes on from; None: the log's own header is damaged."""
    headless, count, pending, lost = before is None, 0, 0, 0
    broken, broken_ended = headless, headless
    for header, content in frames:
        _, commits, salt_1, salt_2, *sums = struct.unpack(">6I", header)
        if (salt_1, salt_2) != salts:  # a frame of an older log, or the end of this one
            broken, before = True, None
            continue
        stored = (sums[0], sums[1])
        good = before is not None and _sums(_sums(before, header[:8], order), content, order) == stored
        before = stored
        broken = broken or not good
        if not broken:
            pending += 1
        if commits:
            if not broken:
                count, pending = count + pending, 0
            elif broken_ended and (good or headless):
                lost += 1
            broken_ended = broken
    return Log(count, lost, interrupted=not lost and (broken_ended or pending > 0))


def _frames(opened: BinaryIO, page: int) -> Iterator[tuple[bytes, bytes]]:
    while len(header := opened.read(_FRAME)) == _FRAME and len(content := opened.read(page)) == page:
        yield header, content


def _sums(start: tuple[int, int], content: bytes, order: str) -> tuple[int, int]:
    """The log's running checksum."""
    words = array("I", content)
    if order == ">":
        words.byteswap()
    one, two = start
    for at in range(0, len(words), 2):
        one = (one + words[at] + two) & _WORD
        two = (two + words[at + 1] + one) & _WORD
    return one, two


def _page_size(file: Path) -> int:
    with file.open("rb") as opened:
        size = int.from_bytes(opened.read(18)[16:18], "big")
    return 65536 if size == 1 else size or 4096


class FileCheck:
    """SQLite's quick check of a file, in a thread. found: what is wrong, once it is through."""

    def __init__(self, file: Path) -> None:
        self.found: list[str] = []
        self._through = threading.Event()
        self._file = file
        # Read only: one that may write would bring the log into a damaged file as it is closed.
        self._connection = sqlite3.connect(f"{file.resolve().as_uri()}?mode=ro", uri=True, check_same_thread=False)
        self._thread = threading.Thread(target=self.run, name="file check", daemon=True)
        self._thread.start()

    def wait(self, timeout_s: float) -> bool:
        """False when it takes longer."""
        return self._through.wait(timeout_s)

    def close(self) -> None:
        """Breaks it off."""
        while not self._through.is_set():
            self._connection.interrupt()
            self._through.wait(0.1)

    def run(self) -> None:
        with closing(self._connection) as connection:
            try:
                self.found = [row[0] for row in connection.execute("PRAGMA quick_check(3)") if row[0] != "ok"]
            except sqlite3.Error as error:
                if is_damage(error):
                    self.found = [str(error)]
                elif _code(error) != sqlite3.SQLITE_INTERRUPT:
                    log.warning("%s could not be checked: %s", self._file, error)
        self._through.set()


class Damage:
    """What is known of the damage of one database, from its check and from every error since. file: None where it is
    not a file of ours, and whoever keeps it looks after it."""

    def __init__(self, file: Path | None) -> None:
        self._file = file
        self._check: FileCheck | None = None
        self._words: str | None = None

    def look(self, within_s: float = AT_START_S) -> str | None:
        """Looks at the file before it is opened. What is wrong with it, in words."""
        if self._file is None or not self._file.exists():
            return None
        began = time.monotonic()
        wal = read_log(self._file)
        if wal.lost:
            self._words = way_out(
                self._file,
                f"its write-ahead log is broken after {wal.frames} pages: {wal.lost} later transactions would be lost",
            )
            return self._words
        if wal.interrupted:
            log.warning("the last write to %s was interrupted: nothing that was answered is missing", self._file)
        self._check = FileCheck(self._file)
        if not self._check.wait(max(0.0, within_s - (time.monotonic() - began))):
            log.warning("the check of %s takes longer than %.0f s, it goes on beside the service", self._file, within_s)
        return self.words

    def watch(self, engine: Engine) -> None:
        """Notices what its errors say from now on."""
        event.listen(engine, "handle_error", self._heard)

    @property
    def words(self) -> str | None:
        """What is wrong, and what to do; None: nothing is known."""
        if self._words is None and self._check is not None and self._check.found and self._file is not None:
            self._words = way_out(self._file, "; ".join(self._check.found))
        return self._words

    def close(self) -> None:
        if self._check is not None:
            self._check.close()

    def _heard(self, context: ExceptionContext) -> None:
        error = context.original_exception
        if is_damage(error) and self._words is None and self._file is not None:
            self._words = way_out(self._file, str(error))
        # A connection that was opened while the disk could only be read stays so for ever.
        if isinstance(error, sqlite3.Error) and _code(error) in _STALE:
            context.is_disconnect = True


def _code(error: sqlite3.Error) -> int:
    """The primary result code."""
    return getattr(error, "sqlite_errorcode", 0) & 0xFF

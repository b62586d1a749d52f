"""Blocks of history on their way to the database, and a database that takes nothing for a while."""

from __future__ import annotations

import logging
import sqlite3
from collections.abc import Iterator
from contextlib import closing
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
from sqlalchemy.exc import OperationalError

from loopwright.service.jobs.retention import RetentionPolicy, delete_old_history
from loopwright.service.listening.block_writer import BlockWriter
from loopwright.service.store import history
from loopwright.service.store.history import HistoryBlock
from loopwright.service.store.store import Store
from loopwright.service.telemetry.metrics import HISTORY_BLOCKS_LOST
from tests.unit.service.processes import until

T0 = 1_769_860_800.0


def block(n: int, loop: str = "TIC-101") -> HistoryBlock:
    return HistoryBlock(loop, T0 + 60.0 * (n - 1) + 59.0 if n else None, T0 + 60.0 * n, T0 + 60.0 * n + 59.0, 15, b"x")


def stored(store: Store, loop: str = "TIC-101") -> list[HistoryBlock]:
    return [each for some in history.read(store, loop, T0, T0 + 1e6) for each in some]


def lost() -> float:
    return float(HISTORY_BLOCKS_LOST.collect()[0].samples[0].value)


@pytest.fixture
def writer(store: Store) -> Iterator[BlockWriter]:
    writer = BlockWriter(store, max_waiting=50, again_s=0.02)
    writer.start()
    yield writer
    writer.close()


def test_blocks_are_stored_and_read_in_order(store: Store, writer: BlockWriter) -> None:
    writer.put(block(n) for n in (2, 0, 1))
    writer.put([block(7, "TIC-102")])
    writer.close()
    assert stored(store) == [block(n) for n in range(3)]
    assert stored(store, "TIC-102") == [block(7, "TIC-102")]
    some = [each for page in history.read(store, "TIC-101", T0 + 60.0, T0 + 119.5) for each in page]
    assert some == [block(1)]


def test_more_blocks_than_a_page_are_all_read(store: Store) -> None:
    history.write(store, [block(n) for n in range(450)])
    assert stored(store) == [block(n) for n in range(450)]


def test_a_database_that_takes_nothing_costs_only_what_does_not_fit(
    store: Store, writer: BlockWriter, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """A full disk, or a locked file."""
    tried: list[int] = []
    real = history.write

    def full(_store: Store, blocks: list[HistoryBlock]) -> None:
        tried.append(len(blocks))
        raise OperationalError("INSERT", {}, sqlite3.OperationalError("database or disk is full"))

    monkeypatch.setattr(history, "write", full)
    before = lost()
    with caplog.at_level(logging.WARNING):
        writer.put(block(n) for n in range(40))
        until(lambda: len(tried) >= 3)
        writer.put(block(n) for n in range(40, 80))
        until(lambda: len(tried) >= 6)
    monkeypatch.setattr(history, "write", real)
    until(lambda: stored(store) and stored(store)[-1] == block(79))
    until(lambda: len(stored(store)) + lost() - before == 80)
    assert 30 <= lost() - before <= 70
    said = [record.getMessage() for record in caplog.records if "history" in record.getMessage()]
    assert len(said) == 1 and "database or disk is full" in said[0] and "everything else goes on" in said[0]


def test_a_locked_file_is_waited_for(tmp_path: Path) -> None:
    with closing(Store(tmp_path)) as store:
        other = sqlite3.connect(tmp_path / "loopwright.sqlite", isolation_level=None)
        other.execute("BEGIN IMMEDIATE")
        writer = BlockWriter(store, again_s=0.02)
        writer.start()
        writer.put([block(0)])
        assert stored(store) == []
        other.execute("COMMIT")
        other.close()
        until(lambda: stored(store) == [block(0)])
        writer.close()


def test_history_is_deleted_at_its_age_and_not_after_a_jump_of_the_clock(store: Store) -> None:
    history.write(store, [block(n) for n in range(2000)])
    at = datetime.fromtimestamp(T0 + 60.0 * 1500, UTC) + timedelta(days=7)
    policy = RetentionPolicy()
    assert delete_old_history(store, policy, at, ages_from=at - timedelta(days=1)) == 0
    assert delete_old_history(store, RetentionPolicy(history_days=None), at) == 0
    assert delete_old_history(store, policy, at) == 1500
    assert len(stored(store)) == 500 and stored(store)[0] == block(1500)

"""The width of the terminal of a test."""

from __future__ import annotations

import pytest

from loopwright.service.cli import terminal, tuning_tables


def columns(monkeypatch: pytest.MonkeyPatch, width: int) -> None:
    """Makes the terminal so wide: its consoles keep the width that they began with, which another test has set."""
    monkeypatch.setenv("COLUMNS", str(width))
    for console in (terminal.console, terminal.progress_console, tuning_tables.console):
        monkeypatch.setattr(console, "width", width)

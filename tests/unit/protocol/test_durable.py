"""What a power cut leaves of a file that is replaced: seen by what is synced, and in which order."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import pytest

from loopwright.protocol.durable import put_in_place


def test_the_file_is_synced_before_it_is_renamed_and_the_folder_after(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    done: list[str] = []
    fsync, replace = os.fsync, os.replace

    def synced(opened: int) -> None:
        done.append(f"sync {Path(os.readlink(f'/proc/self/fd/{opened}')).name}")
        fsync(opened)

    def renamed(*names: Any) -> None:
        done.append("rename")
        replace(*names)

    monkeypatch.setattr(os, "fsync", synced)
    monkeypatch.setattr(os, "replace", renamed)
    (tmp_path / "old").write_text("before")
    (tmp_path / "new").write_text("after")
    put_in_place(tmp_path / "new", tmp_path / "old")
    assert done == ["sync new", "rename", f"sync {tmp_path.name}"]
    assert (tmp_path / "old").read_text() == "after" and not (tmp_path / "new").exists()

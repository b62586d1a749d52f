"""What the controller keeps over a restart, a power cut and a full disk."""

from __future__ import annotations

import json
import os
import shutil
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import pytest

from loopwright.controller.__main__ import main
from loopwright.controller.channel import Mode
from loopwright.controller.device import RetainedState
from loopwright.controller.pid import Parameters
from loopwright.controller.retained_state import (
    FORM,
    FORM_1,
    RetainedStateError,
    RetainedStateFile,
    read_retained_state,
    write,
)

KEPT = [
    RetainedState(Parameters(2.5, 10.0, 1.0, 0.1, 0.8, 0.0), Mode.MANUAL, 51.5, 40.0),
    RetainedState(Parameters(0.7), Mode.OFF, 50.0, 0.0),
]
OTHER = [RetainedState(Parameters(3.0), Mode.AUTOMATIC, 49.0, 45.0), KEPT[1]]
START = [RetainedState(Parameters(1.0), Mode.AUTOMATIC, 50.0, 50.0)] * 2


@pytest.fixture
def file(tmp_path: Path) -> Path:
    return tmp_path / "kept.json"


def until(true: Callable[[], bool]) -> None:
    give_up = time.monotonic() + 60.0
    while not true():
        assert time.monotonic() < give_up
        time.sleep(0.001)


class TestFile:
    def test_what_was_kept_comes_back(self, file: Path) -> None:
        assert read_retained_state(file, START) is None
        write(file, OTHER)
        write(file, KEPT)
        assert read_retained_state(file, START) == KEPT
        assert [each.name for each in file.parent.iterdir()] == ["kept.json"]

    def test_a_file_of_the_first_form_holds_the_gains(self, file: Path) -> None:
        file.write_text(json.dumps({"form": FORM_1, "accepted": [{"Kp": 2.0, "Ti": 9.0}, {"Kp": 3.0}]}))
        assert read_retained_state(file, START) == [
            RetainedState(Parameters(2.0, 9.0), Mode.AUTOMATIC, 50.0, 50.0),
            RetainedState(Parameters(3.0), Mode.AUTOMATIC, 50.0, 50.0),
        ]

    @pytest.mark.parametrize(
        "text",
        [
            "",
            "{",
            "[]",
            '{"form": "other", "accepted": []}',
            '{"form": "loopwright controller 1", "accepted": [{"Kp": 1.0, "Ki": 2.0}]}',
            '{"form": "loopwright controller 1", "accepted": [{"Kp": NaN}]}',
            '{"form": "loopwright controller 1", "accepted": [{"Kp": "much"}]}',
            '{"form": "loopwright controller 1", "accepted": [{"Kp": 1}, {"Kp": 2}]}',
            '{"form": "loopwright controller 2"}',
            '{"form": "loopwright controller 2", "channels": [{"mode": "off"}]}',
            '{"form": "loopwright controller 2", "channels": [{"accepted": {"Kp": 1}, "mode": "experiment"}]}',
            '{"form": "loopwright controller 2", "channels": [{"accepted": {"Kp": 1}, "mode": "asleep"}]}',
            '{"form": "loopwright controller 2", "channels": [{"accepted": {"Kp": 1}, "setpoint": NaN}]}',
            '{"form": "loopwright controller 2", "channels": [{"accepted": {"Kp": 1}, "manual_output": Infinity}]}',
        ],
    )
    def test_one_that_makes_no_sense_stops_the_start(
        self, text: str, file: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        file.write_text(text)
        with pytest.raises(RetainedStateError, match="remove it to start with the values of the options"):
            read_retained_state(file, START[:1])
        assert main(["--bus", "virtual:x", "--keep", str(file)]) == 2
        assert str(file) in capsys.readouterr().err

    def test_a_full_disk_leaves_the_one_of_before(self, file: Path) -> None:
        write(file, KEPT)
        (file.parent / "kept.json.new").mkdir()
        with pytest.raises(OSError):
            write(file, OTHER)
        assert read_retained_state(file, START) == KEPT


class Disk:
    """What of a folder is on the disk: contents by a sync of the file, names by a sync of the folder."""

    def __init__(self, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        self.syncs = 0
        self.folder = folder
        self._contents: dict[int, bytes] = {}
        self._names: dict[str, int] = {}
        self._sync = os.fsync
        monkeypatch.setattr(os, "fsync", self._fsync)

    def _fsync(self, descriptor: int) -> None:
        self.syncs += 1
        self._sync(descriptor)
        inode = os.fstat(descriptor).st_ino
        if inode == self.folder.stat().st_ino:
            self._names = {each.name: each.stat().st_ino for each in self.folder.iterdir()}
        else:
            self._contents[inode] = Path(f"/proc/self/fd/{descriptor}").read_bytes()

    def after_power_cut(self) -> Path:
        """A copy of the folder as it is when the power is back."""
        copy = self.folder.with_name("after")
        shutil.rmtree(copy, ignore_errors=True)
        copy.mkdir()
        for name, inode in self._names.items():
            (copy / name).write_bytes(self._contents.get(inode, b""))
        return copy


@pytest.fixture
def disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Disk:
    folder = tmp_path / "disk"
    folder.mkdir()
    return Disk(folder, monkeypatch)


class TestPowerCut:
    def test_what_is_confirmed_survives_one(self, disk: Disk) -> None:
        file = disk.folder / "kept.json"
        for kept in (KEPT, OTHER):
            RetainedStateFile(file).write_now(kept)
            assert read_retained_state(disk.after_power_cut() / "kept.json", START) == kept
        assert disk.syncs == 4, "the file and its folder, each time"

    @pytest.mark.parametrize("missing", ["file", "folder"])
    def test_without_either_sync_it_would_not(self, disk: Disk, missing: str, monkeypatch: pytest.MonkeyPatch) -> None:
        """That the test above can fail."""
        file, sync = disk.folder / "kept.json", os.fsync
        write(file, KEPT)
        is_folder = disk.folder.stat().st_ino

        def forgetful(descriptor: int) -> None:
            if (os.fstat(descriptor).st_ino == is_folder) != (missing == "folder"):
                sync(descriptor)

        monkeypatch.setattr(os, "fsync", forgetful)
        write(file, OTHER)
        try:
            survived = read_retained_state(disk.after_power_cut() / "kept.json", START)
        except RetainedStateError:
            survived = None
        assert survived != OTHER


class SlowDisk:
    """Each writing waits until it is let go, or fails."""

    def __init__(self) -> None:
        self.go = threading.Semaphore(0)
        self.begun = 0
        self.written: list[Sequence[RetainedState]] = []
        self.full = False

    def __call__(self, path: Path, channels: Sequence[RetainedState]) -> None:
        self.begun += 1
        self.go.acquire()
        if self.full:
            raise OSError(28, "No space left on device")
        self.written.append(channels)


@pytest.fixture
def slow() -> Iterator[SlowDisk]:
    slow = SlowDisk()
    yield slow
    slow.go.release(1000)


@pytest.fixture
def keeper(slow: SlowDisk, file: Path) -> RetainedStateFile:
    return RetainedStateFile(file, slow, again_s=0.01)


class TestKeeper:
    def test_soon_waits_for_no_disk_and_the_last_one_counts(self, keeper: RetainedStateFile, slow: SlowDisk) -> None:
        keeper.write_soon(KEPT)
        until(lambda: slow.begun == 1)
        began = time.monotonic()
        for kept in (OTHER, KEPT, OTHER):
            keeper.write_soon(kept)
        assert time.monotonic() - began < 0.5
        slow.go.release(2)
        until(lambda: slow.written == [KEPT, OTHER])

    def test_now_is_written_when_it_returns_and_nothing_older_after_it(
        self, keeper: RetainedStateFile, slow: SlowDisk
    ) -> None:
        keeper.write_soon(START)
        until(lambda: slow.begun == 1)
        keeper.write_soon(KEPT)
        slow.go.release(2)
        keeper.write_now(OTHER)
        slow.go.release(10)
        assert slow.written == [START, OTHER]

    def test_what_a_full_disk_refused_is_written_when_there_is_room(
        self, keeper: RetainedStateFile, slow: SlowDisk, capsys: pytest.CaptureFixture[str]
    ) -> None:
        slow.full = True
        keeper.write_soon(KEPT)
        slow.go.release(1)
        until(lambda: slow.begun == 2)
        assert "No space left" in capsys.readouterr().err
        slow.full = False
        slow.go.release(1)
        until(lambda: slow.written == [KEPT])

    def test_what_a_full_disk_refused_is_not_written_over_a_later_acceptance(
        self, slow: SlowDisk, file: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        keeper = RetainedStateFile(file, slow, again_s=0.1)
        slow.full = True
        keeper.write_soon(KEPT)
        slow.go.release(1)
        until(lambda: "No space" in capsys.readouterr().err)
        slow.full = False
        slow.go.release(10)
        keeper.write_now(OTHER)
        time.sleep(0.3)
        assert slow.written == [OTHER]

    def test_an_acceptance_that_is_refused_loses_no_choice_of_before(self, slow: SlowDisk, file: Path) -> None:
        keeper = RetainedStateFile(file, slow, again_s=0.01)
        slow.full = True
        keeper.write_soon(START)
        until(lambda: slow.begun == 1)
        keeper.write_soon(KEPT)
        slow.go.release(2)
        with pytest.raises(OSError):
            keeper.write_now(OTHER)
        keeper.write_soon(KEPT)  # as the device does: the disk may have refused the very last step only
        slow.full = False
        slow.go.release(10)
        until(lambda: bool(slow.written))
        assert slow.written[-1] == KEPT

    def test_what_it_writes_is_the_file(self, file: Path) -> None:
        RetainedStateFile(file).write_soon(KEPT)
        until(file.exists)
        assert read_retained_state(file, START) == KEPT and json.loads(file.read_text())["form"] == FORM

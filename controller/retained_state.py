"""The state that the controller stores over a restart, in one JSON file: accepted gains, mode, set-point, manual
output.

The file is replaced as a whole, and file and folder are synced before an acceptance is confirmed: a set is never half
written, and a confirmed set is never lost by a power cut.
"""

from __future__ import annotations

import json
import sys
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from loopwright.controller.device import RetainedState
from loopwright.controller.pid import Parameters
from loopwright.protocol.durable import put_in_place
from loopwright.protocol.profile import Mode

FORM = "loopwright controller 2"
"""Form of the file."""
FORM_1 = "loopwright controller 1"
"""Earlier form of the file, with accepted gains only."""
AGAIN_S = 5.0
"""Wall time after which a failed write is repeated, s."""


class RetainedStateError(Exception):
    """Raised when the file exists but cannot be used; the text says what to do."""


def read_retained_state(path: Path, start: Sequence[RetainedState]) -> list[RetainedState] | None:
    """Returns the stored state of the channels, None when nothing has been stored yet. Raises RetainedStateError rather
    than guess.

    start: the initial state of the channels, which fills in what a file of an earlier form does not hold.
    """
    advice = "correct it, or remove it to start with the values of the options"
    try:
        text = json.loads(path.read_text(encoding="utf-8"))
        if text["form"] == FORM_1:
            rows = [{"accepted": row} for row in text["accepted"]]
        elif text["form"] == FORM:
            rows = text["channels"]
        else:
            raise ValueError(f"its form is {text['form']!r}, not {FORM!r}")
        if len(rows) != len(start):
            raise RetainedStateError(f"{path}: it keeps {len(rows)} channel(s), there are {len(start)}; {advice}")
        return [_retained(row, each) for row, each in zip(rows, start, strict=True)]
    except FileNotFoundError:
        return None
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise RetainedStateError(f"{path}: {error or type(error).__name__}; {advice}") from error


def _retained(row: dict[str, Any], start: RetainedState) -> RetainedState:
    accepted = Parameters(**{name: float(value) for name, value in row["accepted"].items()})
    mode = Mode[row["mode"].upper()] if "mode" in row else start.mode
    setpoint, output = float(row.get("setpoint", start.setpoint)), float(row.get("manual_output", start.manual_output))
    if mode is Mode.EXPERIMENT or setpoint - setpoint != 0.0 or output - output != 0.0:
        raise ValueError(f"no start with mode {mode.name.lower()}, set-point {setpoint}, manual output {output}")
    return RetainedState(accepted, mode, setpoint, output)


def write(path: Path, channels: Sequence[RetainedState]) -> None:
    """Writes the file; returns when it is on the disk.

    Raises OSError; the file then holds the previous state, or the new one where only the very last step failed, so the
    caller has to write the wanted state again.
    """
    rows = [
        {
            "accepted": asdict(each.accepted),
            "mode": each.mode.name.lower(),
            "setpoint": each.setpoint,
            "manual_output": each.manual_output,
        }
        for each in channels
    ]
    new = path.with_name(path.name + ".new")
    with new.open("w", encoding="utf-8") as file:
        file.write(json.dumps({"form": FORM, "channels": rows}, indent=2) + "\n")
    put_in_place(new, path)


class RetainedStateFile:
    """Writes the file, either at once or in a thread of its own, so that no sample waits for a disk. A failed write is
    repeated every `again_s` and with the next change."""

    def __init__(
        self, path: Path, write: Callable[[Path, Sequence[RetainedState]], None] = write, again_s: float = AGAIN_S
    ) -> None:
        self._path = path
        self._write = write
        self._again_s = again_s
        self._disk = threading.Lock()
        self._changed = threading.Condition()
        self._wanted: Sequence[RetainedState] | None = None
        """The state requested last; nothing older is written after it."""
        self._waiting: Sequence[RetainedState] | None = None
        threading.Thread(target=self._run, name="retained state", daemon=True).start()

    def write_now(self, channels: Sequence[RetainedState]) -> None:
        with self._changed:
            self._wanted, self._waiting = channels, None
        with self._disk:
            self._write(self._path, channels)

    def write_soon(self, channels: Sequence[RetainedState]) -> None:
        with self._changed:
            self._wanted = self._waiting = channels
            self._changed.notify()

    def _run(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._waiting is not None)
            with self._disk:
                with self._changed:
                    channels, self._waiting = self._waiting, None
                if channels is None:
                    continue
                try:
                    self._write(self._path, channels)
                    continue
                except OSError as error:
                    print(f"controller: mode and set-point could not be stored: {error}", file=sys.stderr)
            time.sleep(self._again_s)
            with self._changed:
                if self._wanted is channels:
                    self._waiting = channels

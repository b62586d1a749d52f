"""What the controller keeps over a restart: the accepted set of each channel, in one JSON file.

The file is replaced whole and is on the disk before an acceptance is confirmed: a set is never half written, and none
is called accepted that a power cut would lose.
"""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

from controller.pid import Parameters

FORM = "loopwright controller 1"


class KeptError(Exception):
    """The file is there but cannot be used; the text says what to do."""


def remembered(path: Path, channels: int) -> list[Parameters] | None:
    """The accepted sets, None when nothing has been kept yet. Raises KeptError rather than guess at gains."""
    advice = "correct it, or remove it to start with the gains of the options"
    try:
        kept = json.loads(path.read_text(encoding="utf-8"))
        if kept["form"] != FORM:
            raise ValueError(f"its form is {kept['form']!r}, not {FORM!r}")
        sets = [Parameters(**{name: float(value) for name, value in row.items()}) for row in kept["accepted"]]
    except FileNotFoundError:
        return None
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise KeptError(f"{path}: {error or type(error).__name__}; {advice}") from error
    if len(sets) != channels:
        raise KeptError(f"{path}: it keeps {len(sets)} channel(s), there are {channels}; {advice}")
    return sets


def keep(path: Path, accepted: Sequence[Parameters]) -> None:
    """Raises OSError; the file is then the one of before."""
    text = json.dumps({"form": FORM, "accepted": [asdict(each) for each in accepted]}, indent=2)
    new = path.with_name(path.name + ".new")
    with new.open("w", encoding="utf-8") as file:
        file.write(text + "\n")
        file.flush()
        os.fsync(file.fileno())
    new.replace(path)

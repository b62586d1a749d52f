"""Many independent runs of a benchmark, on several processes, with a file that a stopped benchmark goes on from.

The file has a line of JSON for each run.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict
from multiprocessing import get_context
from pathlib import Path
from typing import Any, ClassVar, Protocol, TypeVar

from benchmarks.plants import Plant

Draw = tuple[Plant, str, str, int]
"""Plant, kind of present gains, kind of case, seed."""
DrawNames = tuple[str, str, str, int]
"""The names of a draw: that of the plant, and as above."""


class SavedRun(Protocol):
    """What a run has found: a dataclass of values that JSON has."""

    __dataclass_fields__: ClassVar[dict[str, Any]]


class DrawnRun(SavedRun, Protocol):
    """What the run of a draw has found."""

    @property
    def draw(self) -> DrawNames:
        """Of which draw it is."""


Saved = TypeVar("Saved", bound=SavedRun)
Ran = TypeVar("Ran", bound=DrawnRun)


def saved(kind: type[Saved], file: Path | None) -> list[Saved]:
    """The runs of a file; none without a file. A last line that is not whole, of a run that was cut off, does not
    count."""
    if file is None or not file.exists():
        return []
    return [kind(**json.loads(text)) for text in file.read_text().split("\n")[:-1]]


def run_all(
    kind: type[Ran], measure: Callable[[Draw], Ran], draws: Sequence[Draw], file: Path | None, processes: int
) -> Iterator[Ran]:
    """The runs of these draws: first those that the file has, then the others as they end, each added to the file."""
    found = saved(kind, file)
    if file and file.exists():
        file.write_text("".join(_line(each) for each in found))
    done = {each.draw: each for each in found}
    todo = []
    for draw in draws:
        if (ran := done.get((draw[0].name, *draw[1:]))) is None:
            todo.append(draw)
        else:
            yield ran
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # before numpy is imported, as in the service's own processes
    with get_context("spawn").Pool(processes) as pool:
        for ran in pool.imap_unordered(measure, todo):
            yield kept(ran, file)


def kept(ran: Saved, file: Path | None) -> Saved:
    """The run, added to the file."""
    if file:
        with file.open("a") as out:
            out.write(_line(ran))
    return ran


def _line(ran: SavedRun) -> str:
    return f"{json.dumps(asdict(ran))}\n"

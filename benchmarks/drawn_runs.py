"""Many independent runs of a benchmark, on several processes, with a file that a stopped benchmark goes on from.

A run is of a plant, its present gains, a kind of case and a seed. The file has a line of JSON for each run.
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


class DrawnRun(Protocol):
    """What a run has found: a dataclass whose first four fields say which run it is, the plant by its name."""

    __dataclass_fields__: ClassVar[dict[str, Any]]


Ran = TypeVar("Ran", bound=DrawnRun)


def saved(kind: type[Ran], file: Path) -> list[Ran]:
    """The runs of a file. A last line that is not whole, of a run that was cut off, does not count."""
    if not file.exists():
        return []
    return [kind(**json.loads(text)) for text in file.read_text().split("\n")[:-1]]


def run_all(
    kind: type[Ran], measure: Callable[[Draw], Ran], draws: Sequence[Draw], file: Path | None, processes: int
) -> Iterator[Ran]:
    """The runs of these draws: first those that the file has, then the others as they end, each added to the file."""
    found = saved(kind, file) if file else []
    if file and file.exists():
        file.write_text("".join(_line(each) for each in found))
    done = {tuple(asdict(each).values())[:4]: each for each in found}
    todo = []
    for draw in draws:
        if (ran := done.get((draw[0].name, *draw[1:]))) is None:
            todo.append(draw)
        else:
            yield ran
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # before numpy is imported, as in the service's own processes
    with get_context("spawn").Pool(processes) as pool:
        for ran in pool.imap_unordered(measure, todo):
            if file:
                with file.open("a") as out:
                    out.write(_line(ran))
            yield ran


def _line(ran: DrawnRun) -> str:
    return f"{json.dumps(asdict(ran))}\n"

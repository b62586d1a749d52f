"""Histories side by side: each is one thread, each core has a process."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context

from tests.simulation import every_call as every_call_of_one_job
from tests.simulation.history import Ending
from tests.simulation.kinds import play

_CHUNK = 10


def run(todo: Sequence[tuple[str, int]], processes: int) -> Iterator[Ending]:
    """In their order."""
    if processes <= 1:
        for kind, seed in todo:
            yield play(kind, seed)
        return
    with ProcessPoolExecutor(processes, get_context("fork"), begin) as pool:
        yield from pool.map(_play, todo, chunksize=_CHUNK)


def every_call(restarts_s: tuple[float, ...], processes: int, that_differ: bool = False) -> Iterator[Ending]:
    """The job that does everything, killed at each of its calls of the bus. that_differ: at those alone before which
    something was sent or stored, each with one restart."""
    with ProcessPoolExecutor(processes, get_context("fork"), begin) as pool:
        todo = pool.submit(_todo, restarts_s, that_differ).result()
        if that_differ:
            todo = [todo[at + at // len(restarts_s) % len(restarts_s)] for at in range(0, len(todo), len(restarts_s))]
        yield from pool.map(every_call_of_one_job.play, todo, chunksize=_CHUNK)


def _todo(restarts_s: tuple[float, ...], that_differ: bool) -> list[tuple[int, float]]:
    return list(every_call_of_one_job.todo(restarts_s, that_differ))


def begin() -> None:
    logging.disable(logging.CRITICAL)


def _play(which: tuple[str, int]) -> Ending:
    return play(*which)

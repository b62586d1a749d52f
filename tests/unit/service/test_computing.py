"""Who computes, in what order, and what becomes of a computation whose test has ended or whose worker has died."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from service.computing import Computing, Workers
from tests.unit.service.fakes import FakeController, FakeLoop
from tuning.plan import Work
from tuning.reasons import Reason, Refused


def test_what_waits_for_its_turn_is_dropped_when_the_test_ends() -> None:
    over, running, begun = threading.Event(), threading.Event(), threading.Event()

    def first() -> None:
        running.set()
        assert over.wait(5)

    Computing(FakeLoop(FakeController())).start(Work(first))
    assert running.wait(5)
    aborted = Computing(FakeLoop(FakeController()))
    aborted.start(Work(begun.set))
    aborted.restore(aborted.read())
    over.set()
    assert aborted._idle.wait(5)
    assert not begun.is_set()


def test_computations_of_several_loops_take_turns() -> None:
    over, running, second_began = threading.Event(), threading.Event(), threading.Event()

    def first() -> None:
        running.set()
        assert over.wait(5)

    Computing(FakeLoop(FakeController())).start(Work(first))
    assert running.wait(5)
    Computing(FakeLoop(FakeController())).start(Work(second_began.set))
    assert not second_began.wait(0.1)
    over.set()
    assert second_began.wait(5)


def refuse() -> None:
    raise Refused(Reason.NOT_ROBUST, "Ms 3")


def kill(own: int) -> int:
    """The worker's end, or the answer where there is no worker any more."""
    if os.getpid() != own:
        os.kill(os.getpid(), signal.SIGKILL)
    return os.getpid()


def done(work: Work[Any], workers: Workers) -> Any:
    computing = Computing(FakeLoop(FakeController()), workers)
    computing.start(work)
    assert computing._idle.wait(20) and work.done
    return work.result()


class TestWorkers:
    @pytest.fixture
    def workers(self) -> Iterator[Workers]:
        workers = Workers(2)
        yield workers
        workers.close()

    def test_another_process_computes(self, workers: Workers) -> None:
        assert done(Work(os.getpid), workers) != os.getpid()

    def test_what_it_raises_is_raised_here(self, workers: Workers) -> None:
        with pytest.raises(Refused, match="Ms 3") as refused:
            done(Work(refuse), workers)
        assert refused.value.reason is Reason.NOT_ROBUST

    def test_what_cannot_be_sent_is_said(self, workers: Workers) -> None:
        with pytest.raises(Exception, match="pickle"):
            done(Work(lambda: 1), workers)

    def test_after_the_death_of_one_all_is_computed_here(self, workers: Workers) -> None:
        for _ in range(2):
            assert done(Work(partial(kill, os.getpid())), workers) == os.getpid()

    def test_so_is_what_waited_behind_that_of_a_test_that_has_ended(self, workers: Workers) -> None:
        loops = [Computing(FakeLoop(FakeController()), workers) for _ in range(8)]
        works: list[Work[Any]] = [Work(partial(time.sleep, 0.2)) for _ in loops[1:]]
        loops[0].start(Work(partial(time.sleep, 60.0)))
        for loop, work in zip(loops[1:], works, strict=True):
            loop.start(work)
        ended = loops[0], loops[-2]
        for loop in ended:
            loop.restore(loop.read())
        os.kill(next(iter(workers._pool._processes)), signal.SIGKILL)
        for loop, work in zip(loops[1:], works, strict=True):
            assert loop._idle.wait(20) and (work.done or loop in ended)

    def test_signals_to_the_whole_group_leave_them_alone(self, workers: Workers) -> None:
        worker = done(Work(os.getpid), workers)
        for number in (signal.SIGINT, signal.SIGTERM):
            os.kill(worker, number)
        assert done(Work(os.getpid), workers) != os.getpid()


LEFT_BEHIND = """
import os, signal, time
from service.computing import Workers
workers = Workers(1)
print(workers.submit(os.getpid).result(), flush=True)
time.sleep(60)
"""


def test_they_end_with_a_service_that_is_killed() -> None:
    with subprocess.Popen([sys.executable, "-c", LEFT_BEHIND], stdout=subprocess.PIPE, text=True) as service:
        assert service.stdout is not None
        worker = Path("/proc") / service.stdout.readline().strip()
        assert worker.exists()
        service.kill()
        service.stdout.read()  # the end of it is the end of all who could write there
    give_up = time.monotonic() + 10
    with suppress(FileNotFoundError):
        while "zombie" not in (worker / "status").read_text():
            assert time.monotonic() < give_up
            time.sleep(0.01)

"""Who computes, in what order, and what becomes of a computation that does not come to its end."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import closing
from functools import partial
from multiprocessing.context import ForkServerProcess
from pathlib import Path
from typing import Any

import pytest

from loopwright.protocol.bus import open_bus
from loopwright.protocol.hub import Hub
from loopwright.service.execution.beside import ComputingLoop
from loopwright.service.execution.computing.limits import ComputationKind, ComputingLimits
from loopwright.service.execution.computing.pool import NoProcess, NotWanted, Pool
from loopwright.service.store.store import Store
from loopwright.tuning.plan import Work
from loopwright.tuning.reasons import Failed, Reason, Refused
from tests.unit.service.computations import (
    ask_for,
    burn,
    count,
    die,
    die_once,
    modules,
    own_files,
    refuse,
    tell_and_die,
    tell_numbers,
)
from tests.unit.service.fakes import FakeController, FakeLoop
from tests.unit.service.processes import gone, until


@pytest.fixture(scope="module")
def pool() -> Iterator[Pool]:
    with closing(
        Pool(ComputingLimits(live_cpu_s=60, tuning_cpu_s=1, dry_run_cpu_s=60, memory_mb=100), max_workers=1)
    ) as pool:
        yield pool


class TestBesideALoop:
    """Without processes: the service computes itself."""

    def test_what_waits_for_its_turn_is_dropped_when_the_test_ends(self) -> None:
        over, running, begun = threading.Event(), threading.Event(), threading.Event()

        def first() -> None:
            running.set()
            assert over.wait(5)

        ComputingLoop(FakeLoop(FakeController())).start(Work(first))
        assert running.wait(5)
        aborted = ComputingLoop(FakeLoop(FakeController()))
        aborted.start(Work(begun.set))
        aborted.restore(aborted.read())
        over.set()
        assert aborted.idle.wait(5)
        assert not begun.is_set()

    def test_computations_of_several_loops_take_turns(self) -> None:
        over, running, second_began = threading.Event(), threading.Event(), threading.Event()

        def first() -> None:
            running.set()
            assert over.wait(5)

        ComputingLoop(FakeLoop(FakeController())).start(Work(first))
        assert running.wait(5)
        ComputingLoop(FakeLoop(FakeController())).start(Work(second_began.set))
        assert not second_began.wait(0.1)
        over.set()
        assert second_began.wait(5)


def done(work: Work[Any], pool: Pool) -> Any:
    computing = ComputingLoop(FakeLoop(FakeController()), pool)
    computing.start(work)
    assert computing.idle.wait(60) and work.done
    return work.result()


class TestPool:
    def test_another_process_computes(self, pool: Pool) -> None:
        assert done(Work(os.getpid), pool) != os.getpid()

    def test_it_finds_everything_loaded(self, pool: Pool) -> None:
        wanted = {
            "loopwright.tuning.five_stage.procedure",
            "loopwright.tuning.fast.known_plant.design_trial",
            "loopwright.service.offline.tunings",
            "loopwright.service.jobs.alternatives",
            "loopwright.service.execution.rehearsal",
        }
        assert wanted <= pool.run(ComputationKind.TUNING, modules)

    def test_what_it_raises_is_raised_here(self, pool: Pool) -> None:
        with pytest.raises(Refused, match="Ms 3") as refused:
            done(Work(refuse), pool)
        assert refused.value.reason is Reason.NOT_ROBUST

    def test_what_cannot_be_sent_is_said(self, pool: Pool) -> None:
        with pytest.raises(Exception, match="pickle"):
            done(Work(lambda: 1), pool)

    def test_what_cannot_be_sent_back_is_said(self, pool: Pool) -> None:
        with pytest.raises(Exception, match="pickle"):
            done(Work(threading.Lock), pool)

    def test_reports_come_in_order_before_the_result(self, pool: Pool) -> None:
        heard: list[int] = []
        assert pool.run(ComputationKind.DRY_RUN, partial(tell_numbers, 1000), on_report=heard.append) == "told"
        assert heard == list(range(1000))

    def test_who_hears_may_end_it(self, pool: Pool) -> None:
        def hear(n: int) -> None:
            raise Refused(Reason.NOT_ROBUST, f"heard {n}")

        with pytest.raises(Refused, match="heard 0"):
            pool.run(ComputationKind.DRY_RUN, partial(tell_numbers, 10**9), on_report=hear)


class TestLimits:
    def test_processor_time(self, pool: Pool) -> None:
        with pytest.raises(Failed, match="the tuning was ended after 1 s of processor time") as over:
            pool.run(ComputationKind.TUNING, burn)
        assert over.value.reason is Reason.COMPUTATION_LIMIT and "--tuning-cpu-s" in over.value.detail

    def test_those_of_a_live_loop_end_its_plan_by_name(self) -> None:
        with closing(Pool(ComputingLimits(live_cpu_s=1), max_workers=1)) as pool:
            with pytest.raises(Failed, match="--live-cpu-s") as over:
                done(Work(burn), pool)
            assert over.value.reason is Reason.COMPUTATION_LIMIT

    @pytest.mark.skipif(sys.platform != "linux", reason="the system does not count it")
    def test_memory(self, pool: Pool) -> None:
        assert pool.run(ComputationKind.TUNING, partial(ask_for, 50)) == 50 << 20
        with pytest.raises(Failed, match="asked for more than 100 MB of memory") as over:
            pool.run(ComputationKind.TUNING, partial(ask_for, 150))
        assert over.value.reason is Reason.COMPUTATION_LIMIT and "--computation-memory-mb" in over.value.detail


class TestDeath:
    def test_it_is_computed_once_more(self, pool: Pool, tmp_path: Path) -> None:
        assert done(Work(partial(die_once, tmp_path / "died")), pool) == 7

    def test_but_not_for_ever(self, pool: Pool) -> None:
        with pytest.raises(Failed, match="was killed") as lost:
            done(Work(die), pool)
        assert lost.value.reason is Reason.COMPUTATION_LOST

    def test_what_has_told_something_does_not_begin_anew(self, pool: Pool) -> None:
        heard: list[int] = []
        with pytest.raises(Failed, match="was killed"):
            pool.run(ComputationKind.DRY_RUN, tell_and_die, on_report=heard.append)
        assert heard == [1]

    def test_of_the_fork_server_too(self, pool: Pool) -> None:
        def parent_of(pid: int) -> int:
            return int(Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[1])

        server = pool.run(ComputationKind.LIVE, os.getppid)
        assert parent_of(server) == os.getpid()
        os.kill(server, signal.SIGKILL)
        assert done(Work(os.getpid), pool) != os.getpid()

    def test_where_no_process_can_be_made_the_service_computes_for_its_loops_alone(
        self, pool: Pool, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
    ) -> None:
        def full(_process: object) -> None:
            raise BlockingIOError(11, "Resource temporarily unavailable")

        monkeypatch.setattr(ForkServerProcess, "start", full)
        assert done(Work(os.getpid), pool) == os.getpid()
        assert "the service computes in its own process" in caplog.text
        with pytest.raises(NoProcess, match="no process can be made for the tuning"):
            pool.run(ComputationKind.TUNING, os.getpid)


class TestOrder:
    def test_a_live_loop_does_not_wait_behind_what_runs(self, pool: Pool, tmp_path: Path) -> None:
        """The dry run pauses meanwhile, and goes on behind it."""
        ticks, over = tmp_path / "ticks", tmp_path / "over"
        rehearsal = pool.submit(ComputationKind.DRY_RUN, partial(count, ticks, over))
        until(ticks.exists)
        live_ticks, live_over = tmp_path / "live", tmp_path / "live-over"
        live = pool.submit(ComputationKind.LIVE, partial(count, live_ticks, live_over))
        until(live_ticks.exists)

        def stands() -> bool:
            before, seen = ticks.read_text(), live_ticks.read_text()
            until(lambda: live_ticks.read_text() != seen)
            return before == ticks.read_text()

        until(stands)
        paused_at = ticks.read_text()
        tuning = pool.submit(ComputationKind.TUNING, os.getpid)
        assert not tuning.done() and stands() and paused_at == ticks.read_text()
        live_over.touch()
        assert live.result(60) == "counted"
        assert tuning.result(60) != os.getpid()
        until(lambda: ticks.read_text() != paused_at)
        over.touch()
        assert rehearsal.result(60) == "counted"

    def test_what_nobody_wants_any_more_gives_its_place_free(self, pool: Pool, tmp_path: Path) -> None:
        ended, mark = threading.Event(), tmp_path / "mark"
        running = pool.submit(ComputationKind.LIVE, partial(burn, mark), ended.is_set)
        waiting = pool.submit(ComputationKind.LIVE, burn, ended.is_set)
        until(lambda: mark.exists() and mark.read_text() != "")
        ended.set()
        for future in (running, waiting):
            with pytest.raises(NotWanted):
                future.result(60)
        assert gone(int(mark.read_text()))
        assert pool.run(ComputationKind.DRY_RUN, partial(ask_for, 1)) == 1 << 20

    def test_so_does_the_computation_of_a_test_that_has_ended(self, pool: Pool, tmp_path: Path) -> None:
        mark = tmp_path / "mark"
        computing = ComputingLoop(FakeLoop(FakeController()), pool)
        computing.start(Work(partial(burn, mark)))
        until(lambda: mark.exists() and mark.read_text() != "")
        computing.restore(computing.read())
        assert computing.idle.wait(60) and gone(int(mark.read_text()))


class TestEnd:
    def test_closing_ends_and_waits(self, tmp_path: Path) -> None:
        mark = tmp_path / "mark"
        ends, pool = [], Pool(max_workers=1)
        ends.append(pool.submit(ComputationKind.LIVE, partial(burn, mark)))
        ends.append(pool.submit(ComputationKind.DRY_RUN, os.getpid))
        until(lambda: mark.exists() and mark.read_text() != "")
        pool.close()
        assert gone(int(mark.read_text()))
        for each in ends:
            assert isinstance(each.exception(60), NotWanted)
        with pytest.raises(NotWanted):
            pool.run(ComputationKind.LIVE, os.getpid)

    def test_signals_to_the_whole_group_leave_it_alone(self, pool: Pool, tmp_path: Path) -> None:
        ticks, over = tmp_path / "ticks", tmp_path / "over"
        running = pool.submit(ComputationKind.LIVE, partial(count, ticks, over))
        until(ticks.exists)
        server = [int(each) for each in children_of(os.getpid())]
        for each in server + [int(child) for parent in server for child in children_of(parent)]:
            os.kill(each, signal.SIGINT)
            os.kill(each, signal.SIGTERM)
        before = ticks.read_text()
        until(lambda: ticks.read_text() != before)
        over.touch()
        assert running.result(60) == "counted"


def children_of(pid: int) -> list[str]:
    return Path(f"/proc/{pid}/task/{pid}/children").read_text().split()


@pytest.mark.parametrize("first", [True, False], ids=["made-before", "made-after"])
def test_a_computation_has_no_file_and_no_socket_of_the_service(tmp_path: Path, first: bool) -> None:
    if first:
        with closing(Pool()) as early:
            early.run(ComputationKind.LIVE, os.getpid)
    hub = Hub(0)
    serving = threading.Thread(target=hub.serve)
    serving.start()
    try:
        with (
            closing(open_bus(hub.url)),
            socket.create_server(("127.0.0.1", 0)),
            closing(Store(tmp_path)) as store,
            closing(Pool()) as pool,
        ):
            assert store.unfinished() == []  # it has its file open
            ours = {name for name in own_files() if name.startswith("socket:") or str(tmp_path) in name}
            theirs = set(pool.run(ComputationKind.LIVE, own_files))
            assert len(ours) >= 5 and not ours & theirs
    finally:
        hub.stop()
        serving.join()


LEFT_BEHIND = """
import sys
import time
from functools import partial
from pathlib import Path
from loopwright.service.execution.computing.limits import ComputationKind
from loopwright.service.execution.computing.pool import Pool
from tests.unit.service.computations import burn
pool = Pool(max_workers=1)
pool.submit(ComputationKind.DRY_RUN, partial(burn, Path(sys.argv[1])))
while not (Path(sys.argv[1]).exists() and Path(sys.argv[1]).read_text()):
    time.sleep(0.01)
if len(sys.argv) > 2:
    pool.submit(ComputationKind.LIVE, partial(burn, Path(sys.argv[2])))
print("ready", flush=True)
sys.stdin.read()
"""


@pytest.mark.parametrize("paused", [False, True], ids=["running", "paused"])
def test_they_end_with_a_service_that_is_killed(tmp_path: Path, paused: bool) -> None:
    marks = [tmp_path / "rehearsal", tmp_path / "live"][: 1 + paused]
    command = [sys.executable, "-c", LEFT_BEHIND, *map(str, marks)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as service:
        assert service.stdout is not None and service.stdout.readline() == "ready\n"
        until(lambda: all(mark.exists() and mark.read_text() for mark in marks))
        service.kill()
        service.stdout.read()  # the end of it is the end of all who could write there
    until(lambda: all(gone(int(mark.read_text())) for mark in marks))

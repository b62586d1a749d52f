"""A gateway: the real jobs, recovery, store and bus loop as a process that is killed and started again.

Its store is a SQLite file that outlives the process; what was not committed at a kill is rolled back. The engine is a
stand-in that remembers, as the real one does, which jobs it has been given and has not run to their end.
"""

from __future__ import annotations

import math
import shutil
import tempfile
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager
from multiprocessing.util import Finalize
from pathlib import Path
from typing import Any, TypeVar

from sqlalchemy import event, text

from loopwright.protocol.fair_lock import FairLock
from loopwright.protocol.station import Station
from loopwright.service.execution.procedures import Tune
from loopwright.service.inputs.config import LoopConfig
from loopwright.service.jobs.machine import Machine
from loopwright.service.jobs.manager import Jobs
from loopwright.service.loops.bus_reading import BusReading
from loopwright.service.loops.loop import Loop
from loopwright.service.server.assembly import make_jobs
from loopwright.service.states.job_state import ACTIVE, JobState
from loopwright.service.states.loop_state import LoopState
from loopwright.service.store.jobs import Job
from loopwright.service.store.store import Store, WithJob
from loopwright.service.store.tables import Base
from tests.simulation.scheduler import Killed, Process, Simulation, Task
from tests.simulation.wire import Port, Wire

T = TypeVar("T")


class Lock:
    """What a thread's lock is to tasks: who waits, waits in simulated time."""

    def __init__(self, simulation: Simulation) -> None:
        self._simulation = simulation
        self._taken = False

    def acquire(self, blocking: bool = True, timeout: float = -1.0) -> bool:
        give_up = None if timeout < 0 else self._simulation.now + timeout
        while self._taken:
            if give_up is not None and self._simulation.now >= give_up:
                return False
            assert self._simulation.task is not None
            self._simulation.task.pause(0.005)
        self._taken = True
        return True

    def release(self) -> None:
        self._taken = False

    def __enter__(self) -> bool:
        return self.acquire()

    def __exit__(self, *_: object) -> None:
        self.release()


class SimFairLock(FairLock):
    def __init__(self, simulation: Simulation) -> None:
        self._lock = Lock(simulation)

    @contextmanager
    def take(self, urgent: bool = False, meanwhile: Callable[[], object] = lambda: None) -> Iterator[None]:
        while not self._lock.acquire(timeout=0.05):
            meanwhile()
        try:
            yield
        finally:
            self._lock.release()


class SimStation(Station):
    """The station of a process, with locks that its tasks can wait for."""

    def __init__(self, wire: Wire, process: Process, node: int, rate: float = 1.0) -> None:
        simulation = wire.simulation

        def sleep(seconds: float) -> None:
            process.step("sleep")
            assert simulation.task is not None
            simulation.task.pause(seconds)

        super().__init__(
            node, monotonic=lambda: simulation.now * rate, sleep=sleep, open_bus=lambda url: Port(wire, process)
        )
        self._simulation = simulation
        self._guard = Lock(simulation)  # type: ignore[assignment]
        self._listening = Lock(simulation)  # type: ignore[assignment]

    def sdo_lock(self, url: str, node: int) -> FairLock:
        return self._sdo_locks.setdefault((url, node), SimFairLock(self._simulation))

    def plant_lock(self, url: str, node: int) -> Any:
        return self._plant_locks.setdefault((url, node), Lock(self._simulation))  # type: ignore[arg-type]


class SimEvent:
    """threading.Event for tasks."""

    def __init__(self, simulation: Simulation) -> None:
        self._simulation = simulation
        self._set = False
        self._waiting: list[Task] = []

    def set(self) -> None:
        self._set = True
        for task in self._waiting:
            self._simulation.after(0.0, task.wake)

    def is_set(self) -> bool:
        return self._set

    def wait(self, timeout: float | None = None) -> bool:
        task = self._simulation.task
        assert task is not None
        give_up = math.inf if timeout is None else self._simulation.now + timeout
        self._waiting.append(task)
        while not self._set and self._simulation.now < give_up - 1e-9:
            task.pause(None if timeout is None else give_up - self._simulation.now)
        self._waiting.remove(task)
        return self._set


class SimThread:
    """A thread of the service as a task. The watcher hears of wishes of other hosts, of which there are none."""

    ident = None

    def __init__(self, process: Process, run: Callable[[], None], name: str) -> None:
        self._process, self._run, self._name = process, run, name

    def start(self) -> None:
        if self._name == "watcher":
            return
        task = self._process.start(self._run, self._name)

        def over() -> None:
            if task.error is not None:
                raise task.error

        task.on_done.append(over)

    def is_alive(self) -> bool:
        return False

    def join(self, timeout: float | None = None) -> None:
        pass


class SimMachine(Machine):
    writes_beside = False

    def __init__(self, station: SimStation, process: Process) -> None:
        self._station = station
        self._process = process

    def monotonic(self) -> float:
        return self._station.monotonic()

    def sleep(self, seconds: float) -> None:
        self._station.sleep(seconds)

    def lock(self) -> AbstractContextManager[Any]:
        return Lock(self._process.simulation)

    def thread(self, run: Callable[[], None], name: str) -> Any:
        return SimThread(self._process, run, name)

    def event(self) -> Any:
        return SimEvent(self._process.simulation)

    def side_by_side(self, call: Callable[[T], None], items: Iterable[T], max_workers: int) -> None:
        for item in items:
            call(item)


class SimEngine:
    """given: jobs by id that are to run, on the disk: it outlives the process."""

    def __init__(self, given: dict[str, bool], process: Process) -> None:
        self._given = given
        self._process = process
        self._run: Callable[[str], None] | None = None
        self._running: set[str] = set()

    def launch(self, run: Callable[[str], None], queues: Mapping[str, int]) -> None:
        self._run = run
        for job_id in [each for each, over in self._given.items() if not over]:
            self._begin(job_id)

    def enqueue(self, job_id: str, queue: str) -> None:
        self._process.step("engine")
        self._given.setdefault(job_id, False)
        self._begin(job_id)

    def _begin(self, job_id: str) -> None:
        if self._run is None or job_id in self._running:
            return
        self._running.add(job_id)
        run = self._run

        def work() -> None:
            run(job_id)
            self._process.step("engine")
            self._given[job_id] = True
            self._running.discard(job_id)

        self._process.start(work, "job")

    def known(self, job_ids: Collection[str]) -> set[str]:
        return {job_id for job_id in job_ids if self._given.get(job_id) is False}

    def over(self, limit: int) -> list[str]:
        return [job_id for job_id, over in self._given.items() if over][:limit]

    def forget(self, job_ids: Collection[str]) -> None:
        for job_id in job_ids:
            self._given.pop(job_id, None)

    def alive(self) -> bool:
        return self._run is not None

    def close(self) -> None:
        self._run = None


_EMPTIED = (
    "webhook_deliveries", "watches", "sample_chunks", "events", "batch_loops", "batches", "jobs", "loops", "audit",
)  # fmt: skip


class SimStore(Store):
    """on_statement: before each call of the database.  after_move: after a job has got another state."""

    def __init__(self, folder: Path) -> None:
        super().__init__(folder)
        self.on_statement: Callable[[str], None] | None = None
        self.after_move: Callable[[Job, JobState], None] | None = None
        self._seen: list[Job] | None = None
        event.listen(self.engine, "before_cursor_execute", self._before_statement)
        event.listen(self.engine, "commit", self._before_commit)
        event.listen(self._reserve, "commit", self._forget)

    def _before_statement(self, *_: object) -> None:
        if self.on_statement is not None:
            self.on_statement("database")

    def _forget(self, _: object) -> None:
        self._seen = None

    def _before_commit(self, connection: object) -> None:
        self._forget(connection)
        if self.on_statement is not None:
            self.on_statement("commit")

    def seen(self) -> list[Job]:
        """The latest jobs as an observer sees them, the latest last; read again only after something was written."""
        if self._seen is None:
            self._seen = list(reversed(self.recent()))
        return self._seen

    def empty(self) -> None:
        self.on_statement = self.after_move = None
        with self.engine.begin() as connection:
            for table in _EMPTIED:
                if table in self._tables:
                    connection.execute(text(f"DELETE FROM {table}"))

    @property
    def _tables(self) -> Collection[str]:
        return {*Base.metadata.tables}

    def move(
        self, job_id: str, wanted: JobState, by: str = "service", also: WithJob | None = None, **columns: Any
    ) -> Job:
        row = super().move(job_id, wanted, by, also, **columns)
        if self.after_move is not None:
            self.after_move(row, wanted)
        return row


_stores: list[SimStore] = []


def store(number: int) -> SimStore:
    """The store of a gateway, empty. Opened once for all histories of this process: migrating takes a while."""
    memory = Path("/dev/shm")
    while len(_stores) <= number:
        parent = str(memory) if memory.is_dir() else None
        folder = Path(tempfile.mkdtemp(prefix="loopwright-simulation-", dir=parent))
        # At the end of this process, be it one of a pool: those end without atexit.
        Finalize(None, shutil.rmtree, (folder, True), exitpriority=1)
        _stores.append(SimStore(folder))
    found = _stores[number]
    found.empty()
    return found


def noted_reading(now: Callable[[], float], note: Callable[[LoopState, float], None]) -> type[BusReading]:
    """Readings of a bus loop that say when they were begun, and what they have found."""

    class Reading(BusReading):
        def state(self) -> LoopState:
            began = now()
            found = BusReading.state(self)
            note(found, began)
            return found

    return Reading


class Gateway:
    """One host: its disk, and the service on it while it runs.

    on_start: told of each process as it starts, and may say when it dies.
    """

    def __init__(
        self, wire: Wire, name: str, number: int, node: int, loops: Mapping[str, LoopConfig], tune: Tune,
        open_loop: Callable[[SimStation, LoopConfig], Loop],
    ) -> None:  # fmt: skip
        self.simulation = wire.simulation
        self.name = name
        self.node = node
        self.store = store(number)
        self.process: Process | None = None
        self.jobs: Jobs | None = None
        self.starts = 0
        self.gone = False
        """Killed, and never started again."""
        self.restart_after: Callable[[], float | None] = lambda: None
        self.on_start: Callable[[Process], None] = lambda process: None
        self.on_boot: Callable[[Jobs, Process], None] = lambda jobs, process: None
        """What else runs in each process, from its boot on."""
        self.on_up: list[Callable[[], None]] = []
        self.died_at: list[float] = []
        self._wire = wire
        self._loops = loops
        self._tune = tune
        self._open_loop = open_loop
        self._given: dict[str, bool] = {}

    @property
    def is_up(self) -> bool:
        return self.jobs is not None and self.process is not None and self.process.alive

    def start(self) -> None:
        """Starts the service: recovery first, then its jobs."""
        self.starts += 1
        self.simulation.note(self.name, "starts")
        process = self.process = Process(self.simulation, self.name)
        process.on_death.append(self._died)
        self.on_start(process)
        station = SimStation(self._wire, process, self.node)
        self.store.on_statement = lambda what: self._statement(what)

        def boot() -> None:
            jobs = make_jobs(
                self._loops, self.store, lambda config: self._open_loop(station, config), self._tune, _no_rehearsal,
                engine=SimEngine(self._given, process), machine=SimMachine(station, process),
            )  # fmt: skip
            jobs.boot()
            self.jobs = jobs
            self.on_boot(jobs, process)
            self.simulation.note(self.name, "is ready")
            waiting, self.on_up = self.on_up, []
            for call in waiting:
                self.simulation.after(0.0, call)

        task = process.start(boot, "boot")
        task.on_done.append(lambda: self._booted(task))

    def _booted(self, task: Task) -> None:
        if task.error is not None:
            raise task.error

    def _statement(self, what: str) -> None:
        task = self.simulation.task
        if task is not None and task.process is self.process:
            task.process.step(what, may_stall=False)
        elif task is not None and not task.process.alive:
            raise Killed(self.name)

    def _died(self) -> None:
        self.jobs = None
        self.died_at.append(self.simulation.now)
        self.simulation.note(self.name, "is dead")
        after = self.restart_after()
        if after is None:
            self.gone = True
            waiting, self.on_up = self.on_up, []
            for call in waiting:
                self.simulation.after(0.0, call)
        else:
            self.simulation.after(after, self.start)

    def ask(self, what: str, call: Callable[[Jobs], T]) -> tuple[T | None, BaseException | None, bool]:
        """A request over HTTP, from a task of somebody else: answer, error, and whether the service died of it."""
        assert self.jobs is not None and self.process is not None
        asker, jobs = self.simulation.task, self.jobs
        assert asker is not None
        task = self.process.start(lambda: call(jobs), what)
        task.on_done.append(asker.wake)
        while not task.done:
            asker.pause(None)
        return task.result, task.error, task.killed

    def wait_until_up(self) -> bool:
        """False where it never will be again."""
        asker = self.simulation.task
        assert asker is not None
        while not self.is_up:
            if self.gone:
                return False
            self.on_up.append(asker.wake)
            asker.pause(None)
        return True

    def rows(self) -> list[Job]:
        return self.store.seen()

    def state_of(self, job_id: str) -> str:
        return next(row.state for row in self.rows() if row.id == job_id)

    def busy(self) -> bool:
        return any(row.state in ACTIVE for row in self.rows())


def _no_rehearsal(*_: Any, **__: Any) -> Any:
    raise AssertionError("no job of the simulation is a rehearsal")

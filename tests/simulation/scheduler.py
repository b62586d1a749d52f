"""Simulated time, and processes that live and die in it: one thread, one heap, one seed.

A process has tasks (greenlets). A task that waits goes back to the scheduler, which jumps from event to event. Every
call of a process that could be its last is a step: a kill before a step raises `Killed`, and nothing it does later
leaves it.
"""

from __future__ import annotations

import heapq
import random
from collections import Counter
from collections.abc import Callable
from typing import Any

from greenlet import getcurrent, greenlet

START = 1000.0
MAX_EVENTS = 500_000


class Killed(BaseException):
    """kill -9: no handler of the program sees it, and what runs on its way out reaches nothing any more."""


class Runaway(Exception):
    """A history that does not end: calls without end in which no time passes, or more events than any needs."""


class Timer:
    """A call that is due. Cancelled by `cancel`."""

    __slots__ = ("args", "call")

    def __init__(self, call: Callable[..., None], args: tuple[Any, ...]) -> None:
        self.call: Callable[..., None] | None = call
        self.args = args

    def cancel(self) -> None:
        self.call = None


class Simulation:
    """seed: of everything that is random from the start of the history on. keeps_log: what happens is written down."""

    def __init__(self, seed: str, keeps_log: bool = False) -> None:
        self.now = START
        self.random = random.Random(seed)
        self.log: list[tuple[float, str, Any]] = []
        self.keeps_log = keeps_log
        self.events = 0
        self.counts: Counter[str] = Counter()
        self._heap: list[tuple[float, int, Timer]] = []
        self._number = 0
        self.hub = getcurrent()
        self.task: Task | None = None
        self.processes: list[Process] = []

    def at(self, time: float, call: Callable[..., None], *args: Any) -> Timer:
        self._number += 1
        timer = Timer(call, args)
        heapq.heappush(self._heap, (time, self._number, timer))
        return timer

    def after(self, delay_s: float, call: Callable[..., None], *args: Any) -> Timer:
        return self.at(self.now + delay_s, call, *args)

    def run(self, until: float, over: Callable[[], bool] = lambda: False) -> None:
        """Events in their order, until that time or until it is over."""
        heap, pop = self._heap, heapq.heappop
        while heap:
            if heap[0][0] > until:
                break
            time, _, timer = pop(heap)
            call = timer.call
            if call is None:
                continue
            if time > self.now:
                self.now = time
            self.events += 1
            if self.events > MAX_EVENTS:
                raise Runaway(f"more than {MAX_EVENTS} events")
            call(*timer.args)
            if over():
                return
        self.now = max(self.now, until)

    def note(self, who: str, what: Any) -> None:
        """what: text, or a frame that is put in words when the log is read."""
        if self.keeps_log:
            self.log.append((self.now - START, who, what))

    def to_hub(self) -> None:
        """From a task back to the scheduler, until something wakes it."""
        self.hub.switch()

    def end(self) -> None:
        """Every task that still waits is unwound: greenlets must not outlive their history."""
        for process in self.processes:
            process.kill(at_once=True)


class Process:
    """kill_at: the step before which it dies.  stalls: for how many s it stands still before a step."""

    def __init__(self, simulation: Simulation, name: str) -> None:
        self.simulation = simulation
        self.name = name
        self.alive = True
        self.steps = 0
        self.kill_at: int | None = None
        self.stalls: dict[int, float] = {}
        self.on_death: list[Callable[[], None]] = []
        self.on_step: Callable[[str], None] | None = None
        self._tasks: list[Task] = []
        self._frozen_until = 0.0
        self._at = 0.0
        self._here = 0
        simulation.processes.append(self)

    def start(self, call: Callable[[], Any], name: str = "") -> Task:
        task = Task(self, call, f"{self.name}.{name}" if name else self.name)
        self._tasks = [each for each in self._tasks if not each.done]
        self._tasks.append(task)
        self.simulation.after(0.0, task.begin)
        return task

    def step(self, what: str, may_stall: bool = True) -> None:
        """Before each send, receive, wait, and call of the database."""
        if not self.alive:
            raise Killed(self.name)
        self.steps += 1
        if self.on_step is not None:
            self.on_step(what)
        if self.steps == self.kill_at:
            self.simulation.note(self.name, f"kill -9 before step {self.steps} ({what})")
            self.kill()
            raise Killed(self.name)
        if self.simulation.now != self._at:
            self._at, self._here = self.simulation.now, 0
        self._here += 1
        if self._here > 200_000:
            raise Runaway(f"{self.name}: {self._here} steps in which no time passes")
        if self.stalls and may_stall and (stall := self.stalls.pop(self.steps, None)):
            self.freeze(stall)
            assert self.simulation.task is not None
            self.simulation.task.pause(0.0)

    def freeze(self, seconds: float) -> None:
        """It is not let run for so long."""
        self.simulation.note(self.name, f"stands still for {seconds:.3f} s")
        self._frozen_until = self.simulation.now + seconds

    @property
    def frozen_for(self) -> float:
        return self._frozen_until - self.simulation.now

    def kill(self, at_once: bool = False) -> None:
        if not self.alive:
            return
        self.alive = False
        for call in self.on_death:
            call()
        for task in self._tasks:
            if task is not self.simulation.task and not task.done:
                if at_once:
                    task.throw()
                else:
                    self.simulation.after(0.0, task.throw)


class Task:
    """A greenlet of a process. result, error: what it came to, once done; killed: its process died."""

    def __init__(self, process: Process, call: Callable[[], Any], name: str) -> None:
        self.process = process
        self.name = name
        self.result: Any = None
        self.error: BaseException | None = None
        self.done = self.killed = False
        self.on_done: list[Callable[[], None]] = []
        self._call = call
        self._greenlet = greenlet(self._main, parent=process.simulation.hub)
        self._timer: Timer | None = None
        self._thawing = False

    def begin(self) -> None:
        if self.process.alive:
            self._switch()
        else:
            self._over(killed=True)

    def pause(self, seconds: float | None) -> None:
        """Waits so long, or for `wake`. To be called by the task itself. A process that stands still wakes later."""
        simulation = self.process.simulation
        if seconds is not None:
            self._timer = simulation.after(seconds, self.wake)
        simulation.to_hub()
        if not self.process.alive:
            raise Killed(self.process.name)

    def wake(self) -> None:
        if self.done:
            return
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        later = max(self.process.frozen_for, 0.0)
        if later or self.process.simulation.task is not None:  # never from within another task
            if not self._thawing:
                self._thawing = True
                self.process.simulation.after(later, self._thaw)
        elif not self._thawing:
            self._switch()

    def _thaw(self) -> None:
        self._thawing = False
        self.wake()

    def throw(self) -> None:
        if self.done:
            return
        if self._timer is not None:
            self._timer.cancel()
        if not self._greenlet:  # never begun
            self._over(killed=True)
            return
        self._switch(Killed(self.process.name))

    def _switch(self, error: BaseException | None = None) -> None:
        simulation = self.process.simulation
        before, simulation.task = simulation.task, self
        try:
            if error is None:
                self._greenlet.switch()
            else:
                self._greenlet.throw(error)
        finally:
            simulation.task = before

    def _main(self) -> None:
        try:
            self.result = self._call()
        except Killed:
            self.killed = True
        except BaseException as error:
            self.error = error
        self._over(self.killed)

    def _over(self, killed: bool) -> None:
        self.done, self.killed = True, killed
        for call in self.on_done:
            self.process.simulation.after(0.0, call)

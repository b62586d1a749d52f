"""The configured loops: configuration, host, present state, and a lock for those that act on a loop."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager
from dataclasses import astuple, replace
from datetime import UTC, datetime

from loopwright.service.errors import UnknownLoop
from loopwright.service.inputs.config import BusConfig, LoopConfig
from loopwright.service.jobs.machine import Machine
from loopwright.service.jobs.registry import Registry
from loopwright.service.listening.heard_loop import InEffect
from loopwright.service.loops.loop import Loop
from loopwright.service.observing.neighbours import disturbers
from loopwright.service.states.loop_state import LoopState, gains_of, loop_state
from loopwright.service.store.store import Store
from loopwright.service.store.under_test import times_under_test

LoopFactory = Callable[[LoopConfig], Loop]


class LoopDirectory:
    """Knows the loops of every host, and opens those of this one.

    loops: the loops of this host.
    open_loop: opens one of them.
    buses: the configuration of their buses.
    machine: makes the locks of the loops.
    """

    def __init__(
        self,
        loops: Mapping[str, LoopConfig],
        store: Store,
        open_loop: LoopFactory,
        registry: Registry,
        machine: Machine,
        buses: Mapping[str, BusConfig] | None = None,
    ) -> None:
        self.loops = loops
        self.store = store
        self.open_loop = open_loop
        self._registry = registry
        self._buses = buses or {}
        self._machine = machine
        self.last_read: dict[str, LoopState] = {}
        """The loops of this host as they were read from the bus last, by tag."""
        # By loop: held while a job on it is started or decided, or while it is restored.
        self._loop_locks: dict[str, AbstractContextManager[object]] = {}

    def alone_with(self, tag: str) -> AbstractContextManager[object]:
        """Returns the lock that is held while a job on the loop is started or decided, or the loop is restored."""
        return self._loop_locks.setdefault(tag, self._machine.lock())  # one, also for two who ask at the same time

    def at_once(self, bus: str) -> int:
        """Returns how many loops of a bus of this host may be under test at the same time."""
        return self._buses.get(bus, BusConfig()).at_once

    def config(self, tag: str) -> LoopConfig:
        """Returns the configuration of a loop of any host. Raises UnknownLoop."""
        return self.owner(tag)[0]

    def owner(self, tag: str) -> tuple[LoopConfig, str]:
        """Returns the loop's configuration, and the host that has it. Raises UnknownLoop."""
        if tag in self.loops:
            return self.loops[tag], self.store.host
        row = self.store.foreign_loop(tag)
        if row is None:
            raise UnknownLoop(tag, (config.tag for config, _ in self.everywhere()))
        return LoopConfig.model_validate(row.config), row.host

    def everywhere(self) -> list[tuple[LoopConfig, str]]:
        """Returns every loop of every host, those of this host first."""
        own = [(config, self.store.host) for config in self.loops.values()]
        return own + [(LoopConfig.model_validate(row.config), row.host) for row in self.store.foreign_loops()]

    def disturbers(self, tag: str) -> list[str]:
        """Returns the loops of any host whose tests disturb a loop. Raises UnknownLoop."""
        return disturbers(self.config(tag), [config for config, _ in self.everywhere()])

    def disturbed_by(self, tag: str) -> str | None:
        """Returns in words which neighbours of a loop are under test; None: none is. Raises UnknownLoop."""
        under_test = times_under_test(self.store, self.disturbers(tag))
        found = [f"{each.loop} is under test (job {each.job_id})" for each in under_test if each.session]
        return "; ".join(found) or None

    def disturbed(self, tag: str, from_s: float, to_s: float) -> list[tuple[float, float, str]]:
        """Returns begin and end, in seconds since 1970, of the times within this one in which neighbours of a loop
        were under test, with their tags. Raises UnknownLoop."""
        under_test = times_under_test(self.store, self.disturbers(tag), datetime.fromtimestamp(from_s, UTC))
        return [
            (*within, each.loop)
            for each in under_test
            if each.session and (within := each.within(from_s, to_s)) is not None
        ]

    def live(self, tag: str) -> LoopState | None:
        """Returns the present state of a loop, from the running job or else from the bus; None on another host."""
        if tag not in self.loops:
            self.owner(tag)
            return None
        active = self.store.active(tag)
        running = self._registry.running.get(active.id) if active else None
        state = running.loop.latest if running and running.loop else None
        if state:
            return state
        return self.read(tag)

    def read(self, tag: str) -> LoopState:
        """Reads a loop of this host from the bus. Raises Ended."""
        loop = self.open_loop(self.loops[tag])
        try:
            state = self.last_read[tag] = loop.read()
            return state
        finally:
            loop.close()

    def in_effect(self, tag: str) -> InEffect | None:
        """Returns what is in effect on a loop of this host, for its history: from the job that has the loop, else from
        the bus; None while that job has not read it yet. Raises Ended."""
        for running in self._registry.running.copy().values():
            if running.tag == tag and (loop := running.loop) is not None:
                began_s, state = loop.began_s, loop.latest
                if state is None:
                    return None
                return InEffect(
                    began_s, state.sp, state.mode, state.on_trial, astuple(state.gains), state.sample_time_s
                )
        began_s, state = time.time(), self.read(tag)
        gains = None if state.on_trial else astuple(state.gains)  # those that another tuner tries are not read
        return InEffect(began_s, state.sp, state.mode, state.on_trial, gains, state.sample_time_s)

    def present(self, tag: str) -> LoopState:
        """Returns the loop as its controller has it, or as it was at the start of the running job. Raises Ended."""
        active = self.store.active(tag)
        if active is not None and active.found is not None:
            return replace(loop_state(active.found), gains=gains_of(active.previous_gains))
        return self.read(tag)

"""A loop that stores its latest state, so that the API can show a loop that a job is using."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import replace

from loopwright.service.loops.loop import Loop, Restored
from loopwright.service.states.loop_state import LoopState
from loopwright.tuning.gains import Gains
from loopwright.tuning.plan import Command, Mode, Sample, SetGains
from loopwright.tuning.reasons import Reason


class ObservedLoop:
    """Passes all calls on to a loop. Other threads read `latest`: it is replaced as a whole, never changed.

    began_s: wall time at which the call began that has found `latest`, or one before; to be read before it.
    """

    def __init__(self, loop: Loop, wall: Callable[[], float] = time.time) -> None:
        self._loop, self._wall = loop, wall
        self.began_s = 0.0
        self._state: LoopState | None = None
        self._trial: Gains | None = None
        self._sample: Sample | None = None

    @property
    def latest(self) -> LoopState | None:
        """Returns the last known state: read at the start, then updated by every sample."""
        state, sample, trial = self._state, self._sample, self._trial
        if state is None or sample is None:
            return state
        gains = trial or state.gains
        return replace(
            state, mode=Mode(sample.mode), sp=sample.sp, pv=sample.pv, mv=sample.mv, gains=gains,
            on_trial=trial is not None,
        )  # fmt: skip

    @property
    def t_s(self) -> float | None:
        """Returns the plant time of the latest sample, s; None before the first one."""
        return None if self._sample is None else self._sample.t

    @property
    def waits(self) -> bool:
        return self._loop.waits

    def read(self, beside_tests: bool = False) -> LoopState:
        began_s = self._wall()
        self._state = self._loop.read(beside_tests)
        self.began_s = began_s
        return self._state

    def begin(
        self,
        stop: Callable[[], Reason | None] = lambda: None,
        note_session: Callable[[int], None] = lambda session: None,
    ) -> LoopState:
        began_s = self._wall()
        self._state = self._loop.begin(stop, note_session)
        self.began_s = began_s
        return self._state

    def step(self, commands: Sequence[Command]) -> Sample:
        began_s = self._wall()
        self._sample = sample = self._loop.step(commands)
        for command in commands:
            if isinstance(command, SetGains):
                self._trial = command.gains
        self.began_s = began_s
        return sample

    def hold(self) -> None:
        self._loop.hold()

    def restore(self, home: LoopState, session: int | None = None) -> Restored:
        began_s = self._wall()
        restored = self._loop.restore(home, session)
        self._trial, self._sample, self._state = None, None, restored.state
        self.began_s = began_s
        return restored

    def accept(self, gains: Gains, instead_of: Gains) -> LoopState:
        return self._loop.accept(gains, instead_of)

    def close(self) -> None:
        self._loop.close()

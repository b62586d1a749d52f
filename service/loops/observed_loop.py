"""A loop that stores its latest state, so that the API can show a loop that a job is using."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

from loopwright.service.loops.loop import Loop, Restored
from loopwright.service.states.loop_state import LoopState
from loopwright.tuning.gains import Gains
from loopwright.tuning.plan import Command, Mode, Sample, SetGains
from loopwright.tuning.reasons import Reason


class ObservedLoop:
    """Passes all calls on to a loop. Other threads read `latest`: it is replaced as a whole, never changed."""

    def __init__(self, loop: Loop) -> None:
        self._loop = loop
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
        self._state = self._loop.read(beside_tests)
        return self._state

    def begin(
        self,
        stop: Callable[[], Reason | None] = lambda: None,
        note_session: Callable[[int], None] = lambda session: None,
    ) -> LoopState:
        self._state = self._loop.begin(stop, note_session)
        return self._state

    def step(self, commands: Sequence[Command]) -> Sample:
        self._sample = sample = self._loop.step(commands)
        for command in commands:
            if isinstance(command, SetGains):
                self._trial = command.gains
        return sample

    def restore(self, home: LoopState, session: int | None = None) -> Restored:
        restored = self._loop.restore(home, session)
        self._trial, self._sample, self._state = None, None, restored.state
        return restored

    def accept(self, gains: Gains, instead_of: Gains) -> LoopState:
        return self._loop.accept(gains, instead_of)

    def close(self) -> None:
        self._loop.close()

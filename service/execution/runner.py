"""Pumps a plan through a loop, guards every sample, and always restores the loop: the safety contract's second clause.

Whatever ends the run - the plan's result, a refusal, a limit, a lost node, an operator, a defect - the way out is one:
the session is closed, the controller brings the loop home, and what it came to is read back.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Generic, TypeVar

from loopwright.service.loop_state import LoopState
from loopwright.service.loops.loop import Loop
from loopwright.tuning.plan import (
    Command,
    Event,
    Note,
    Plan,
    Sample,
    SetGains,
    SetMode,
    SetOutput,
    SetRelay,
    SetSetpoint,
    StageDone,
    StageStarted,
    Work,
)
from loopwright.tuning.reasons import Aborted, Ended, Failed, Reason

T = TypeVar("T")
CHUNK = 200
CHUNK_S = 1.0
"""Samples are handed on by so many, or by so much plant time: what a service that dies takes with it."""


@dataclass(frozen=True, slots=True)
class Watch:
    """PV limits (PV units), permitted MV (MV units, held from the first command on), time budget (plant s), how many
    samples in a row may be missing, and for how long PV may stay exactly the same while MV is away from where it was
    (plant s; longer than any dead time)."""

    pv_low: float = -math.inf
    pv_high: float = math.inf
    mv_low: float = -math.inf
    mv_high: float = math.inf
    max_time_s: float = math.inf
    max_gap_samples: int = 5
    max_frozen_s: float = math.inf


@dataclass(slots=True)
class RunResult(Generic[T]):
    """value: the plan's result, or ended: why there is none.  restored: the loop as read back, None if it could not
    be.
    """

    value: T | None = None
    ended: Ended | None = None
    restored: LoopState | None = None
    plant_time_s: dict[str, float] = field(default_factory=dict)


class Guard:
    """Checks each sample against the watch. Another's hand on the loop is the controller's to see."""

    def __init__(self, watch: Watch, state: LoopState) -> None:
        self._watch = watch
        self._dt = state.sample_time_s
        self._start: float | None = None
        self._last = 0.0
        self._acting = False
        self._slack = 0.01 * min(watch.mv_high - watch.mv_low, 1e300)
        self._pv = math.nan
        self._mv = math.nan
        self._frozen_at = 0.0
        self._notable = 1e-3 * abs(state.mv_high - state.mv_low)

    def commanded(self) -> None:
        """The plan acts on the loop from now on."""
        self._acting = True

    def check(self, sample: Sample) -> None:
        t, _, pv, mv, _ = sample
        watch = self._watch
        if not (math.isfinite(pv) and math.isfinite(mv)):
            raise Failed(Reason.BAD_SAMPLE, f"at {t:.3f} s PV is {pv}, MV is {mv}")
        if self._start is None:
            self._start = t
        elif t - self._last > (watch.max_gap_samples + 1.5) * self._dt:
            raise Failed(Reason.SAMPLES_LOST, f"{(t - self._last) / self._dt - 1:.0f} samples missing before {t:.3f} s")
        self._last = t
        if not watch.pv_low <= pv <= watch.pv_high:
            raise Failed(Reason.PV_LIMIT, f"PV {pv:.5g} left {watch.pv_low:.5g} .. {watch.pv_high:.5g} at {t:.3f} s")
        if self._acting and not watch.mv_low - self._slack <= mv <= watch.mv_high + self._slack:
            raise Failed(Reason.MV_LIMIT, f"MV {mv:.5g} left {watch.mv_low:.5g} .. {watch.mv_high:.5g} at {t:.3f} s")
        if t - self._start > watch.max_time_s:
            raise Failed(Reason.TIME_BUDGET, f"{t - self._start:.0f} s of plant time are over the budget")
        if pv != self._pv:
            self._frozen_at, self._pv, self._mv = t, pv, mv
        elif abs(mv - self._mv) < self._notable:
            self._frozen_at = t
        elif t - self._frozen_at > watch.max_frozen_s:
            raise Failed(Reason.PV_FROZEN, f"PV is exactly {pv:.6g} for {t - self._frozen_at:.3g} s while MV moved")


def run(
    plan: Plan[T],
    loop: Loop,
    *,
    watch: Watch,
    on_event: Callable[[Event], None] = lambda event: None,
    on_samples: Callable[[list[Sample]], None] = lambda samples: None,
    stop: Callable[[], Reason | None] = lambda: None,
    start_work: Callable[[Work[Any]], None] = Work.run,
    remember: Callable[[int], None] = lambda session: None,
    on_home: Callable[[LoopState], None] = lambda home: None,
) -> RunResult[T]:
    """Runs the plan to its end and restores the loop. Raises nothing that a loop or plan can cause; see `ended`.

    stop is asked once a sample and in every wait; what it returns ends the run as Aborted.
    start_work starts a plan's long computation: in a thread for a live loop, which must be pumped meanwhile; at
    once, as here, where nobody waits.
    remember: told the number of the session before it is opened.  on_home: told what the loop must come back to.
    """
    result: RunResult[T] = RunResult()
    samples: list[Sample] = []
    state: LoopState | None = None
    guard: Guard | None = None
    stage, since, now = "", 0.0, 0.0

    def hand_on() -> None:
        nonlocal samples
        if samples:
            on_samples(samples)
            samples = []

    def clock(next_stage: str) -> None:
        nonlocal stage, since
        if stage:
            result.plant_time_s[stage] = result.plant_time_s.get(stage, 0.0) + now - since
        stage, since = next_stage, now

    try:
        state = loop.begin(stop, remember)
        on_home(state)
        if state.when_silent:
            on_event(Note(f"if the controller falls silent, the plant's I/O {state.when_silent}"))
        guard = Guard(watch, state)
        chunk = min(CHUNK, max(1, round(CHUNK_S / state.sample_time_s)))
        answer = next(plan)
        commands: list[Command] = []
        while True:
            if answer:
                commands = []
                for item in answer:
                    if isinstance(item, SetMode | SetGains | SetSetpoint | SetOutput | SetRelay):
                        commands.append(item)
                    elif isinstance(item, Work):
                        start_work(item)
                    else:
                        if isinstance(item, StageStarted):
                            clock(item.stage)
                        elif isinstance(item, StageDone):
                            hand_on()  # a stage that is done never runs again: its samples go before the word
                        on_event(item)
                if commands:
                    guard.commanded()
            elif commands:
                commands = []
            sample = loop.step(commands)
            if not now:
                since = sample.t - state.sample_time_s
            now = sample.t
            samples.append(sample)
            if len(samples) >= chunk:
                hand_on()
            guard.check(sample)
            reason = stop()
            if reason is not None:
                raise Aborted(reason, f"at {now:.3f} s of plant time, in stage {stage or 'start'}")
            answer = plan.send(sample)
    except StopIteration as end:
        result.value = end.value
    except Ended as ended:
        result.ended = ended
    except MemoryError:
        text = f"no memory was left at {now:.3f} s of plant time, in stage {stage or 'start'}"
        result.ended = Failed(Reason.COMPUTATION_LIMIT, text)
    except Exception as defect:
        result.ended = Failed(Reason.INTERNAL, f"{type(defect).__name__}: {defect}")
        on_event(Note(f"defect in stage {stage}: {defect!r}"))
    finally:
        plan.close()
    clock("")
    if state is not None:
        try:
            restored = loop.restore(state)
        except Ended as ended:
            on_event(Note(f"restore: {ended}"))
            if result.ended is None or result.ended.reason not in (Reason.NODE_LOST, Reason.BUS_LOST):
                result.value, result.ended = None, ended
        else:
            result.restored = restored.state
            if restored.changed:
                on_event(Note(f"not as before the test, and left so: {'; '.join(restored.changed.values())}"))
    hand_on()
    return result

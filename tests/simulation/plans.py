"""What the jobs do: made-up plans, which do everything that a plan may do in any order, and the real procedures."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import dataclass
from random import Random
from typing import Any

from loopwright.service.execution.computing.limits import ComputationKind
from loopwright.service.execution.guard import RunLimits
from loopwright.service.execution.procedures import Hooks, Outcome, Tune, tune
from loopwright.service.execution.runner import run
from loopwright.service.inputs.config import LoopConfig
from loopwright.service.inputs.request import RetuneRequest
from loopwright.service.loops.loop import Loop
from loopwright.service.results import FiveStageResult, GainsView
from loopwright.service.states.loop_state import LoopState
from loopwright.tuning.gains import Gains
from loopwright.tuning.plan import (
    Mode,
    Note,
    Plan,
    SetGains,
    SetMode,
    SetOutput,
    SetRelay,
    SetSetpoint,
    StageDone,
    StageStarted,
    Work,
)
from loopwright.tuning.reasons import FalsePv, Reason, Refused

PROPOSED = Gains(0.75, 8.0, 0.0, 0.0, 0.5, 0.0)
FALSE_SAMPLES = 5
TRIED = Gains(1.25, 4.0, 0.0, 0.0, 1.0, 0.0)


@dataclass(frozen=True)
class Action:
    """what: relay, trial, setpoint, manual, output, automatic, wait, work, stage, refuse.  samples: waited after it."""

    what: str
    value: float
    samples: int


@dataclass(frozen=True)
class Made:
    gains: Gains


@dataclass(frozen=True)
class Stage:
    number: float


def draw(random: Random, samples: int) -> tuple[Action, ...]:
    """Actions for about so many samples. Gains go on trial outside of the relay only, as the controller has it."""
    kinds = ("relay", "relay", "relay", "trial", "setpoint", "setpoint", "manual", "output", "automatic", "wait",
             "work", "stage")  # fmt: skip
    actions: list[Action] = []
    left, in_relay = samples, False
    while left > 0:
        what = random.choice(kinds)
        if what == "trial" and in_relay:
            what = "automatic"
        in_relay = what == "relay" or (in_relay and what not in ("manual", "automatic"))
        wait = min(left, random.randint(1, max(2, samples // 4)))
        left -= wait
        actions.append(Action(what, random.uniform(-1.0, 1.0), wait))
    if random.random() < 0.1:
        actions.append(Action("refuse", 0.0, 0))
    return tuple(actions)


EVERYTHING = (
    Action("stage", 0.0, 2), Action("relay", 0.5, 6), Action("relay", -0.5, 5), Action("automatic", 0.0, 2),
    Action("trial", 0.0, 3), Action("setpoint", 0.5, 4), Action("setpoint", 0.0, 2), Action("manual", 0.0, 2),
    Action("output", 0.3, 3), Action("work", 0.0, 1), Action("relay", 0.2, 4), Action("stage", 1.0, 1),
)  # fmt: skip


def made_up(actions: tuple[Action, ...], state: LoopState) -> Plan[Made]:
    sp, mv = state.sp, min(max(state.mv, 20.0), 80.0)
    yield (StageStarted("made-up", 1.0, 0.0),)
    number = 0
    for action in actions:
        value = action.value
        match action.what:
            case "relay":
                commands: tuple[Any, ...] = (
                    SetRelay(8.0 + 4.0 * value, 0.02, mv, amplitude_low=6.0, average=1 + int(value > 0.5)),
                    SetMode(Mode.EXPERIMENT),
                )
            case "trial":
                commands = (SetGains(TRIED),)
            case "setpoint":
                commands = (SetSetpoint(sp + 2.0 * value),)
            case "manual":
                commands = (SetMode(Mode.MANUAL),)
            case "output":
                commands = (SetOutput(mv + 10.0 * value),)
            case "automatic":
                commands = (SetMode(Mode.AUTOMATIC),)
            case "work":
                commands = (Work(lambda: 1.0), Note("computed"))
            case "stage":
                number += 1
                commands = (StageDone("made-up", Stage(float(number))), StageStarted("made-up", 1.0, 0.0))
            case "refuse":
                raise Refused(Reason.NO_RESPONSE, "made up")
            case _:
                commands = ()
        yield commands
        for _ in range(max(0, action.samples - 1)):
            yield ()
    return Made(PROPOSED)


def finding_false_pv(plan: Plan[Made], is_false: Callable[[], bool]) -> Plan[Made]:
    """The plan, which finds PV to be false where it has been so for FALSE_SAMPLES samples."""
    answer, run = next(plan), 0
    while True:
        sample = yield answer
        run = run + 1 if is_false() else 0
        if run >= FALSE_SAMPLES:
            raise FalsePv(Reason.PV_FROZEN, f"PV is {sample.pv:g} and false")
        try:
            answer = plan.send(sample)
        except StopIteration as end:
            made: Made = end.value
            return made


def tunes(actions: tuple[Action, ...], is_false: Callable[[], bool] = lambda: False) -> Tune:
    """The work of a job with that plan. is_false: whether PV is, as the job finds out."""

    def work(config: LoopConfig, request: RetuneRequest, loop: Loop, state: LoopState, hooks: Hooks) -> Outcome:
        limits = RunLimits(config.pv_limits.low, config.pv_limits.high, max_time_s=1e9)
        ran = run(
            finding_false_pv(made_up(actions, state), is_false), loop, limits=limits, on_event=hooks.on_event,
            on_samples=hooks.on_samples, stop=hooks.stop, note_session=hooks.note_session, on_home=hooks.on_home,
        )  # fmt: skip
        made = None
        if ran.value is not None:
            made = FiveStageResult(method="five-stage", new_gains=GainsView.of(ran.value.gains))
        return Outcome(made, ran.ended, ran.restored, dict(ran.plant_time_s))

    return work


class Here:
    """Workers that compute at once, in no simulated time."""

    def submit(self, kind: ComputationKind, work: Callable[[], Any], unwanted: Callable[[], bool]) -> Future[Any]:
        future: Future[Any] = Future()
        try:
            future.set_result(work())
        except Exception as error:
            future.set_exception(error)
        return future


def real(config: LoopConfig, request: RetuneRequest, loop: Loop, state: LoopState, hooks: Hooks) -> Outcome:
    return tune(config, request, loop, state, hooks, Here())

"""The two procedures of a job: tuning the live loop, and rehearsing in memory. They are passed to the jobs."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import TYPE_CHECKING, Any, Protocol

from loopwright.service.execution.computing.limits import ComputationKind
from loopwright.service.execution.computing.pool import NotWanted
from loopwright.service.inputs.config import LoopConfig
from loopwright.service.inputs.request import (
    FastRetune,
    RetuneRequest,
    SetpointRetune,
    check_setpoint_source,
    excitations,
    wrong_mode,
)
from loopwright.service.loops.loop import Loop
from loopwright.service.planning.expected import NOTHING_EXPECTED, ExpectedPv, LoopModel
from loopwright.service.planning.facts import facts_of, time_budget_s
from loopwright.service.planning.ground import Ground, rehearsal_spec
from loopwright.service.planning.moves import broken_from
from loopwright.service.results import Result, empty_result
from loopwright.service.states.loop_state import LoopState
from loopwright.service.store.jobs import JobEvent
from loopwright.tuning.experiments.primitives import Facts
from loopwright.tuning.experiments.settle import after_settling
from loopwright.tuning.fast.excitation_choice import NOT_ASKED
from loopwright.tuning.fast.known_plant.plant import NothingKnown, ObservedPlant
from loopwright.tuning.plan import Event, Mode, Note, Plan, Sample
from loopwright.tuning.reasons import Ended, Failed, NoGain, Reason, Refused

if TYPE_CHECKING:
    from loopwright.service.execution.beside import Workers

FROZEN_T95 = 3.0
"""Longest time for which PV may be exactly constant, in T95 of the loop."""


@dataclass(frozen=True)
class Hooks:
    """The connections of a running procedure to its job.

    on_event, on_samples: receive events and samples.
    stop: returns the reason why the procedure should end, or None.
    earlier: events that earlier attempts of a resumed job have stored; a stage finished there is not run again.
    note_session: receives the number of a session before it is opened.
    on_home: receives the state of the loop before the test.
    ground: known facts of the loop, for a rehearsal.
    plant: what operation has shown of the plant.
    model: the model that tells how far PV will go.
    """

    on_event: Callable[[Event], None]
    on_samples: Callable[[list[Sample]], None]
    stop: Callable[[], Reason | None]
    earlier: Sequence[JobEvent] = ()
    note_session: Callable[[int], None] = lambda session: None
    on_home: Callable[[LoopState], None] = lambda home: None
    ground: Ground = field(default_factory=Ground)
    plant: ObservedPlant | NothingKnown = NOT_ASKED
    model: LoopModel | None = None


@dataclass(frozen=True)
class Outcome:
    """The end of a procedure.

    result, ended: the result, or the reason why there is none; both where the figures are the reason (NoGain), and
    where a rehearsal reports its plant.
    restored: the loop as read back; None where it could not be.
    plant_time_s: plant time by stage, s.
    """

    result: Result | None
    ended: Ended | None
    restored: LoopState | None
    plant_time_s: dict[str, float]


class Tune(Protocol):
    """Tunes a live loop whose present state is `state`, and restores it however the procedure ends."""

    def __call__(
        self, config: LoopConfig, request: RetuneRequest, loop: Loop, state: LoopState, hooks: Hooks
    ) -> Outcome: ...


class Rehearse(Protocol):
    """Rehearses the same procedure on a model in memory."""

    def __call__(self, config: LoopConfig, request: RetuneRequest, hooks: Hooks) -> Outcome: ...


def tune(
    config: LoopConfig,
    request: RetuneRequest,
    loop: Loop,
    state: LoopState,
    hooks: Hooks,
    workers: Workers | None = None,
) -> Outcome:
    """Runs the requested procedure on the live loop.

    workers: processes that compute; None for a thread.
    """
    from loopwright.service.execution.beside import ComputingLoop
    from loopwright.service.execution.guard import RunLimits
    from loopwright.service.execution.result import result_of
    from loopwright.service.execution.runner import run

    facts = facts_of(config, state)
    check_setpoint_source(config, request, state.mode)
    wrong = wrong_mode(config, request, state.mode)
    if wrong is not None:
        raise Refused(Reason.WRONG_MODE, wrong)
    broken = broken_from(config, request, state)
    told = NOTHING_EXPECTED if broken else _expected_of(config, request, state, hooks, workers)
    if broken or told.broken:
        raise Refused(Reason.BAD_LIMITS, "; ".join((*broken, *told.broken)))
    if (begins_with := told.begins_with_pct) is not None:
        text = f"the relay begins with {begins_with:.3g} %, so that PV keeps its limits, by {told.source}"
        hooks.on_event(Note(text))
    limits = RunLimits(
        pv_low=config.pv_limits.low,
        pv_high=config.pv_limits.high,
        mv_low=facts.mv_low,
        mv_high=facts.mv_high,
        max_time_s=request.max_time_s or time_budget_s(request.method, facts.T95_s, facts.sample_time_s),
        max_frozen_s=FROZEN_T95 * config.t95_s,
        sp_deviation=config.sp_deviation,
    )
    computing = ComputingLoop(loop, workers)
    ran = run(
        plan(config, request, facts, hooks.earlier, hooks.plant, state.mode, begins_with),
        computing,
        limits=limits,
        on_event=hooks.on_event,
        on_samples=hooks.on_samples,
        stop=hooks.stop,
        start_work=computing.start,
        note_session=hooks.note_session,
        on_home=hooks.on_home,
    )
    ended = ran.ended
    if ran.value is not None and not ran.value.comparison.gain and not request.propose_anyway:
        ended = NoGain(Reason.NO_GAIN, ran.value.comparison.verdict)
    return Outcome(None if ran.value is None else result_of(ran.value), ended, ran.restored, dict(ran.plant_time_s))


def _expected_of(
    config: LoopConfig, request: RetuneRequest, state: LoopState, hooks: Hooks, workers: Workers | None
) -> ExpectedPv:
    """How far PV is expected to go, where it may come near its limits; nothing where that cannot be computed."""
    if hooks.model is None:
        return NOTHING_EXPECTED
    work = partial(expected, config, request, state, hooks.model, near_limits_alone=True)
    if workers is None:
        return work()
    try:
        return workers.submit(ComputationKind.LIVE, work, lambda: hooks.stop() is not None).result()
    except (Failed, NotWanted) as failed:
        hooks.on_event(Note(f"how far PV would go could not be computed: {failed}"))
        return NOTHING_EXPECTED


def expected(
    config: LoopConfig, request: RetuneRequest, state: LoopState, known: LoopModel, near_limits_alone: bool = False
) -> ExpectedPv:
    """How far PV is expected to go, see `service.execution.excursions`, which this process need not have loaded: it is
    a work for another one.

    near_limits_alone: only where PV may come near its limits.
    """
    from loopwright.service.execution.excursions import excursions, near_limits

    return (near_limits if near_limits_alone else excursions)(config, request, state, known)


def plan(
    config: LoopConfig,
    request: RetuneRequest,
    facts: Facts,
    earlier: Sequence[JobEvent] = (),
    plant: ObservedPlant | NothingKnown = NOT_ASKED,
    mode: Mode = Mode.AUTOMATIC,
    begins_with: float | None = None,
) -> Plan[Any]:
    """Returns the plan of the requested procedure.

    config: the configuration with the limits of the job.
    earlier: events of interrupted attempts, after which the loop gets time to come to rest. The record of an
    interrupted fast procedure is not continued: relay and set-point step are one record of an otherwise untouched loop.
    plant: what operation has shown of the plant.
    mode: the mode of the loop.
    begins_with: the amplitude with which the relay of fast begins in place of its own, percent.
    """
    procedure = _procedure(config, request, facts, earlier, plant, mode, begins_with)
    return after_settling(facts, procedure, mode) if earlier else procedure


def _procedure(
    config: LoopConfig,
    request: RetuneRequest,
    facts: Facts,
    earlier: Sequence[JobEvent],
    plant: ObservedPlant | NothingKnown,
    mode: Mode,
    begins_with: float | None,
) -> Plan[Any]:
    if isinstance(request, FastRetune):
        from loopwright.tuning.fast.excitation_choice import fast_by
        from loopwright.tuning.fast.known_plant.design_trial import trial

        if request.known_model is not None:
            return trial(facts, request.options, request.known_model)
        options = replace(request.options, begins_with=begins_with)
        return fast_by(excitations(config, request, mode), facts, options, plant)
    if isinstance(request, SetpointRetune):
        from loopwright.tuning.fast.pulses.procedure import setpoint

        return setpoint(facts, request.options)
    from loopwright.service.execution.checkpoints import finished
    from loopwright.tuning.five_stage.procedure import five_stage

    done = (event.stage_ended() for event in earlier)
    return five_stage(facts, request.options, finished((each.stage, each.result) for each in done if each))


def rehearse(config: LoopConfig, request: RetuneRequest, hooks: Hooks) -> Outcome:
    """Runs the requested procedure on a model in memory. Gains without a benefit are returned too: whether they would
    be proposed is a question for the live loop."""
    from loopwright.service.execution.rehearsal import rehearse as rehearse_spec

    spec, on = rehearsal_spec(config, request, hooks.ground)
    hooks.on_event(Note(f"rehearsed on {on.plant_text}; {on.gains_text}; nothing is tested on the loop"))
    # A model entered for a dry run is the plant itself; the procedure still starts where the request says.
    found = rehearse_spec(
        spec, request.method, hooks.on_event, hooks.on_samples, model=request.known_model, asked=request.options,
        excitations=excitations(config, request, hooks.ground.mode),
    )  # fmt: skip
    if found.ended is None or isinstance(found.ended, NoGain):
        return Outcome(found.result.model_copy(update={"rehearsed_on": on}), None, None, found.plant_time_s)
    return Outcome(empty_result(request.method, on), found.ended, None, found.plant_time_s)

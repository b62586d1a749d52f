"""The two kinds of work a job can be: tuning the live loop, and rehearsing in memory. Injected into the jobs."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Protocol

from loopwright.service.config import LoopConfig
from loopwright.service.loop_state import LoopState
from loopwright.service.loops.loop import Loop
from loopwright.service.planning.facts import facts_of, time_budget_s
from loopwright.service.planning.ground import Ground, rehearsal_spec
from loopwright.service.planning.moves import broken_limits
from loopwright.service.request import ProcessModel, RetuneRequest
from loopwright.service.results import Result, empty_result
from loopwright.service.store.jobs import JobEvent
from loopwright.tuning.experiments.primitives import Facts
from loopwright.tuning.experiments.settle import after_settling
from loopwright.tuning.models import Model
from loopwright.tuning.plan import Event, Note, Plan, Sample
from loopwright.tuning.reasons import Ended, NoGain, Reason, Refused

if TYPE_CHECKING:
    from loopwright.service.execution.beside import Workers

FROZEN_T95 = 3.0


@dataclass(frozen=True)
class Hooks:
    """How work reports, and how it learns that it should stop.

    remember: told the number of a session before it is opened.  on_home: told what the loop must come back to.
    earlier: what the earlier attempts of a job that is resumed have stored; a stage done there is not run again.
    ground: what is known of the loop, for a rehearsal.
    """

    on_event: Callable[[Event], None]
    on_samples: Callable[[list[Sample]], None]
    stop: Callable[[], Reason | None]
    earlier: Sequence[JobEvent] = ()
    remember: Callable[[int], None] = lambda session: None
    on_home: Callable[[LoopState], None] = lambda home: None
    ground: Ground = field(default_factory=Ground)


@dataclass(frozen=True)
class Outcome:
    """How work ended: a result, or the reason why not; both where the figures are the reason (NoGain), and where a
    rehearsal tells what it was done on. Plant times in s per stage."""

    result: Result | None
    ended: Ended | None
    restored: LoopState | None
    plant_time_s: dict[str, float]


class Tune(Protocol):
    """Tunes a live loop whose present state is `state`; restores it on every way out."""

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
    """The procedure asked for on the live loop. workers: who computes, by default a thread."""
    from loopwright.service.execution.beside import Computing
    from loopwright.service.execution.guard import Watch
    from loopwright.service.execution.result import result_of
    from loopwright.service.execution.runner import run

    facts = facts_of(config, state)
    broken = broken_limits(config, request, state.sp)
    if broken:
        raise Refused(Reason.BAD_LIMITS, "; ".join(broken))
    watch = Watch(
        pv_low=config.pv_limits.low,
        pv_high=config.pv_limits.high,
        mv_low=facts.mv_low,
        mv_high=facts.mv_high,
        max_time_s=request.max_time_s or time_budget_s(request.method, facts.T95_s, facts.sample_time_s),
        max_frozen_s=FROZEN_T95 * config.t95_s,
    )
    computing = Computing(loop, workers)
    ran = run(
        plan(request, facts, hooks.earlier),
        computing,
        watch=watch,
        on_event=hooks.on_event,
        on_samples=hooks.on_samples,
        stop=hooks.stop,
        start_work=computing.start,
        remember=hooks.remember,
        on_home=hooks.on_home,
    )
    ended = ran.ended
    if ran.value is not None and not ran.value.comparison.gain and not request.propose_anyway:
        ended = NoGain(Reason.NO_GAIN, ran.value.comparison.verdict)
    return Outcome(None if ran.value is None else result_of(ran.value), ended, ran.restored, dict(ran.plant_time_s))


def plan(request: RetuneRequest, facts: Facts, earlier: Sequence[JobEvent] = ()) -> Plan[Any]:
    """earlier: events of attempts that were cut off, after which the loop gets time to come to rest. What fast had
    recorded by then is not gone on with: relay and set-point step are one record, of a loop not touched in between.
    """
    procedure = _procedure(request, facts, earlier)
    return after_settling(facts, procedure) if earlier else procedure


def _procedure(request: RetuneRequest, facts: Facts, earlier: Sequence[JobEvent]) -> Plan[Any]:
    if request.fast:
        from loopwright.tuning.fast.design_trial import trial
        from loopwright.tuning.fast.procedure import FastOptions, fast

        wishes = FastOptions(**_options(request))
        known = _known_model(request)
        return fast(facts, wishes) if known is None else trial(facts, wishes, known)
    from loopwright.service.execution.checkpoints import finished
    from loopwright.tuning.five_stage.procedure import Options, five_stage

    done = ((event.data["stage"], event.data["result"]) for event in earlier if event.kind == "stage_done")
    return five_stage(facts, Options(**_options(request)), finished(done))


def rehearse(config: LoopConfig, request: RetuneRequest, hooks: Hooks) -> Outcome:
    """The same on a model in memory. Gains that bring no gain are an answer, too: whether a proposal would be made of
    them is a question for the loop."""
    from loopwright.service.execution.rehearsal import rehearse as rehearse_spec

    spec, on = rehearsal_spec(config, request, hooks.ground)
    hooks.on_event(Note(f"rehearsed on {on.plant_text}; {on.gains_text}; nothing is tested on the loop"))
    options = _options(request)
    if request.fast:
        options["model"] = _known_model(request)
    # A model typed in for a dry run is the plant itself; the procedure still starts where the request says.
    found = rehearse_spec(spec, on_event=hooks.on_event, on_samples=hooks.on_samples, **options)
    if found.ended is None or isinstance(found.ended, NoGain):
        return Outcome(found.result.model_copy(update={"rehearsed_on": on}), None, None, found.plant_time_s)
    return Outcome(empty_result(request.method, on), found.ended, None, found.plant_time_s)


def _known_model(request: RetuneRequest) -> Model | None:
    """What fast designs for without a relay."""
    return request.model.plant() if request.start == "design" and request.model else None


def _options(request: RetuneRequest) -> dict[str, Any]:
    """The request in the words of tuning.fast.procedure.FastOptions or tuning.five_stage.Options."""
    if request.fast:
        return {
            "Ms": request.ms,
            "derivative": request.derivative,
            "amplitude": request.amplitude_pct,
            "careful": request.careful,
            "verify": request.verify,
            "propose_anyway": request.propose_anyway,
        }
    model = request.model
    return {
        "start": request.start,
        "Ku": request.Ku,
        "Pu_s": request.Pu_s,
        "Kp": request.Kp,
        "Ti_s": request.Ti_s,
        "overshoot_pct": request.overshoot_pct,
        "model": model.plant() if isinstance(model, ProcessModel) else None,
        "k_source": request.k_source,
        "kp_step_factor": request.kp_step_factor,
        "overshoot_window_pct": request.overshoot_window_pct,
        "method": request.method,
        "method_options": request.method_options,
        "model_from": request.model_from,
        "baseline": request.baseline is not False,
        "verify": request.verify,
        "propose_anyway": request.propose_anyway,
    }

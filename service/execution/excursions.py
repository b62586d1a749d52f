"""How far PV will go in a retune: the moves of the procedures, driven on the model of the loop that is known.

The relay begins smaller where its first wave would leave the limits of PV; what would leave them all the same is named
before anything moves.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np

from loopwright.service.execution.rehearsal import RehearsedLoop, loop_on
from loopwright.service.inputs.config import LoopConfig
from loopwright.service.inputs.request import (
    MIN_AMPLITUDE_PCT,
    FastRetune,
    FiveStages,
    RetuneRequest,
    excitations,
)
from loopwright.service.planning.expected import NOTHING_EXPECTED, ExpectedPv, LoopModel, Reach
from loopwright.service.planning.facts import facts_of
from loopwright.service.states.loop_state import LoopState
from loopwright.tuning.experiments.primitives import Facts
from loopwright.tuning.fast.design.design import DesignSpec
from loopwright.tuning.fast.evaluation.proposal import ultimate
from loopwright.tuning.fast.expected_moves import LAST_LEVEL_TURNS, NewGains, expected_moves
from loopwright.tuning.fast.experiment import on_trial
from loopwright.tuning.fast.known_plant.design_trial import designed_on, trial
from loopwright.tuning.fast.record import Excitation
from loopwright.tuning.fast.relay.procedure import FastOptions
from loopwright.tuning.fast.relay.relay_test import FIRST_AMPLITUDE, MIN_OUTPUT_RANGE, max_amplitude
from loopwright.tuning.five_stage.procedure import five_stage
from loopwright.tuning.models import Model, TransferFunction, sign, time_constants
from loopwright.tuning.plan import Command, Mode, Note, Plan, StageDone, StageStarted, Work
from loopwright.tuning.reasons import Ended

SAMPLES_PER_PERIOD, SAMPLES_PER_T95 = 60, 100
"""A loop that is sampled faster than this many times in its ultimate period, and in T95, is simulated at this rate."""
MOST_SAMPLES = 100_000
DEVIATIONS, STEP = 2.0, 0.05
"""Standard deviations of the model within which it is taken to be, and those by which it is moved to see what that does
to PV: farther off, a model of which a record tells little is another plant."""
NOISES = 3.0
"""Standard deviations of its noise by which PV is beyond where the plant is."""
MARGIN, MARGIN_UNKNOWN = 0.03, 0.1
"""What is added to the way of PV, as a part of it: of a model with a covariance, and of one without."""
MOST_OPEN = 0.5
"""The largest part of the way of PV that the uncertainty of the model adds: where a small move of the model makes the
test take another turn, its effect is no measure of that."""
ROUGH = 2.0
"""Factor within which the way of PV is known by a rough model."""
SIZED_TO, MAX_SIZED = 0.95, 4
"""Part of PV's limits to which the relay's first wave is sized, and in how many steps."""
SEVERAL_TIMES = 2.0
"""Where PV stays within its limits even on so many times its likely way, the uncertainty of the model is not asked."""
STILL = ("preflight", "settle", "design", "redesign", "estimate", "optimise")
"""Stages that move nothing."""


def excursions(config: LoopConfig, request: RetuneRequest, state: LoopState, known: LoopModel) -> ExpectedPv:
    """Returns how far PV is expected to go in each stage; nothing where the model does not tell.

    config: the configuration with the limits of the job.
    """
    asked = _asked(config, request, state, known)
    return NOTHING_EXPECTED if asked is None else _within_limits(asked, config.pv_unit)


def near_limits(config: LoopConfig, request: RetuneRequest, state: LoopState, known: LoopModel) -> ExpectedPv:
    """The same where PV may come near its limits, else nothing, which takes a tenth of the time."""
    asked = _asked(config, request, state, known)
    if asked is None:
        return NOTHING_EXPECTED
    ranges = _ranges(asked, asked.known.model).values()
    low, high = (SEVERAL_TIMES * max((abs(each[side]) for each in ranges), default=0.0) for side in (0, 1))
    if -low >= asked.facts.pv_low and high <= asked.facts.pv_high:
        return NOTHING_EXPECTED
    return _within_limits(asked, config.pv_unit)


@dataclass(frozen=True, slots=True)
class _Asked:
    """facts: of the loop around its rest, sampled no faster than the simulation needs. rest: PV there, PV units.
    begins_with: as of `FastOptions`. ends: of the pulses of the set-point, as of `expected_moves`."""

    config: LoopConfig
    request: RetuneRequest
    mode: Mode
    facts: Facts
    known: LoopModel
    rest: float
    begins_with: float | None = None
    ends: tuple[float, ...] = LAST_LEVEL_TURNS

    @property
    def noise(self) -> float:
        return self.known.noise or 0.0


def _asked(config: LoopConfig, request: RetuneRequest, state: LoopState, known: LoopModel) -> _Asked | None:
    if (sign(known.model) > 0.0) != state.reverse_acting or not all(map(math.isfinite, (state.pv, state.sp, state.mv))):
        return None
    try:
        facts = facts_of(config, state)
    except Ended:
        return None
    if not facts.mv_low < state.mv < facts.mv_high:
        return None
    found, slow = ultimate(known.model), facts.T95_s / SAMPLES_PER_T95
    Ts = max(facts.sample_time_s, slow if found is None else min(slow, found.Pu_s / SAMPLES_PER_PERIOD))
    rest = state.pv if state.mode is Mode.MANUAL else state.sp
    facts = replace(
        facts, sample_time_s=Ts, mv_low=facts.mv_low - state.mv, mv_high=facts.mv_high - state.mv,
        pv_low=facts.pv_low - rest, pv_high=facts.pv_high - rest,
    )  # fmt: skip
    return _Asked(config, request, state.mode, facts, known, rest)


def _within_limits(asked: _Asked, unit: str) -> ExpectedPv:
    facts, stages = asked.facts, _stages(asked)
    relay, begins_with = stages.get("relay"), None
    adapted = asked.request.adapts_relay
    if relay is not None and adapted and _share(relay, facts) > 1.0:
        amplitude = FIRST_AMPLITUDE * max_amplitude(0.0, facts.mv_low, facts.mv_high, facts.mv_step_max)
        least = MIN_OUTPUT_RANGE * asked.noise / (relay.down + relay.up)
        smallest = max(MIN_AMPLITUDE_PCT, amplitude * least)
        for _ in range(MAX_SIZED):
            amplitude = begins_with = max(smallest, SIZED_TO * amplitude / _share(stages["relay"], facts))
            stages = _stages(replace(asked, begins_with=amplitude))
            if amplitude == smallest or "relay" not in stages or _share(stages["relay"], facts) <= 1.0:
                break
    moving = {stage: reach for stage, reach in stages.items() if stage not in STILL}
    first = next((stage for stage, reach in moving.items() if _breaks(asked, reach)), None)
    broken = () if first is None else (_sentence(asked, first, moving, unit),)
    return ExpectedPv(asked.known.source, stages, begins_with, broken)


def _share(reach: Reach, facts: Facts) -> float:
    """How far PV goes at most, as a part of the way to its nearer limit."""
    sides = ((reach.up, facts.pv_high), (reach.down, -facts.pv_low))
    return max(gone / room if room > 0.0 else math.inf for gone, room in sides if gone > 0.0)


def _breaks(asked: _Asked, reach: Reach) -> bool:
    """Whether PV goes beyond its limits on the model itself: where it may only do so, the test is worth while."""
    least = 1.0 / ROUGH if asked.known.rough else 1.0
    return least * reach.likely_up > asked.facts.pv_high or -least * reach.likely_down < asked.facts.pv_low


def _sentence(asked: _Asked, stage: str, stages: Mapping[str, Reach], unit: str) -> str:
    """What is wrong with a stage, and what would do for all of them."""
    config, facts, rest, reach = asked.config, asked.facts, asked.rest, stages[stage]
    low, high = config.pv_limits.low, config.pv_limits.high
    text = (
        f"PV is expected between {rest - reach.likely_down:.5g} and {rest + reach.likely_up:.5g} {unit} in stage "
        f"{stage}, by {asked.known.source}: that is beyond its limits {low:g} .. {high:g}"
    )
    down, up = (max(getattr(each, side) for each in stages.values()) for side in ("down", "up"))
    limits = f"PV limits of {min(low, rest - down):.5g} .. {max(high, rest + up):.5g}"
    share = max(reach.likely_up / facts.pv_high, reach.likely_down / -facts.pv_low) if facts.pv_low < 0.0 else math.inf
    given = asked.request.relay_amplitude_pct
    if stage != "relay":
        step = config.sp_deviation * SIZED_TO / share
        return f"{text}; ask for an sp_deviation of at most {step:.3g} {unit}, or for {limits}"
    if isinstance(asked.request, FiveStages):
        return f"{text}; this relay takes all the room of MV: ask for method fast, narrower mv_limits, or {limits}"
    if given is not None:
        return f"{text}; ask for an amplitude_pct of at most {given * SIZED_TO / share:.3g}, or for {limits}"
    return f"{text} though the relay begins as small as the noise of PV permits: ask for {limits}"


def _stages(asked: _Asked) -> dict[str, Reach]:
    """How far PV goes in each stage. What the uncertainty of the model adds is that of its axes, as of independent
    errors."""
    likely = _ranges(asked, asked.known.model)
    beside, others = likely, []
    if asked.known.covariance is not None:
        asked = _with_worst_end(asked)
        beside = _ranges(asked, asked.known.model)
        others = [_ranges(asked, each) for each in _neighbours(asked.known)]
    margin = ROUGH if asked.known.rough else 1.0 + (MARGIN_UNKNOWN if asked.known.covariance is None else MARGIN)
    noises, found = NOISES * asked.noise, {}
    for stage, (low, high) in likely.items():
        near = [each[stage] for each in others if stage in each]
        at = beside.get(stage, (low, high))
        open_down, open_up = (math.hypot(*(each[side] - at[side] for each in near)) for side in (0, 1))
        down = min(DEVIATIONS / STEP * open_down, -MOST_OPEN * low) - low
        up = min(DEVIATIONS / STEP * open_up, MOST_OPEN * high) + high
        found[stage] = Reach(margin * down + noises, margin * up + noises, noises - low, noises + high)
    return found


def _with_worst_end(asked: _Asked) -> _Asked:
    """With two ends of the pulses alone: the longest, and the one after which PV goes farthest on the model itself. To
    ask more of them what the uncertainty of the model adds would only take longer."""
    if len(list(_plans(asked, asked.known.model))) == 1:
        return asked

    def farthest(end: float) -> float:
        ranges = _ranges(replace(asked, ends=(end,)), asked.known.model)
        return max((max(-low, high) for low, high in ranges.values()), default=0.0)

    return replace(asked, ends=(LAST_LEVEL_TURNS[0], max(LAST_LEVEL_TURNS[1:], key=farthest)))


def _neighbours(known: LoopModel) -> Iterator[Model]:
    """A model near the known one on each axis of what it may be."""
    if known.covariance is None:
        return
    num, den = (np.asarray(each) / known.model.den[0] for each in (known.model.num, known.model.den))
    parameters = np.array([*num, *den[1:], known.model.L])
    covariance = np.array(known.covariance)
    if covariance.shape != (len(parameters), len(parameters)):
        return
    errors = np.sqrt(np.maximum(np.diag(covariance), np.finfo(float).tiny))
    sizes, axes = np.linalg.eigh(covariance / np.outer(errors, errors))
    for size, axis in zip(sizes, axes.T, strict=True):
        at = parameters + STEP * math.sqrt(max(size, 0.0)) * errors * axis
        yield TransferFunction(tuple(at[: len(num)]), (1.0, *at[len(num) : -1]), max(float(at[-1]), 0.0))


def _ranges(asked: _Asked, model: Model) -> dict[str, tuple[float, float]]:
    found: dict[str, tuple[float, float]] = {}
    for plan, mode in _plans(asked, model):
        for stage, (low, high) in _reached(plan, loop_on(model, asked.facts, mode)).items():
            before = found.get(stage, (0.0, 0.0))
            found[stage] = min(low, before[0]), max(high, before[1])
    return found


def _plans(asked: _Asked, model: Model) -> Iterator[tuple[Plan[Any], Mode]]:
    """The plans that are driven one after the other, each from rest, with the mode of the loop."""
    request, facts = asked.request, asked.facts
    if isinstance(request, FiveStages):
        yield five_stage(facts, request.options), Mode.AUTOMATIC
        return
    if request.known_model is not None:
        yield trial(facts, request.options, request.known_model), Mode.AUTOMATIC
        return
    spec = request.options.spec()
    options = request.options if isinstance(request, FastRetune) else FastOptions()
    options = replace(options, begins_with=asked.begins_with)
    tried = excitations(asked.config, request, asked.mode) or (Excitation.SETPOINT,)
    new = _new_gains(model, spec, facts.sample_time_s) if request.verify else None
    for each in tried:
        after_pulses = each is Excitation.RELAY and Excitation.SETPOINT in tried
        mode = Mode.MANUAL if each is Excitation.MANUAL else Mode.AUTOMATIC
        for turns in asked.ends if each is Excitation.SETPOINT and new is not None else LAST_LEVEL_TURNS[:1]:
            yield expected_moves(each, facts, asked.noise, options, model, new, after_pulses, turns), mode


@lru_cache(256)
def _new_gains(model: Model, spec: DesignSpec, sample_time_s: float) -> NewGains | None:
    """The gains that would be tried; None where the model permits none. It takes 0.1 s, and a page may ask often."""
    try:
        gains = designed_on(model, spec, sample_time_s).gains
    except Ended:
        return None
    found = ultimate(model)
    period = found.Pu_s if found else 4.0 * (model.L + float(max(time_constants(model), default=0.0)))
    return NewGains(on_trial(gains), period)


def _reached(plan: Plan[Any], loop: RehearsedLoop) -> dict[str, tuple[float, float]]:
    """The lowest and the highest PV of each stage of a plan, to its end or to its refusal."""
    found: dict[str, tuple[float, float]] = {}
    stage = ""
    try:
        answer = next(plan)
        for _ in range(MOST_SAMPLES):
            commands: list[Command] = []
            for item in answer:
                if isinstance(item, StageStarted):
                    stage = item.stage
                elif isinstance(item, Work):
                    item.run()
                elif not isinstance(item, StageDone | Note):
                    commands.append(item)
            sample = loop.step(commands)
            low, high = found.get(stage, (sample.pv, sample.pv))
            found[stage] = min(low, sample.pv), max(high, sample.pv)
            answer = plan.send(sample)
    except (StopIteration, Ended):
        pass
    finally:
        plan.close()
    return found

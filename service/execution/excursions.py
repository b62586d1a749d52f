"""How far PV will go in a retune: the moves of the procedures, driven on the model of the loop that is known."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np

from loopwright.service.execution.rehearsal import RehearsedLoop, loop_on
from loopwright.service.inputs.config import LoopConfig
from loopwright.service.inputs.request import FastRetune, FiveStages, RetuneRequest, SetpointRetune, excitations
from loopwright.service.planning.expected import Expected, LoopModel, Reach
from loopwright.service.planning.facts import facts_of
from loopwright.service.states.loop_state import LoopState
from loopwright.tuning.experiments.primitives import Facts
from loopwright.tuning.fast.design import DesignSpec
from loopwright.tuning.fast.design_trial import designed_on, trial
from loopwright.tuning.fast.expected_moves import NewGains, expected_moves, new_gains
from loopwright.tuning.fast.procedure import FastOptions
from loopwright.tuning.fast.proposal import ultimate
from loopwright.tuning.fast.record import Excitation
from loopwright.tuning.five_stage.procedure import five_stage
from loopwright.tuning.models import Model, TransferFunction, monic, sign, time_constants
from loopwright.tuning.plan import Mode, Plan, StageStarted, Work
from loopwright.tuning.reasons import Ended

SAMPLES_PER_PERIOD, SAMPLES_PER_T95 = 60, 100
"""A loop that is sampled faster than this many times in its ultimate period, and in T95, is simulated at this rate."""
MOST_SAMPLES = 100_000
DEVIATIONS = 2.0
"""Standard deviations of the model within which it is taken to be."""
NOISES = 3.0
"""Standard deviations of its noise by which PV is beyond where the plant is."""
Ranges = Mapping[str, tuple[float, float]]
"""The lowest and the highest PV of each stage, from rest, PV units."""


def excursions(config: LoopConfig, request: RetuneRequest, state: LoopState, known: LoopModel) -> Expected:
    """Returns how far PV is expected to go in each stage; nothing where the model does not tell.

    config: the configuration with the limits of the job.
    """
    try:
        facts, noise = _facts(config, request, state, known), known.noise or 0.0
    except Ended:
        return Expected()
    if not (math.isfinite(state.pv) and facts.mv_low < 0.0 < facts.mv_high) or (sign(known.model) > 0.0) != facts.reverse:
        return Expected()
    likely = _ranges(config, request, state.mode, facts, noise, known.model)
    others = [_ranges(config, request, state.mode, facts, noise, each) for each in _neighbours(known)]
    found = {}
    for stage, (low, high) in likely.items():
        ranges = [each[stage] for each in others if stage in each]
        down = math.hypot(*(max(0.0, low - each[0]) for each in ranges)) + NOISES * noise
        up = math.hypot(*(max(0.0, each[1] - high) for each in ranges)) + NOISES * noise
        found[stage] = Reach(down - low, high + up, -low, high)
    return Expected(known.source, found)


def _facts(config: LoopConfig, request: RetuneRequest, state: LoopState, known: LoopModel) -> Facts:
    """The facts of the loop around its rest, sampled no faster than the simulation needs. Raises Refused."""
    facts = facts_of(config, state)
    found = ultimate(known.model)
    slow = facts.T95_s / SAMPLES_PER_T95
    Ts = max(facts.sample_time_s, slow if found is None else min(slow, found.Pu_s / SAMPLES_PER_PERIOD))
    at = state.pv if state.mode is Mode.MANUAL else state.sp
    return replace(
        facts, sample_time_s=Ts, mv_low=facts.mv_low - state.mv, mv_high=facts.mv_high - state.mv,
        pv_low=facts.pv_low - at, pv_high=facts.pv_high - at,
    )  # fmt: skip


def _neighbours(known: LoopModel) -> Iterator[Model]:
    """The models at the ends of the axes of what the known one may be."""
    if known.covariance is None:
        return
    num, den = monic(known.model)
    parameters = np.array([*num, *den[1:], known.model.L])
    covariance = np.array(known.covariance)
    if covariance.shape != (len(parameters), len(parameters)):
        return
    sizes, axes = np.linalg.eigh(covariance)
    for size, axis in zip(sizes, axes.T, strict=True):
        for way in (1.0, -1.0):
            at = parameters + way * DEVIATIONS * math.sqrt(max(size, 0.0)) * axis
            yield TransferFunction(tuple(at[: len(num)]), (1.0, *at[len(num) : -1]), max(float(at[-1]), 0.0))


def _ranges(
    config: LoopConfig, request: RetuneRequest, mode: Mode, facts: Facts, noise: float, model: Model
) -> dict[str, tuple[float, float]]:
    found: dict[str, tuple[float, float]] = {}
    for plan, at in _plans(config, request, mode, facts, noise, model):
        for stage, (low, high) in _reached(plan, loop_on(model, facts, at)).items():
            before = found.get(stage, (0.0, 0.0))
            found[stage] = min(low, before[0]), max(high, before[1])
    return found


def _plans(
    config: LoopConfig, request: RetuneRequest, mode: Mode, facts: Facts, noise: float, model: Model
) -> Iterator[tuple[Plan[Any], Mode]]:
    """The plans that are driven one after the other, each from rest, with the mode of the loop."""
    if isinstance(request, FiveStages):
        yield five_stage(facts, request.options), Mode.AUTOMATIC
        return
    options = request.options if isinstance(request, FastRetune) else FastOptions(**_design_options(request))
    if isinstance(request, FastRetune) and request.start == "design" and request.model is not None:
        yield trial(facts, options, request.model.plant()), Mode.AUTOMATIC
        return
    tried = (Excitation.SETPOINT,) if isinstance(request, SetpointRetune) else excitations(config, request, mode)
    new = _new_gains(model, options.spec(), facts.sample_time_s) if request.verify else None
    for each in tried:
        after_pulses = each is Excitation.RELAY and Excitation.SETPOINT in tried
        at = Mode.MANUAL if each is Excitation.MANUAL else Mode.AUTOMATIC
        yield expected_moves(each, facts, noise, options, new, after_pulses), at


def _design_options(request: RetuneRequest) -> dict[str, Any]:
    assert isinstance(request, SetpointRetune)
    options = request.options
    return {name: getattr(options, name) for name in options.__dataclass_fields__}


@lru_cache(256)
def _new_gains(model: Model, spec: DesignSpec, sample_time_s: float) -> NewGains | None:
    """The gains that would be tried; None where the model permits none. It takes 0.1 s, and a page may ask often."""
    try:
        gains = designed_on(model, spec, sample_time_s).gains
    except Ended:
        return None
    found = ultimate(model)
    period = found.Pu_s if found else 4.0 * (model.L + float(max(time_constants(model), default=0.0)))
    return new_gains(gains, period, model)


def _reached(plan: Plan[Any], loop: RehearsedLoop) -> dict[str, tuple[float, float]]:
    """The lowest and the highest PV of each stage of a plan, to its end or to its refusal."""
    found: dict[str, tuple[float, float]] = {}
    stage = ""
    try:
        answer = next(plan)
        for _ in range(MOST_SAMPLES):
            commands = []
            for item in answer:
                if isinstance(item, StageStarted):
                    stage = item.stage
                elif isinstance(item, Work):
                    item.run()
                else:
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

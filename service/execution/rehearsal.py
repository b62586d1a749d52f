"""The whole procedure in memory: the pure plant model and the pure controller algorithm behind the interface `Loop`.

This is the only module of the service that imports plantsim and controller, and only their pure parts.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields
from typing import Any

import numpy as np
from pydantic import ValidationError

from loopwright.controller.channel import Channel, RelaySettings, Settings
from loopwright.controller.pid import Parameters
from loopwright.plantsim.plant import LinearPlant, SimulatedProcess
from loopwright.service.execution.guard import RunLimits
from loopwright.service.execution.rehearsed import Rehearsal, RehearsalRecord
from loopwright.service.execution.result import result_of
from loopwright.service.execution.runner import RunResult, run
from loopwright.service.inputs.plant_file import PlantFile, PresentGains, RehearsedPlant
from loopwright.service.inputs.plausible import Implausible, check_sampling
from loopwright.service.inputs.validation import did_you_mean, lines
from loopwright.service.loops.loop import Restored
from loopwright.service.results import UltimateView, empty_result
from loopwright.service.states.loop_state import LoopState
from loopwright.tuning.analysis.margins import ultimate_point
from loopwright.tuning.experiments.primitives import Facts
from loopwright.tuning.fast.design.options import DesignOptions
from loopwright.tuning.fast.excitation_choice import chosen_stages, fast_by
from loopwright.tuning.fast.known_plant.design_trial import trial
from loopwright.tuning.fast.pulses.procedure import SETPOINT, setpoint
from loopwright.tuning.fast.record import Excitation
from loopwright.tuning.fast.relay.procedure import FAST, FastOptions, FastProposal
from loopwright.tuning.five_stage.procedure import PROCEDURE, STAGES, Options, Proposal, five_stage
from loopwright.tuning.five_stage.ultimate_gain import UltimateResult
from loopwright.tuning.gains import Gains
from loopwright.tuning.models import FOPDT, SOPDT, Model, TransferFunction
from loopwright.tuning.plan import (
    Command,
    Event,
    Mode,
    Plan,
    Sample,
    SetGains,
    SetMode,
    SetOutput,
    SetPvLimits,
    SetRelay,
    SetSetpoint,
    StageDone,
)
from loopwright.tuning.reasons import Ended, NoGain, Reason, Refused
from loopwright.tuning.rules.registry import METHODS


class RehearsedLoop:
    """A `Loop` in memory, which runs as fast as the machine permits. Commands act on the next sample."""

    waits = True

    def __init__(self, plant: SimulatedProcess, channel: Channel, sample_time_s: float) -> None:
        self._plant = plant
        self._channel = channel
        self._dt = sample_time_s
        self._n = 0
        self._home, self._held = channel.home, False
        self._pv = plant.pv

    def read(self, beside_tests: bool = False) -> LoopState:
        channel = self._channel
        return LoopState(
            mode=Mode(channel.mode),
            sp=channel.setpoint,
            pv=self._pv,
            mv=channel.mv,
            gains=_gains(channel.accepted),
            on_trial=channel.on_trial,
            mv_low=channel.settings.mv_low,
            mv_high=channel.settings.mv_high,
            sample_time_s=self._dt,
            reverse_acting=channel.settings.reverse,
            manual_output=channel.manual_output,
        )

    def begin(
        self,
        stop: Callable[[], Reason | None] = lambda: None,
        note_session: Callable[[int], None] = lambda session: None,
    ) -> LoopState:
        self._home, self._held = self._channel.home, False
        return self.read()

    def step(self, commands: Sequence[Command]) -> Sample:
        channel = self._channel
        for command in commands:
            self._carry_out(command)
        mv = channel.step(self._pv)
        sample = Sample(self._n * self._dt, channel.setpoint, self._pv, mv, channel.mode)
        self._pv = self._plant.step(mv)
        self._n += 1
        return sample

    def _carry_out(self, command: Command) -> None:
        channel = self._channel
        match command:
            case SetSetpoint(value):
                channel.setpoint = value
            case SetMode(mode):
                if int(mode) != int(channel.mode):
                    channel.command_mode(int(mode))
            case SetGains(gains):
                channel.try_gains(_parameters(gains))
            case SetOutput(value):
                channel.manual_output = value
            case SetRelay(amplitude, hysteresis, working, amplitude_low, average):
                low, high = channel.settings.pv_low, channel.settings.pv_high
                channel.start_relay(
                    RelaySettings(amplitude, hysteresis, working, 10**9, low, high, amplitude_low or 0.0, average)
                )
            case SetPvLimits():
                pass  # the runner alone watches PV in memory

    def hold(self) -> None:
        self._held = True
        self._home = self._home.held()
        self._channel.go_home(self._home)

    def restore(self, home: LoopState, session: int | None = None) -> Restored:
        self._channel.go_home(self._home)
        return Restored(self.read(), "the test is over", held=self._held)

    def accept(self, gains: Gains, instead_of: Gains) -> LoopState:
        self._channel.accept(_parameters(gains))
        return self.read()

    def close(self) -> None:
        """Does nothing: a loop in memory holds no resources."""


def _parameters(gains: Gains) -> Parameters:
    return Parameters(gains.Kp, gains.Ti, gains.Td, gains.Tf, gains.b, gains.c)


def _gains(p: Parameters) -> Gains:
    return Gains(p.Kp, p.Ti, p.Td, p.Tf, p.b, p.c)


def _nice(x: float) -> float:
    """Returns the largest 1, 2 or 5 times a power of ten that is not above x."""
    power = 10.0 ** math.floor(math.log10(x))
    return next(m * power for m in (5.0, 2.0, 1.0) if m * power <= x * (1 + 1e-9))


def _complete(file: PlantFile) -> PlantFile:
    """Fills in what was left out, from the model: T95, Ts (at most Pu / 300), step and present gains."""
    poles = np.roots(file.den)
    gain = file.num[-1] / file.den[-1] if file.den[-1] else math.inf
    t95 = file.t95_s
    if t95 is None:
        if len(poles) and float(poles.real.max()) >= -1e-9:
            slow = max((1 / abs(p) for p in poles if abs(p) > 1e-9), default=1.0)
            t95 = file.dead_time_s * 4 + 3 * slow
        else:
            t95 = _t95(file)
    ts = file.sample_time_s or _nice(max(_period(file, t95) / 300, t95 / 5000))
    room = min(-file.mv_limits[0], file.mv_limits[1])
    step = file.sp_deviation or 0.2 * room * (abs(gain) if math.isfinite(gain) else 1.0)
    try:
        check_sampling(file.dead_time_s, t95, ts)
    except Implausible as error:
        raise Refused(Reason.BAD_INPUT, str(error)) from None
    gains = file.gains or PresentGains(Kp=0.3 / abs(gain) if math.isfinite(gain) else 0.1, Ti=t95 / 3)
    return file.model_copy(update={"sample_time_s": ts, "t95_s": t95, "sp_deviation": step, "gains": gains})


def _period(file: PlantFile, t95: float) -> float:
    """Returns the ultimate period, s; for a plant without one, a time that is short compared with T95."""
    try:
        period = ultimate_point(TransferFunction(tuple(file.num), tuple(file.den), file.dead_time_s))[1]
    except (Ended, ValueError, ArithmeticError):
        return t95 / 2
    return period if 0 < period < math.inf else t95 / 2


def _t95(file: PlantFile) -> float:
    """Returns the time after which the plant's step response stays within 5 % of its end, s."""
    slowest = max((1 / abs(p.real) for p in np.roots(file.den)), default=1.0)
    dt = max(slowest, file.dead_time_s) / 200
    plant = LinearPlant(file.num, file.den, file.dead_time_s, dt)
    y = np.array([plant.step(1.0) for _ in range(round((12 * slowest + file.dead_time_s) / dt))])
    end = file.num[-1] / file.den[-1]
    away = np.flatnonzero(np.abs(y - end) > 0.05 * abs(end))
    return float(dt * (away[-1] + 2)) if len(away) else 10 * dt


def rehearse(
    spec: Mapping[str, object] | str,
    method: str = FAST,
    on_event: Callable[[Event], None] | None = None,
    on_samples: Callable[[list[Sample]], None] | None = None,
    model: Model | None = None,
    asked: DesignOptions | Options | None = None,
    excitations: tuple[Excitation, ...] = (Excitation.RELAY,),
    **options: Any,
) -> Rehearsal:
    """Runs preflight to verification on a model in memory.

    spec: the fields of `PlantFile`, or a model as a text, K=2,T=10,L=3. One that cannot be used is refused with the
    reason "bad_input".
    method: "fast", "setpoint", "five-stage", or a rule of `tuning.rules.registry` in place of the fifth stage.
    model: the model to design for; fast then needs no relay.
    options: those of `tuning.fast.procedure.FastOptions`, or of `tuning.five_stage.procedure.Options`.
    asked: the options as one of these two; in place of the options by name.
    excitations: what fast may move the loop by; manual alone: the loop is in manual.
    """
    record = None if on_samples else RehearsalRecord()
    try:
        file = _complete(PlantFile.model_validate(spec))
        loop, facts = _loop(file, Mode.MANUAL if excitations == (Excitation.MANUAL,) else Mode.AUTOMATIC)
        asked = asked or options_of(method, model, options)
    except ValidationError as error:
        return Rehearsal(empty_result(method), Refused(Reason.BAD_INPUT, lines(error)))
    except Ended as ended:
        return Rehearsal(empty_result(method), ended)
    limits = _limits(facts, _reach(file))
    hooks = on_event or (lambda event: None), on_samples or (lambda samples: None)
    return rehearsal_of(facts, asked, loop, limits, file, method, hooks, record, model, excitations)


def rehearsal_of(
    facts: Facts,
    asked: DesignOptions | Options,
    loop: RehearsedLoop,
    limits: RunLimits,
    plant: RehearsedPlant,
    method: str,
    hooks: tuple[Callable[[Event], None], Callable[[list[Sample]], None]] = (lambda event: None, lambda samples: None),
    record: RehearsalRecord | None = None,
    model: Model | None = None,
    excitations: tuple[Excitation, ...] = (Excitation.RELAY,),
) -> Rehearsal:
    """Runs the procedure on a loop in memory.

    plant: what the loop is, to be echoed. hooks: receive events and samples. record: takes them, too.
    model, excitations: as of `rehearse`.
    """
    results: dict[str, object] = {}
    on_event, on_samples = hooks

    def listen(event: Event) -> None:
        if isinstance(event, StageDone):
            results[event.stage] = event.result
        if record is not None:
            record.on_event(event)
        on_event(event)

    def hear(samples: list[Sample]) -> None:
        if record is not None:
            record.on_samples(samples)
        on_samples(samples)

    try:
        outcome = _carried_out(facts, asked, model, excitations, loop, limits, listen, hear)
    except Ended as ended:
        return Rehearsal(empty_result(method), ended)
    return _ended(plant, method, outcome, results, record, asked.propose_anyway)


def _carried_out(
    facts: Facts,
    asked: DesignOptions | Options,
    model: Model | None,
    excitations: tuple[Excitation, ...],
    loop: RehearsedLoop,
    limits: RunLimits,
    listen: Callable[[Event], None],
    hear: Callable[[list[Sample]], None],
) -> RunResult[Proposal] | RunResult[FastProposal]:
    if isinstance(asked, DesignOptions):
        plan = _designing(facts, asked, model, excitations)
        return run(plan, loop, limits=limits, on_event=listen, on_samples=hear)
    return run(five_stage(facts, asked), loop, limits=limits, on_event=listen, on_samples=hear)


def _designing(
    facts: Facts, asked: DesignOptions, model: Model | None, excitations: tuple[Excitation, ...]
) -> Plan[FastProposal]:
    if not isinstance(asked, FastOptions):
        return setpoint(facts, asked)
    return fast_by(excitations, facts, asked) if model is None else trial(facts, asked, model)


def options_of(method: str, model: Model | None, options: dict[str, Any]) -> DesignOptions | Options:
    """The options of a method by their names. Raises Refused, BAD_INPUT."""
    kind: type[DesignOptions] | type[Options] = _OPTIONS.get(method, Options)
    if kind is Options and method not in (PROCEDURE, *METHODS):
        text = f"method must be one of {', '.join((*_OPTIONS, PROCEDURE, *METHODS))}, not {method!r}"
        raise Refused(Reason.BAD_INPUT, text)
    given = options if kind is not Options else {**options, "method": method, "model": _entered(model)}
    known = [each.name for each in fields(kind)]
    for name in given:
        if name not in known:
            text = f"{method} has no option {name!r}{did_you_mean(name, known)}; it has: {', '.join(known)}"
            raise Refused(Reason.BAD_INPUT, text)
    return kind(**given)


_OPTIONS: dict[str, type[DesignOptions]] = {FAST: FastOptions, SETPOINT: DesignOptions}


def _entered(model: Model | None) -> FOPDT | SOPDT | None:
    if model is not None and not isinstance(model, FOPDT | SOPDT):
        raise Refused(Reason.BAD_INPUT, "five-stage takes a model of the form K, T_s, L_s, perhaps with zeta")
    return model


def _loop(file: PlantFile, mode: Mode) -> tuple[RehearsedLoop, Facts]:
    ts, t95, step, gains = file.sample_time_s, file.t95_s, file.sp_deviation, file.gains
    assert ts and t95 and step and gains
    low, high = file.mv_limits
    plant = LinearPlant(
        file.num, file.den, file.dead_time_s, ts, noise_std=file.noise_std, seed=file.seed, mv_low=low, mv_high=high
    )
    positive = (file.num[-1] or file.num[0]) / (file.den[-1] or file.den[0]) > 0
    reverse = positive if file.reverse_acting is None else file.reverse_acting
    facts = Facts(
        ts, t95, low, high, step, Gains(**gains.model_dump()), reverse,
        mv_step_max=file.mv_step_max or math.inf,
        directions=file.directions,
        sp_rate_max_per_s=file.sp_rate_max_per_s or math.inf,
    )  # fmt: skip
    return loop_of(plant, facts, mode), facts


def loop_on(model: Model, facts: Facts, mode: Mode) -> RehearsedLoop:
    """A loop without noise at rest on a model, with SP, PV and MV of 0. Raises ValueError: it cannot be simulated."""
    num, den = list(model.num), list(model.den)
    plant = LinearPlant(num, den, model.L, facts.sample_time_s, mv_low=facts.mv_low, mv_high=facts.mv_high)
    return loop_of(plant, facts, mode)


def loop_of(plant: SimulatedProcess, facts: Facts, mode: Mode, setpoint: float = 0.0, mv: float = 0.0) -> RehearsedLoop:
    """A loop in memory on a process that rests at this MV."""
    span = 1e9
    settings = Settings(facts.mv_low, facts.mv_high, mv, pv_low=-span, pv_high=span, reverse=facts.reverse)
    channel = Channel(facts.sample_time_s, settings, _parameters(facts.previous_gains), setpoint, int(mode), mv)
    return RehearsedLoop(plant, channel, facts.sample_time_s)


def _limits(facts: Facts, reach: float) -> RunLimits:
    """Returns the limits of a rehearsal. They are wide: an unstable plant must end, but the test moves PV by several
    steps."""
    far = max(100 * facts.sp_deviation, 10 * reach)
    T95_s = facts.T95_s
    return RunLimits(
        -far,
        far,
        facts.mv_low,
        facts.mv_high,
        max_time_s=500 * T95_s,
        max_frozen_s=3 * T95_s,
        sp_deviation=facts.sp_deviation,
    )


def _reach(file: PlantFile) -> float:
    """Returns how far PV moves when MV stays at a limit (0 for an integrating plant), PV units."""
    return abs(file.num[-1] / file.den[-1]) * max(map(abs, file.mv_limits)) if file.den[-1] else 0.0


def _ended(
    plant: RehearsedPlant,
    method: str,
    outcome: RunResult[Proposal] | RunResult[FastProposal],
    results: dict[str, object],
    record: RehearsalRecord | None,
    anyway: bool,
) -> Rehearsal:
    """Returns how a run of the procedure ended.

    anyway: whether a proposal is made also where there is no benefit.
    """
    proposal, ended = outcome.value, outcome.ended
    if proposal is not None and not proposal.comparison.gain and not anyway:
        ended = NoGain(Reason.NO_GAIN, proposal.comparison.verdict)
    stages = dict.fromkeys((*STAGES, *chosen_stages(tuple(Excitation), verify=True)))
    times = {stage: outcome.plant_time_s[stage] for stage in stages if stage in outcome.plant_time_s}
    if proposal is not None:
        return Rehearsal(result_of(proposal), ended, times, results, plant, record)
    found, result = results.get("ultimate"), empty_result(method)
    if isinstance(found, UltimateResult):
        result = result.model_copy(update={"ultimate": UltimateView(Ku=found.Ku, Pu_s=found.Pu_s)})
    return Rehearsal(result, ended, times, results, plant, record)

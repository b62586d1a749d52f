"""Pulses of the set-point under the present gains, and the set-point step home under new ones, with their record.

The loop never leaves automatic. The set-point moves up, down and up again; each pulse turns while PV still moves, so
that the record shows the plant around its ultimate frequency and PV stays near the permitted set-point step. The fit
goes from MV to PV, so that the controller need not be known.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import partial

import numpy as np

from loopwright.tuning.experiments.primitives import Directions, Facts, OperatingPoint, Trace, held
from loopwright.tuning.experiments.step_test import KICK_OF_ROOM
from loopwright.tuning.fast.evaluation.proposal import PulseFigures
from loopwright.tuning.fast.experiment import STEP_BACK_FRACTION, VERIFICATION_PERIODS, Experiment
from loopwright.tuning.fast.forecast import Past
from loopwright.tuning.fast.pulses.levels import (
    CAME_BACK,
    FOLLOWED_TO_ONE_SIDE,
    MIN_FOLLOWED,
    PulseBounds,
    step_fits,
)
from loopwright.tuning.fast.record import Excitation, ExperimentRecord
from loopwright.tuning.gains import Gains
from loopwright.tuning.models import Model, Reals
from loopwright.tuning.plan import Command, Note, Plan, Sample, SetGains, SetSetpoint
from loopwright.tuning.reasons import Reason, Refused

UP, DOWN, BACK = 1.0, -1.0, 0.0
"""The levels of the set-point, in sizes of a pulse: up, down as far as `pulse_levels` permits, and up again as far as
it permits; the last level is held until the step home. Where the set-point may go to one side only, it goes back to
where it was in place of down."""
MAX_PV_DEVIATION = 1.5
"""Largest deviation of PV from rest during the pulses, in permitted steps of the set-point."""
MIN_FOLLOWED_NOISES = 5.0
"""A pulse turns when PV has followed the fraction MIN_FOLLOWED of the set-point's move, and this many standard
deviations of the noise."""
NOISES_TO_ONE_SIDE = 10.0
"""The same for the first pulse where the set-point may go to one side only: half of it is left for the way back."""
MAX_BEYOND = 0.5
"""How far PV may go beyond its rest to the side that is not permitted, in permitted steps: it overshoots on its way
back."""
SAMPLES_AVERAGED = 3
AVERAGE = np.full(SAMPLES_AVERAGED, 1.0 / SAMPLES_AVERAGED)
MAX_T95 = 10.0
"""Longest time for PV to follow a pulse, in T95."""
APPROACH_CHECKED, MAX_APPROACH = 0.25, 8.0
"""How often it is asked whether the step home fits, and for how long at most, in periods of the model."""
MAX_AT_LIMIT_T95, MAX_AT_LIMIT_PART = 0.5, 0.5
"""Longest time for which MV may stand at a limit while no period is known: the longer of this number of T95 and this
part of the time since the first pulse. Later it is the longer of the ultimate period and the time of two turns: under
gains that overshoot MV leaves its limit within half a period."""
HAIR = 1e-6
"""Distance from a limit at which MV is at it, as a fraction of MV's range: a REAL32 on the bus."""


class PulseExperiment(Experiment):
    """What pulses of the set-point and of the manual output share; arguments as of `Experiment`."""

    size: float
    """Of a pulse, in units of what is moved."""

    def __init__(self, facts: Facts, point: OperatingPoint, listened: Trace) -> None:
        super().__init__(facts, point, listened)
        self.turns: list[int] = []
        """The samples at which the set-point, or MV, moved; the first one is the start."""
        self.period = 0.0
        """The time scale of the record, in samples; known after the first pulse."""

    def figures(self) -> PulseFigures:
        """The figures of the pulses so far."""
        record = self.experiment_record()
        return PulseFigures(
            turns=record.turns,
            size=self.size,
            period_s=record.period * record.Ts,
            output_range=record.output_range,
            noise=self.noise,
            samples=len(record.y),
        )

    def columns(self) -> tuple[Reals, Reals]:
        """MV and PV since the first pulse, as deviations from rest."""
        u, y = self._deviations()
        return u[self.listened :], y[self.listened :]


class PulseTest(PulseExperiment):
    """The pulses of the set-point, and the set-point step home that follows them.

    facts, point: what is known of the loop, and the operating point at rest.
    listened: the samples at rest, with which the record begins.
    """

    def __init__(self, facts: Facts, point: OperatingPoint, listened: Trace) -> None:
        super().__init__(facts, point, listened)
        self.size = pulse_size(facts.sp_deviation, point.room, facts.previous_gains, facts.one_sided)
        self.levels: list[float] = []  # of the set-point, in sizes of a pulse
        self._gains = facts.previous_gains
        self._at_limit = 0

    def start(self) -> Plan[None]:
        """Makes the first move of the set-point."""
        self.listened = self.excited = len(self.trace)
        yield from self.turn(UP)

    def turn(self, level: float) -> Plan[None]:
        """Moves the set-point to a level, in sizes of a pulse."""
        self.turns.append(len(self.trace))
        self.levels.append(level)
        self._commands = (SetSetpoint(self.point.sp + level * self._signed_size),)
        yield from self.sample()

    def turn_within_bounds(
        self, level_of: Callable[[Past, int, float, PulseBounds], float], wanted: float
    ) -> Plan[None]:
        """Turns the set-point to the level that this function finds, see `pulse_levels`.

        wanted: the level where nothing bounds it.
        """
        work = partial(level_of, self._past(), self.listened, self._signed_size, self._bounds())
        level = yield from self.computed(work)
        if level != wanted:
            size = self._signed_size
            yield from self.report(
                Note(f"a pulse to {level * size:+.3g} in place of {wanted * size:+.3g} keeps PV and MV within bounds")
            )
        yield from self.turn(level)

    def sample(self) -> Plan[None]:
        """Lets one sample pass."""
        self._commands = self._on_sample((yield self._commands))

    def until_followed(self, max_T95: float = MAX_T95) -> Plan[None]:
        """Goes on until PV has followed the last move of the set-point far enough to turn.

        max_T95: the longest time for that, in T95.
        Raises Refused where PV does not follow, see `held`; otherwise STALLED.
        """
        Ts = self.facts.sample_time_s
        while not self._followed():
            yield from self.sample()
            passed = (len(self.trace) - self.turns[-1]) * Ts
            if passed > max(max_T95 * self.facts.T95_s, 40 * Ts) + self.facts.ramp_s(self._move):
                raise self._not_followed(passed)

    def followed_or_for(self, samples: int) -> Plan[None]:
        """Goes on until PV has followed the last move of the set-point, or for this number of samples since then."""
        while not self._followed() and len(self.trace) - self.turns[-1] < samples:
            yield from self.sample()

    def lasting(self, samples: float) -> Plan[None]:
        """Goes on until the record has lasted this number of samples since the first pulse."""
        while self.elapsed < samples:
            yield from self.sample()

    @property
    def elapsed(self) -> int:
        """The number of samples since the first pulse."""
        return len(self.trace) - self.listened

    def approach(self, models: Sequence[Model], gains: Gains, model_period: float) -> Plan[None]:
        """Brings the set-point near enough to where the test began, under the present gains, that MV stays within its
        limits when the new gains bring it home: their Kp may be many times the present one.

        models: the models that explain the record. gains: the new gains. model_period: the ultimate period, s.
        """
        facts, point = self.facts, self.point
        period = model_period / facts.sample_time_s
        samples = int(VERIFICATION_PERIODS * period)

        def fits() -> Plan[bool]:
            at_once = min(abs(self.trace.sp[-1] - point.sp), facts.sp_rate_max_per_s * facts.sample_time_s)
            if gains.b * gains.Kp * at_once > facts.mv_step_max:
                return False
            past = self._past()
            home = float(past.sp[-1]) + point.sp - self.trace.sp[-1]
            return (yield from self.computed(partial(step_fits, past, models, gains, home, self.noise, samples)))

        if (yield from fits()):
            return
        away = self.trace.sp[-1] - point.sp
        near = math.copysign(min(abs(away), self._fitting(gains)), away)
        yield from self.report(
            Note(
                f"Kp {gains.Kp:.4g} times a step of {abs(away):.3g} does not fit into MV's limits: the set-point is "
                f"first brought to {abs(near):.3g} from where it was"
            )
        )
        self._commands = (SetSetpoint(point.sp + near),)
        begun = self.elapsed
        longest = MAX_APPROACH * period + facts.ramp_s(away - near) / facts.sample_time_s
        while self.elapsed < begun + longest:
            yield from self.lasting(self.elapsed + max(1.0, APPROACH_CHECKED * period))
            if (yield from fits()):
                return

    def step(self, gains: Gains, model_period: float) -> Plan[None]:
        """Puts the new gains in effect without a bump, and the set-point back to where the test began.

        model_period: the ultimate period of the model, s.
        """
        point = self.point
        self._follow_s = VERIFICATION_PERIODS * model_period
        output_range = self.experiment_record().output_range
        self._step = point.sp - self.trace.sp[-1]
        self.excited = len(self.trace)
        self._gains = self._gains_tried = gains
        self._commands = ()
        yield from self._follow((SetGains(gains), SetSetpoint(point.sp)), output_range)

    def step_again(self) -> Plan[None]:
        """Steps the set-point by half a pulse under the new gains and follows PV for half as long as after the first
        step."""
        self._follow_s *= STEP_BACK_FRACTION
        step = min(STEP_BACK_FRACTION * self.size, self._fitting(self._gains))
        target = self.point.sp + self.facts.side * step
        yield from self._follow((SetSetpoint(target),), self.experiment_record().output_range)

    def experiment_record(self) -> ExperimentRecord:
        """The record so far, as deviations from rest; `period` must be known. Raises Refused as `ExperimentRecord`."""
        return self._record(len(self.turns) - 1, self.period, Excitation.SETPOINT, self._control())

    def _past(self) -> Past:
        """The record so far for a forecast; PV, set-point and MV are deviations from rest."""
        u, y = self._deviations()
        facts, pv, mv = self.facts, self.trace.pv[-1] - float(y[-1]), self.trace.mv[-1] - float(u[-1])
        return Past(
            Ts=facts.sample_time_s,
            sp=np.asarray(self.trace.sp) - pv,
            pv=y,
            mv=u,
            low=facts.mv_low - mv,
            high=facts.mv_high - mv,
            action=self._direction,
            gains=facts.previous_gains,
            sp_step_max=facts.sp_rate_max_per_s * facts.sample_time_s,
        )

    def _bounds(self) -> PulseBounds:
        """How far PV may move."""
        facts, rest = self.facts, self.point.pv
        low = high = MAX_PV_DEVIATION * facts.sp_deviation
        if facts.directions is Directions.UP:
            low = MAX_BEYOND * facts.sp_deviation
        elif facts.directions is Directions.DOWN:
            high = MAX_BEYOND * facts.sp_deviation
        return PulseBounds(max(-low, facts.pv_low - rest), min(high, facts.pv_high - rest), self.noise)

    @property
    def _signed_size(self) -> float:
        """The size of a pulse, PV units, negative where the first one goes down."""
        return self.facts.side * self.size

    @property
    def _move(self) -> float:
        """The last move of the set-point, PV units."""
        return self._signed_size * (self.levels[-1] - (self.levels[-2] if len(self.levels) > 1 else 0.0))

    def _on_sample(self, sample: Sample) -> tuple[Command, ...]:
        self._add(sample)
        return ()

    def _add(self, sample: Sample) -> None:
        super()._add(sample)
        self._watch_limits(sample)

    def _watch_limits(self, sample: Sample) -> None:
        """Raises Refused where MV stands at a limit, and PV is left to itself: MV_LIMIT, or as `held`."""
        facts = self.facts
        hair = HAIR * (facts.mv_high - facts.mv_low)
        at_limit = bool(self.turns) and not facts.mv_low + hair < sample.mv < facts.mv_high - hair
        self._at_limit = self._at_limit + 1 if at_limit else 0
        if self.period:
            maximum = max(self.period, float(self.turns[-1] - self.listened))
        else:
            maximum = max(MAX_AT_LIMIT_T95 * facts.T95_s / facts.sample_time_s, MAX_AT_LIMIT_PART * self.elapsed)
        if self._at_limit > maximum:
            text = (
                f"MV has stood at its limit of {sample.mv:.4g} for {self._at_limit * facts.sample_time_s:.3g} s, PV is "
                f"{sample.pv - self.point.pv:+.3g} away for a set-point {sample.sp - self.point.sp:+.3g} away: a load "
                "disturbance, or a fault of the plant, asks for more MV than is permitted"
            )
            raise held(facts, self.point, self._tested(), text, Reason.MV_LIMIT, load=Reason.MV_LIMIT)

    def _fitting(self, gains: Gains) -> float:
        """The step of the set-point whose kick under these gains leaves room for MV, PV units."""
        kick = gains.b * gains.Kp
        return KICK_OF_ROOM * self.point.room / kick if kick > 0.0 else self.size

    def _followed(self) -> bool:
        since = self.turns[-1]
        if len(self.trace) < since + SAMPLES_AVERAGED:
            return False
        move = self._move
        begun = float(np.mean(self.trace.pv[max(since - SAMPLES_AVERAGED, 0) : since]))
        now = float(np.mean(self.trace.pv[-SAMPLES_AVERAGED:]))
        if not self.facts.one_sided:
            followed = math.copysign(1.0, move) * (now - begun)
            return followed >= max(MIN_FOLLOWED * abs(move), MIN_FOLLOWED_NOISES * self.noise)
        if len(self.levels) == 1:
            followed = self.facts.side * (now - begun)
            return followed >= max(FOLLOWED_TO_ONE_SIDE * abs(move), NOISES_TO_ONE_SIDE * self.noise)
        # PV goes on for a dead time after the turn, and comes back to where it was at best
        means = self.facts.side * np.convolve(self.trace.pv[since - SAMPLES_AVERAGED :], AVERAGE, mode="valid")
        farthest = float(means.max())
        ends = self.facts.side * (self.point.pv + self.levels[-1] * self._signed_size)
        return farthest - self.facts.side * now >= max(CAME_BACK * (farthest - ends), MIN_FOLLOWED_NOISES * self.noise)

    def _not_followed(self, passed: float) -> Refused:
        moved = float(np.mean(self.trace.pv[-SAMPLES_AVERAGED:])) - self.point.pv
        text = f"{passed:.3g} s after the set-point moved by {self.size:.3g} PV is {moved:+.3g} away"
        return held(self.facts, self.point, self._tested(), text, Reason.STALLED)


def pulse_size(sp_deviation: float, room: float, gains: Gains, one_sided: bool = False) -> float:
    """The size of the pulses, PV units. Under the proportional action of the present gains, a swing from one level to
    the other takes a part of MV's room, and leaves the rest to what PV and the integral add.

    sp_deviation: the largest permitted set-point step, PV units. room: the largest permitted move of MV, MV units.
    one_sided: whether the set-point goes to one side of its rest only.
    """
    kick = (UP - (BACK if one_sided else DOWN)) * gains.b * gains.Kp
    return min(sp_deviation, KICK_OF_ROOM * room / kick) if kick > 0.0 else sp_deviation

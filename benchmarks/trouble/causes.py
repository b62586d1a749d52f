"""What is said of a cause that a test meets, at levels kept apart from those that it was written with, as a table.

    python -m benchmarks.trouble.causes

A row is right where the reason is one of those that name the cause, and the sentence has the word for it; a proposal is
never one. Kinds: a load or a drift in the test, an actuator without effect (C), different lags for rising and falling
(D), a valve that sticks (F).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial

from benchmarks.command import parser_of
from benchmarks.plants import Plant
from benchmarks.trouble import valves
from benchmarks.trouble.cases import build
from benchmarks.trouble.chain import Build, Chain, Part, Setting
from benchmarks.trouble.processes import Lag, Linear
from benchmarks.trouble.runs import TroubledLoop
from loopwright.controller.channel import Channel, Settings
from loopwright.controller.pid import Parameters
from loopwright.service.execution.guard import RunLimits
from loopwright.service.execution.runner import run
from loopwright.tuning.experiments.primitives import Facts
from loopwright.tuning.fast.relay.procedure import FastOptions, fast
from loopwright.tuning.gains import Gains
from loopwright.tuning.models import TransferFunction
from loopwright.tuning.plan import Mode
from loopwright.tuning.reasons import Reason

LOW, HIGH = -40.0, 60.0
FINE = 10


class AgainstMv(Part):
    """A load so many times as large as MV is away, against it, from the k-th half wave of the relay on."""

    def __init__(self, times: float, wave: int, samples: int) -> None:
        self._times, self._wave, self._left = times, wave, samples
        self._runs, self._sign, self._waves, self._load = False, 0.0, 0, 0.0

    def begin(self) -> None:
        self._runs = True

    def step(self, value: float) -> float:
        if self._runs and abs(value) > 1.0 and math.copysign(1.0, value) != self._sign:
            self._sign, self._waves = math.copysign(1.0, value), self._waves + 1
        if self._waves >= self._wave and not self._load:
            self._left -= 1
            self._load = -self._times * value if self._left < 0 else 0.0
        return value + self._load


class Drift(Part):
    """PV drifts from the beginning of the test on, so much per s."""

    def __init__(self, setting: Setting, rate: float) -> None:
        self._each, self._moved, self._runs = rate * setting.h, 0.0, False

    def begin(self) -> None:
        self._runs = True

    def step(self, value: float) -> float:
        self._moved += self._each if self._runs else 0.0
        return value + self._moved


class Without(Part):
    """Passes nothing on."""

    def step(self, value: float) -> float:
        return 0.0


def _against(_: Setting, times: float) -> AgainstMv:
    return AgainstMv(times, 2, 3)


def _lag(setting: Setting, rises_s: float, falls: float) -> Lag:
    return Lag(setting.h, rises_s, falls=falls)


@dataclass(frozen=True, slots=True)
class Cause:
    """A cause at one level.

    reasons, word: of the right answer. model: of the plant. Ts, T95_s: s. warm: samples before the test.
    """

    kind: str
    level: str
    built: Build
    reasons: tuple[Reason, ...]
    word: str
    model: TransferFunction
    gains: Gains
    Ts: float = 0.5
    T95_s: float = 120.0
    noise: float = 0.05
    warm: int = 0
    pv: float = 30.0


def causes() -> Iterator[Cause]:
    """Every cause at three levels that the reference does not have."""
    plant, gains = TransferFunction((0.9,), (36.0, 1.0), 7.0), Gains(1.0, 36.0)
    load = partial(Cause, "C load in the test", model=plant, gains=gains)
    for times in (1.05, 1.25, 1.6):
        made = build(before=partial(_against, times=times))
        yield load(f"{times:g} of the second half wave", made, (Reason.STALLED,), "load")
    for rate in (0.008, -0.015, 0.04):
        made = build(before=lambda _: Without(), after=partial(Drift, rate=rate))
        level = f"MV without effect, {rate:+g} per s"
        yield Cause("C drift", level, made, (Reason.NO_RESPONSE,), "drift", plant, gains)
    for rises, ratio in ((40.0, 1.4), (50.0, 3.0), (70.0, 0.5)):
        slow = TransferFunction((0.9,), (rises, 1.0), 7.0)
        made = build(
            before=partial(_lag, rises_s=rises, falls=ratio),
            process=lambda setting: Linear((0.9,), (1.0,), 7.0, setting.h),
        )
        level = f"{rises:g} s rising, {rises * ratio:g} s falling"
        yield Cause("D two lags", level, made, (Reason.UNEXPLAINED,), "falling", slow, Gains(1.0, 50.0), T95_s=300.0)
    flow = TransferFunction((1.2,), (2.5, 1.0), 1.0)
    for band in (1.0, 2.0, 4.0):
        made = build(before=partial(valves.stiction, band=band))
        yield Cause(
            "F flow cycles", f"valve sticks {band:g}", made, (Reason.NOT_AT_REST, Reason.UNEXPLAINED), "sticks",
            flow, Gains(0.35, 4.0), Ts=0.25, T95_s=20.0, noise=0.08, warm=2000,
        )  # fmt: skip


def said(cause: Cause, seed: int) -> tuple[bool, str]:
    """Whether the right thing is said, and what."""
    plant = Plant(cause.level, cause.model.num, cause.model.den, cause.model.L, 1.0, cause.Ts, 1)
    chain = Chain(Setting(plant, FINE, cause.noise, seed), cause.built)
    settings = Settings(mv_low=LOW, mv_high=HIGH, pv_low=-1e9, pv_high=1e9, reverse=True)
    accepted = Parameters(cause.gains.Kp, cause.gains.Ti)
    channel = Channel(cause.Ts, settings, accepted, 0.0, int(Mode.AUTOMATIC), 0.0)
    loop = TroubledLoop(chain, channel, cause.Ts)
    channel.setpoint = 0.7 if cause.warm else 0.0
    for _ in range(cause.warm):
        loop.step(())
    facts = Facts(cause.Ts, cause.T95_s, LOW, HIGH, 2.0, cause.gains, True, -cause.pv, cause.pv)
    limits = RunLimits(-cause.pv, cause.pv, max_time_s=100.0 * cause.T95_s)
    result = run(fast(facts, FastOptions()), loop, limits=limits, on_event=loop.hear)
    if result.ended is None:
        return False, "proposed"
    right = result.ended.reason in cause.reasons and cause.word in result.ended.detail
    return right, f"`{result.ended.reason.value}`: {result.ended.detail}"


def table(show: Callable[[str], None], seed: int = 2) -> int:
    """Shows the table, and returns the number of wrong rows."""
    wrong = 0
    show("| kind | level | right | what is said |\n| --- | --- | --- | --- |")
    for cause in causes():
        right, text = said(cause, seed)
        wrong += not right
        show(f"| {cause.kind} | {cause.level} | {'yes' if right else 'no'} | {text} |")
    show(f"\nWrong: {wrong}")
    return wrong


if __name__ == "__main__":
    parser_of(__doc__).parse_args()
    table(partial(print, flush=True))

"""What hides in PV or MV: what the procedures say of a sensor or an actuator that alters them, and of none.

    python -m benchmarks.trouble.hidden [--plants N] [--seeds N] [--kinds "PV renewed seldom;..."] [--details]

MV rests at 40 %, PV at 60 degC. A row counts the runs that named what hides, those that proposed gains (right ones: Ms
on the true plant at most 0.3 over what was asked for), those refused with words that blame nothing, and wrong reasons:
words that blame the plant, a valve or a load, which have nothing.
"""

from __future__ import annotations

import argparse
import math
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial

from benchmarks.cases import ASKED
from benchmarks.plants import Plant, plant_of
from benchmarks.trouble.cases import FINE, Made, build
from benchmarks.trouble.chain import Build, Chain, Part, Setting
from benchmarks.trouble.sensors import Held, OnChange, Quantised, Wrong
from benchmarks.trouble.valves import STROKE, RateLimit, Stepped, Switched
from loopwright.controller.channel import Channel, Settings
from loopwright.controller.pid import Parameters
from loopwright.service.execution.guard import RunLimits
from loopwright.service.execution.rehearsal import RehearsedLoop
from loopwright.service.execution.runner import run
from loopwright.tuning.experiments.primitives import Facts
from loopwright.tuning.fast.design.options import DesignOptions
from loopwright.tuning.fast.manual.procedure import MANUAL, by_manual
from loopwright.tuning.fast.pulses.procedure import SETPOINT, setpoint
from loopwright.tuning.fast.relay.procedure import FAST, FastOptions, fast
from loopwright.tuning.gains import Gains
from loopwright.tuning.models import TransferFunction
from loopwright.tuning.plan import Mode
from loopwright.tuning.reasons import Reason

MV, PV = 40.0, 60.0
NOISE = 0.05
DEVIATION = 3.0
AT_REST = 8.0
"""Time before the procedure, Pu."""
METHODS = (FAST, SETPOINT, MANUAL)
BLAME = ("gain", "valve", "actuator", "load", "dead time", "wrong way", "plant that is not linear")
"""Words of a detail that blame the plant, an actuator of another fault or a load."""


@dataclass(frozen=True, slots=True)
class Hidden:
    """What hides, at one level.  named: a word that has to be said of it."""

    kind: str
    level: str
    build: Build
    named: str


def plants() -> tuple[Plant, ...]:
    """None of them was looked at as the rules were made."""
    return (
        plant_of("gain 1.2, lag 22 s, dead time 9 s", TransferFunction((1.2,), (22.0, 1.0), 9.0)),
        plant_of("gain 0.6, lags 30, 12, 4 s, dead time 3 s", _lags(0.6, 3.0, 30.0, 12.0, 4.0)),
        plant_of("gain 2, lags 90, 8 s, dead time 12 s", _lags(2.0, 12.0, 90.0, 8.0)),
        plant_of("gain 1, lag 8 s, dead time 14 s", TransferFunction((1.0,), (8.0, 1.0), 14.0)),
    )


def kinds() -> Iterator[Hidden]:
    """Three levels of each kind, and none."""
    yield Hidden("nothing", "-", build(), "")
    for count in (3, 7, 13):
        made = build(sensor=partial(Held, count=count))
        yield Hidden("PV renewed seldom", f"every {count} samples", made, "PV is renewed every")
    for band in (0.25, 0.5, 0.8):
        made = build(sensor=_alone(OnChange, band))
        yield Hidden("PV sent on change", f"of {band:g} degC", made, "PV is sent only where")
    for step in (0.2, 0.4, 0.8):
        made = build(sensor=_alone(Quantised, step))
        yield Hidden("PV rounded", f"to {step:g} degC", made, "PV is rounded")
    for one_in, by in ((33, 8.0), (80, 20.0), (80, 1.0)):
        made = build(sensor=partial(Wrong, one_in=one_in, by=by))
        yield Hidden("single wrong samples", f"1 in {one_in}, by up to {by:g} degC", made, "wrong sample")
    for stroke in (0.15, 0.3, 0.6):
        yield Hidden(
            "MV no faster", f"{STROKE:g} % take {stroke:g} Pu", _before(partial(RateLimit, stroke=stroke)), "faster"
        )
    for length in (0.06, 0.12, 0.25):
        made = _before(partial(Switched, length=length, rest=MV))
        yield Hidden("MV switched in a window", f"of {length:g} Pu", made, "window")
    for step in (1.5, 3.0, 6.0):
        yield Hidden("MV in steps", f"of {step:g} %", _before(partial(Stepped, step=step, rest=MV)), "in steps")


class _Absolute:
    """The chain around the operating point."""

    def __init__(self, chain: Chain) -> None:
        self._chain = chain

    @property
    def pv(self) -> float:
        return PV + self._chain.pv

    @property
    def noise(self) -> float:
        return self._chain.noise

    def step(self, mv: float) -> float:
        return PV + self._chain.step(mv - MV)


def said(plant: Plant, hidden: Hidden, method: str, seed: int) -> tuple[str, str]:
    """What one run came to, a word of the table, and what was said."""
    chain = Chain(Setting(plant, FINE, NOISE, seed), hidden.build)
    mode = Mode.MANUAL if method == MANUAL else Mode.AUTOMATIC
    gains = Gains(0.25 * plant.Ku, plant.Pu)
    settings = Settings(mv_low=0.0, mv_high=100.0, pv_low=-1e9, pv_high=1e9, reverse=True)
    channel = Channel(plant.Ts, settings, Parameters(gains.Kp, gains.Ti), MV, int(mode), PV)
    loop = RehearsedLoop(_Absolute(chain), channel, plant.Ts)
    for _ in range(round(AT_REST * plant.samples)):
        loop.step(())
    facts = Facts(plant.Ts, 3.0 * plant.Pu, 0.0, 100.0, DEVIATION, gains, True)
    options = DesignOptions(ASKED, propose_anyway=True)
    plan = {
        FAST: lambda: fast(facts, FastOptions(ASKED, propose_anyway=True)),
        SETPOINT: lambda: setpoint(facts, options),
        MANUAL: lambda: by_manual(facts, options, MANUAL),
    }[method]()
    result = run(plan, loop, limits=RunLimits(max_time_s=100.0 * plant.Pu))
    if result.value is not None:
        worst = chain.worst(result.value.gains)
        Ms = worst.Ms if worst.stable else math.inf
        return "proposed" if Ms <= ASKED + 0.3 else "WRONG", f"Ms {Ms:.2f}"
    assert result.ended is not None
    text = f"{result.ended.reason.value}: {result.ended.detail}"
    if hidden.named and hidden.named in text:
        return "named", text
    altered = result.ended.reason in (Reason.PV_ALTERED, Reason.MV_ALTERED)
    return "WRONG" if altered or any(word in result.ended.detail for word in BLAME) else "refused", text


def main(args: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.trouble.hidden", description=__doc__)
    parser.add_argument("--plants", type=int, default=4)
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--kinds", default="", help="separated by ';'; by default all")
    parser.add_argument("--details", action="store_true", help="what each run said")
    given = parser.parse_args(args)
    asked = given.kinds.split(";") if given.kinds else []
    print(
        "| kind | level | named | proposed | refused | wrong | for example |\n"
        "| --- | --- | --- | --- | --- | --- | --- |"
    )
    for hidden in kinds():
        if asked and hidden.kind not in asked:
            continue
        draws = [(p, m, s) for p in plants()[: given.plants] for m in METHODS for s in range(given.seeds)]
        found = [(*said(p, hidden, m, s), p, m) for p, m, s in draws]
        count = Counter(each[0] for each in found)
        example = next((text for what, text, *_ in found if what == "named"), found[0][1]).split("; ")[0]
        print(
            f"| {hidden.kind} | {hidden.level} | {count['named']} | {count['proposed']} | {count['refused']} | "
            f"{count['WRONG']} | {example} |",
            flush=True,
        )
        for what, text, p, m in found:
            if given.details or what == "WRONG":
                print(f"    {what}: {m}, {p.name}: {text}", flush=True)


def _lags(K: float, L: float, *T_s: float) -> TransferFunction:
    den = [1.0]
    for T in T_s:
        den = [a * T + b for a, b in zip([*den, 0.0], [0.0, *den], strict=True)]
    return TransferFunction((K,), tuple(den), L)


def _alone(made: Callable[[float], Part], size: float) -> Made:
    """A part that needs no setting."""
    return lambda setting: made(size)


def _before(made: Made) -> Build:
    return build(before=made)


if __name__ == "__main__":
    main()

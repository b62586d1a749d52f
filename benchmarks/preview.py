"""Whether PV stays within what the preview says, and how near it comes to that, on plants drawn at random.

    python -m benchmarks.preview [--plants N] [--first NUMBER] [--ways WAY ...] [--save FILE]

Each plant is tested once, which leaves a model (by the relay, by pulses, or the plant itself is entered). Then the
preview of every way to move the loop is asked for, and the retune is made, undisturbed, with another noise. Plants from
1000 on are for judging; nothing was set on them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np

from benchmarks.command import parser_of, show
from benchmarks.controllers import T95_PERIODS
from benchmarks.drawn_runs import kept, saved
from benchmarks.operation import PRESENT, present_gains
from benchmarks.plants import Plant
from benchmarks.random_plants import random_plant
from loopwright.controller.channel import Channel, Settings
from loopwright.controller.pid import Parameters
from loopwright.plantsim.plant import LinearPlant
from loopwright.service.execution.excursions import excursions
from loopwright.service.execution.guard import RunLimits
from loopwright.service.execution.procedures import plan
from loopwright.service.execution.rehearsal import RehearsedLoop
from loopwright.service.execution.result import result_of
from loopwright.service.execution.runner import run as run_plan
from loopwright.service.inputs.config import Limits, LoopConfig, PermittedTest
from loopwright.service.inputs.request import RetuneRequest, retune_request, within
from loopwright.service.planning.expected import LoopModel
from loopwright.service.planning.facts import facts_of
from loopwright.service.results import FastResult
from loopwright.tuning.gains import Gains
from loopwright.tuning.models import sign
from loopwright.tuning.plan import Event, Mode, Sample, StageStarted

PLANTS, FIRST = 60, 1000
WAYS: dict[str, dict[str, Any]] = {
    "relay": {"method": "fast", "excitations": ["relay"]},
    "pulses": {"method": "setpoint"},
    "manual": {"method": "fast", "excitations": ["manual"]},
    "five-stage": {"method": "five-stage"},
}
BY = ("relay", "pulses", "entered")
STEP_MV, NOISE, T95 = (2.0, 12.0), (0.002, 0.03), (0.7, 1.5)
"""The permitted step of the set-point as the move of MV that it takes, percent; noise in permitted steps; T95 as it is
configured, over what it is."""
REST_MV = (25.0, 75.0)
LIMIT_STEPS = 1000.0


@dataclass(frozen=True, slots=True)
class Said:
    """One retune.

    model: what the model of the preview comes from. bound, went: how far PV goes, as it was said and in the test, in
    permitted steps; by stage, "" in all. ended: the reason where there was no proposal.
    """

    plant: str
    way: str
    model: str
    bound: dict[str, float]
    went: dict[str, float]
    ended: str = ""


@dataclass(frozen=True, slots=True)
class Drawn:
    """A loop. noise: PV units. mv: percent, at rest."""

    plant: Plant
    config: LoopConfig
    gains: Gains
    noise: float
    mv: float

    def loop(self, mode: Mode, seed: int) -> RehearsedLoop:
        plant, reverse = self.plant, sign(self.plant.model()) > 0.0
        process = LinearPlant(
            plant.num, plant.den, plant.L, plant.Ts, self.mv, noise_std=self.noise, seed=seed, mv_low=0.0, mv_high=100.0
        )
        settings = Settings(pv_low=-1e9, pv_high=1e9, reverse=reverse)
        parameters = Parameters(self.gains.Kp, self.gains.Ti)
        return RehearsedLoop(process, Channel(plant.Ts, settings, parameters, 0.0, mode, self.mv), plant.Ts)


def drawn(number: int) -> Drawn:
    plant, random = random_plant(number), np.random.default_rng([number, 5])
    gains = present_gains(plant, str(random.choice(list(PRESENT))), random)
    model = plant.model()
    unit = abs(1.0 / model.static_gain) if math.isfinite(model.static_gain) else 0.3 * plant.Ku
    step = float(np.exp(random.uniform(*np.log(STEP_MV)))) / unit
    noise = float(np.exp(random.uniform(*np.log(NOISE)))) * step
    t95 = T95_PERIODS * plant.Pu * random.uniform(*T95)
    far = LIMIT_STEPS * step
    config = LoopConfig(
        tag=plant.name.replace(" ", "-"), bus="virtual:memory", controller_node=32, pv_unit="units",
        pv_limits=Limits(low=-far, high=far), t95_s=t95, sp_deviation=step, noise_std_hint=noise,
        test=PermittedTest(excitations=("setpoint", "relay", "manual")),
    )  # fmt: skip
    return Drawn(plant, config, gains, noise, random.uniform(*REST_MV))


class Heard:
    """PV of a run by stage, in permitted steps from rest."""

    def __init__(self, step: float) -> None:
        self.went: dict[str, float] = {"": 0.0}
        self._step, self._stage = step, ""

    def event(self, event: Event) -> None:
        if isinstance(event, StageStarted):
            self._stage = event.stage

    def samples(self, samples: Sequence[Sample]) -> None:
        for each in samples:
            for stage in ("", self._stage):
                self.went[stage] = max(self.went.get(stage, 0.0), abs(each.pv) / self._step)


class StagedLoop(RehearsedLoop):
    """Every sample is heard in the stage that it belongs to."""

    heard: Heard

    def step(self, commands: Any) -> Sample:
        sample = super().step(commands)
        self.heard.samples([sample])
        return sample


def tested(of: Drawn, request: RetuneRequest, loop: RehearsedLoop) -> tuple[Heard, Any]:
    config, state = within(of.config, request), loop.read()
    facts, heard = facts_of(config, state), Heard(config.sp_deviation)
    loop.__class__, loop.heard = StagedLoop, heard  # type: ignore[attr-defined]
    procedure = plan(config, request, facts, mode=state.mode)
    limits = RunLimits(config.pv_limits.low, config.pv_limits.high, 0.0, 100.0, max_time_s=500.0 * config.t95_s)
    return heard, run_plan(procedure, loop, limits=limits, on_event=heard.event)


def known(of: Drawn, by: str) -> LoopModel:
    """The model that an earlier test leaves; the plant itself where that leaves none."""
    if by != "entered":
        request = retune_request(**WAYS[by], propose_anyway=True)
        _, ran = tested(of, request, of.loop(Mode.AUTOMATIC, 1))
        if ran.value is not None:
            found = result_of(ran.value)
            assert isinstance(found, FastResult) and found.model is not None
            rows = found.model.covariance
            covariance = None if rows is None else tuple(tuple(row) for row in rows)
            return LoopModel(found.model.process_model(), by, covariance, of.noise)
    plant = of.plant
    return LoopModel(plant.model(), "entered", None, of.noise)


def measured(number: int, ways: Sequence[str] = tuple(WAYS)) -> list[Said]:
    of = drawn(number)
    model = known(of, BY[number % len(BY)])
    found = []
    for way in ways:
        asked = WAYS[way]
        request = retune_request(**asked, propose_anyway=True)
        loop = of.loop(Mode.MANUAL if way == "manual" else Mode.AUTOMATIC, 2)
        config, state = within(of.config, request), loop.read()
        expected = excursions(config, request, state, model)
        heard, ran = tested(of, request, loop)
        step = config.sp_deviation
        bound = {stage: reach.farthest / step for stage, reach in expected.stages.items()}
        bound[""] = max(bound.values(), default=0.0)
        reason = "" if ran.ended is None else ran.ended.reason.value
        found.append(Said(of.plant.name, way, model.source, bound, heard.went, reason))
    return found


def run(
    plants: int = PLANTS, first: int = FIRST, ways: Sequence[str] = tuple(WAYS), file: Path | None = None
) -> dict[str, Any]:
    """The figures, in all and of each way to move the loop."""
    found = saved(Said, file)
    done = {each.plant for each in found}
    for number in range(first, first + plants):
        if random_plant(number).name not in done:
            found += [kept(each, file) for each in measured(number, ways)]
    runs = [each for each in found if each.bound[""] > 0.0 and each.went[""] > 0.0]
    by_way = {way: _figures([each for each in runs if each.way == way]) for way in ways}
    return {"plants": plants, **_figures(runs), "ways": by_way}


def _figures(runs: Sequence[Said]) -> dict[str, Any]:
    times = sorted(each.bound[""] / each.went[""] for each in runs)
    return {
        "runs": len(times),
        "beyond": sum(each < 1.0 for each in times),
        "most_beyond": max(0.0, 1.0 / times[0] - 1.0) if times else None,
        "times_median": median(times) if times else None,
        "times_p90": times[int(0.9 * len(times))] if times else None,
    }


if __name__ == "__main__":
    parser = parser_of(__doc__)
    parser.add_argument("--plants", type=int, default=PLANTS, help="how many (default: %(default)s)")
    parser.add_argument("--first", type=int, default=FIRST, help="the number of the first (default: %(default)s)")
    parser.add_argument("--ways", nargs="+", choices=WAYS, default=list(WAYS), help="(default: all)")
    parser.add_argument("--save", type=Path, help="a file of runs to go on from, and to add to")
    given = parser.parse_args()
    show(partial(run, given.plants, given.first, given.ways, given.save))

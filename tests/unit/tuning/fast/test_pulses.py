"""The pulses on sluggish loops, rehearsed with our own simulator and controller, judged on the true plant."""

from __future__ import annotations

from dataclasses import dataclass

import pytest

from loopwright.controller.channel import Channel, Settings
from loopwright.controller.pid import Parameters
from loopwright.plantsim.plant import LinearPlant
from loopwright.service.execution.guard import RunLimits
from loopwright.service.execution.rehearsal import RehearsedLoop
from loopwright.service.execution.runner import RunResult, run
from loopwright.tuning.analysis.margins import margins, ultimate_point
from loopwright.tuning.experiments.primitives import Directions, Facts
from loopwright.tuning.fast.design.options import DesignOptions
from loopwright.tuning.fast.evaluation.proposal import FastProposal, PulseFigures
from loopwright.tuning.fast.pulses.procedure import setpoint
from loopwright.tuning.gains import Gains
from loopwright.tuning.models import TransferFunction
from loopwright.tuning.plan import Event, Mode, Note, Sample, StageDone
from loopwright.tuning.reasons import Reason

STEP = 1.0
SHALL_TELL = "the step under the new gains shall tell it"


@dataclass(frozen=True, slots=True, eq=False)
class PulsedLoopTest:
    """A test as it ended: its result, its notes, the figures of its pulses, its samples, its time in Pu."""

    result: RunResult[FastProposal]
    notes: list[str]
    pulses: PulseFigures | None
    samples: list[Sample]
    passed: float


def rehearsed(
    plant: TransferFunction,
    part_of_Ku: float,
    noise: float,
    verify: bool = True,
    one_sided: bool = False,
    derivative: bool = False,
) -> PulsedLoopTest:
    """A test on a loop of which Kp is this part of Ku, and Ti is Pu; noise in permitted steps."""
    Ku, Pu = ultimate_point(plant)
    Ts = Pu / 80.0
    gains = Gains(part_of_Ku * Ku, Pu)
    settings = Settings(mv_low=-1e6, mv_high=1e6, pv_low=-1e9, pv_high=1e9)
    process = LinearPlant(plant.num, plant.den, plant.L, Ts, noise_std=noise * STEP, seed=1)
    channel = Channel(Ts, settings, Parameters(gains.Kp, gains.Ti), 0.0, int(Mode.AUTOMATIC), 0.0)
    loop = RehearsedLoop(process, channel, Ts)
    directions = Directions.UP if one_sided else Directions.BOTH
    facts = Facts(Ts, 3.0 * Pu, -1e6, 1e6, STEP, gains, True, directions=directions)
    notes: list[str] = []
    figures: list[PulseFigures] = []
    taken: list[Sample] = []

    def hear(event: Event) -> None:
        if isinstance(event, Note):
            notes.append(event.text)
        elif isinstance(event, StageDone) and isinstance(event.result, PulseFigures):
            figures.append(event.result)

    plan = setpoint(facts, DesignOptions(derivative=derivative, verify=verify, propose_anyway=True))
    result = run(plan, loop, limits=RunLimits(max_time_s=100.0 * Pu), on_event=hear, on_samples=taken.extend)
    passed = sum(value for stage, value in result.plant_time_s.items() if stage in ("pulses", "verify")) / Pu
    return PulsedLoopTest(result, notes, figures[0] if figures else None, taken, passed)


TWO_LAGS = TransferFunction((1.0,), (1.0, 2.0, 1.0), 0.2)
THREE_LAGS = TransferFunction((1.0,), (1.0, 3.0, 3.0, 1.0), 0.07)
LAG = TransferFunction((1.0,), (10.0, 1.0), 0.5)


def true_Ms(plant: TransferFunction, gains: Gains) -> float:
    """Ms on the plant with the sampled controller's half sample."""
    _, Pu = ultimate_point(plant)
    return margins(TransferFunction(plant.num, plant.den, plant.L + Pu / 160.0), gains).Ms


@pytest.mark.parametrize("plant", [TWO_LAGS, THREE_LAGS], ids=["two lags", "three lags"])
def test_further_pulses_follow_where_Ms_is_not_known(plant: TransferFunction) -> None:
    test = rehearsed(plant, part_of_Ku=0.03, noise=0.01)
    assert test.result.value is not None and test.pulses is not None
    assert test.pulses.turns > 2
    assert max(abs(each.sp) for each in test.samples) <= STEP
    assert {each.mode for each in test.samples} == {Mode.AUTOMATIC}
    assert true_Ms(plant, test.result.value.gains) == pytest.approx(1.6, abs=0.05)


@pytest.mark.parametrize("plant", [THREE_LAGS, LAG], ids=["three lags", "lag"])
def test_the_step_under_the_new_gains_tells_what_sluggish_gains_do_not(plant: TransferFunction) -> None:
    """With an eightieth of Ku, pulses would have to go on for more than three ultimate periods: the note says for how
    long, and how well Ms is known."""
    test = rehearsed(plant, part_of_Ku=0.0125, noise=0.01)
    assert test.result.value is not None
    assert [each for each in test.notes if SHALL_TELL in each and "known to +0." in each]
    assert test.passed < 12.0
    assert true_Ms(plant, test.result.value.gains) == pytest.approx(1.6, abs=0.05)


def test_without_that_step_the_pulses_go_on() -> None:
    tried = rehearsed(THREE_LAGS, part_of_Ku=0.0125, noise=0.01)
    untried = rehearsed(THREE_LAGS, part_of_Ku=0.0125, noise=0.01, verify=False)
    assert tried.pulses is not None and untried.pulses is not None
    assert untried.pulses.samples > tried.pulses.samples and untried.pulses.turns > tried.pulses.turns
    assert not [each for each in untried.notes if SHALL_TELL in each]


def test_further_pulses_to_one_side_go_back_to_rest_at_most() -> None:
    test = rehearsed(TWO_LAGS, part_of_Ku=0.03, noise=0.01, one_sided=True)
    assert test.pulses is not None and test.pulses.turns > 2
    pulses = [each.sp for each in test.samples]
    assert min(pulses) >= 0.0 and max(pulses) <= STEP


def test_a_PID_that_sluggish_gains_do_not_show_is_refused_with_the_PI_that_they_do() -> None:
    refused = rehearsed(THREE_LAGS, part_of_Ku=0.02, noise=0.02, derivative=True)
    assert refused.result.ended is not None and refused.result.ended.reason in (Reason.UNCERTAIN, Reason.AMBIGUOUS)
    assert "Ms of a PI is known to +0." in refused.result.ended.detail
    assert rehearsed(THREE_LAGS, part_of_Ku=0.02, noise=0.02).result.value is not None

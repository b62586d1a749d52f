"""How far PV will go: told before a test, by the model, and never less than the test itself then does."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import pytest

from loopwright.controller.channel import Channel, Settings
from loopwright.controller.pid import Parameters
from loopwright.plantsim.plant import LinearPlant
from loopwright.service.execution.excursions import excursions, near_limits
from loopwright.service.execution.procedures import Hooks, Outcome, tune
from loopwright.service.execution.rehearsal import RehearsedLoop
from loopwright.service.inputs.config import LoopConfig
from loopwright.service.inputs.request import retune_request, within
from loopwright.service.jobs.loop_model import model_of_samples
from loopwright.service.planning.expected import NOTHING_EXPECTED, LoopModel
from loopwright.service.planning.obstacles import Now
from loopwright.service.planning.preview import Preview, preview
from loopwright.service.states.loop_state import LoopState
from loopwright.tuning.models import FOPDT
from loopwright.tuning.plan import Event, Mode, Note, Sample
from loopwright.tuning.reasons import Failed, Reason, Refused
from tests.unit.service.fakes import loop_entry

K, T, L, TS, NOISE = 0.8, 30.0, 6.0, 0.5, 0.05
SP, MV = 63.5, 40.0
MODEL = LoopModel(FOPDT(K, T, L), "the model entered", None, NOISE)
WIDE, NARROW = (0.0, 100.0), (62.5, 64.5)


def config(limits: tuple[float, float] = WIDE, sp_deviation: float = 0.9, **test: Any) -> LoopConfig:
    low, high = limits
    entry = loop_entry(pv_limits={"low": low, "high": high}, sp_deviation=sp_deviation, t95_s=100.0, test=test)
    return LoopConfig.model_validate({**entry, "noise_std_hint": NOISE})


def loop(mode: Mode = Mode.AUTOMATIC, seed: int = 1, gain: float = K, lag_s: float = T) -> RehearsedLoop:
    plant = LinearPlant([gain], [lag_s, 1.0], L, TS, MV, SP, noise_std=NOISE, seed=seed, mv_low=0.0, mv_high=100.0)
    channel = Channel(TS, Settings(), Parameters(0.8 / gain, lag_s), SP, mode, MV)
    return RehearsedLoop(plant, channel, TS)


class Heard:
    def __init__(self) -> None:
        self.samples: list[Sample] = []
        self.notes: list[str] = []

    def event(self, event: Event) -> None:
        if isinstance(event, Note):
            self.notes.append(event.text)

    @property
    def pv(self) -> list[float]:
        return [each.pv for each in self.samples]


def retuned(of: RehearsedLoop, at: LoopConfig, model: LoopModel | None, **options: Any) -> tuple[Outcome, Heard]:
    request, heard = retune_request(propose_anyway=True, **options), Heard()
    hooks = Hooks(heard.event, heard.samples.extend, lambda: None, model=model)
    return tune(within(at, request), request, of, of.read(), hooks), heard


def told(at: LoopConfig, state: LoopState, model: LoopModel | None = MODEL, **options: Any) -> Preview:
    request = retune_request(**options)
    expected = NOTHING_EXPECTED if model is None else excursions(within(at, request), request, state, model)
    return preview(at, request, Now(state), None, None, expected)


def test_the_first_half_wave_goes_on_from_rest_for_a_dead_time_after_the_switch() -> None:
    """In closed form: the higher side acts whole from rest until PV has passed the hysteresis, and a dead time more."""
    found = excursions(config(), retune_request(), loop().read(), replace(MODEL, noise=0.0))
    high = 0.5 * 60.0  # half of the room above 40 %
    passed_s = -T * math.log(1.0 - 1e-3 * 0.9 / (K * high))
    least, most = (K * high * (1.0 - math.exp(-(passed_s + L + samples * TS) / T)) for samples in (0.0, 3.0))
    assert least <= found.stages["relay"].likely_up <= most
    mean = 0.75 * high  # what the describing function has in place of the higher side
    assert found.stages["relay"].likely_up > 1.2 * K * mean * (1.0 - math.exp(-L / T))


@pytest.mark.parametrize(
    ("options", "mode"),
    [
        ({"excitations": ["relay"]}, Mode.AUTOMATIC),
        ({"excitations": ["manual"]}, Mode.MANUAL),
        ({"method": "setpoint"}, Mode.AUTOMATIC),
        ({"method": "five-stage"}, Mode.AUTOMATIC),
    ],
)
def test_PV_stays_within_what_was_said(options: dict[str, Any], mode: Mode) -> None:
    at = config(excitations=["setpoint", "relay", "manual"])
    said = told(at, loop(mode).read(), **options)
    _, heard = retuned(loop(mode, seed=2), at, None, **options)
    assert said.pv_low is not None and said.pv_high is not None and said.largest_pv_move is not None
    assert said.pv_low <= min(heard.pv) and max(heard.pv) <= said.pv_high
    assert said.largest_pv_move < 2.0 * max(abs(each - SP) for each in heard.pv)
    assert any("PV is expected between" in line and "by the model entered" in line for line in said.summary)


def test_a_model_that_is_less_certain_lets_PV_go_further() -> None:
    """A gain off by two standard deviations of 10 % moves PV by 20 % more; so small a hysteresis adds nothing."""
    variances = ((K / T) ** 2 * 0.01, 1e-12, 1e-12)  # of num, den and dead time, with den beginning with 1
    covariance = tuple(tuple(value if k == n else 0.0 for k in range(3)) for n, value in enumerate(variances))
    request, state = retune_request(excitations=["relay"]), loop().read()
    sure = excursions(config(), request, state, replace(MODEL, noise=0.0, covariance=((0.0,) * 3,) * 3))
    open_ = excursions(config(), request, state, replace(MODEL, noise=0.0, covariance=covariance))
    assert open_.stages["relay"].up == pytest.approx(1.2 * sure.stages["relay"].up, rel=0.02)
    assert open_.stages["relay"].likely_up == sure.stages["relay"].likely_up


def test_without_a_model_it_is_said_and_MV_is_bounded() -> None:
    found = told(config(), loop().read(), None)
    assert (found.pv_low, found.pv_high, found.largest_pv_move, found.pv_known_by) == (None, None, None, None)
    assert (found.mv_low_pct, found.mv_high_pct) == (0.0, 100.0), "the step under the new gains may take it so far"
    goes = next(line for line in found.summary if line.startswith("MV moves between"))
    assert "MV moves between 0 and 100 % (present 40 %)." in goes and "How far PV goes is not known beforehand" in goes


def test_a_model_of_the_other_action_tells_nothing() -> None:
    wrong = LoopModel(FOPDT(-K, T, L), "the model entered", None, NOISE)
    assert excursions(config(), retune_request(), loop().read(), wrong) == NOTHING_EXPECTED


@pytest.mark.parametrize("gain, lag_s", [(K, T), (2.0, 60.0)])
def test_limits_that_the_relay_broke_once_are_kept_the_second_time(gain: float, lag_s: float) -> None:
    """The record of the first test tells the dead time and the slope, and the next relay begins small enough."""
    first, heard = retuned(loop(gain=gain, lag_s=lag_s), config(NARROW), None)
    assert isinstance(first.ended, Failed) and first.ended.reason is Reason.PV_LIMIT
    begun = next(k for k, each in enumerate(heard.samples) if each.mode == Mode.EXPERIMENT)
    slope = model_of_samples(heard.samples[:begun], heard.samples[begun:], reverse=True)
    assert slope is not None
    rough = LoopModel(slope, "the record of job 1", None, NOISE, rough=True)
    second, heard = retuned(loop(gain=gain, lag_s=lag_s, seed=2), config(NARROW), rough)
    assert second.ended is None and second.result is not None
    assert NARROW[0] < min(heard.pv) and max(heard.pv) < NARROW[1]
    assert any("so that PV keeps its limits, by the record of job 1" in note for note in heard.notes)


def test_with_a_model_the_first_relay_keeps_them_and_the_preview_says_its_size() -> None:
    state, limits = loop().read(), (62.3, 64.7)
    said = told(config(limits), state)
    assert said.would_start and said.first_mv_move_pct is not None and said.first_mv_move_pct < 6.0
    assert said.pv_low is not None and said.pv_high is not None
    assert limits[0] <= said.pv_low and said.pv_high <= limits[1]
    outcome, heard = retuned(loop(seed=3), config(limits), MODEL)
    assert outcome.result is not None and said.pv_low <= min(heard.pv) and max(heard.pv) <= said.pv_high
    relay = [each.mv for each in heard.samples if each.mode == Mode.EXPERIMENT]
    assert relay[0] == pytest.approx(MV + said.first_mv_move_pct, abs=0.1)


@pytest.mark.parametrize(
    ("options", "remedy"),
    [
        ({"amplitude_pct": 20.0}, "amplitude_pct of at most 5."),
        ({"method": "five-stage", "baseline": False}, "ask for method fast"),
    ],
)
def test_what_would_break_them_all_the_same_is_refused_before_anything_moves(
    options: dict[str, Any], remedy: str
) -> None:
    state = loop().read()
    (obstacle,) = told(config(NARROW), state, **options).obstacles
    assert obstacle.reason == "bad_limits" and remedy in obstacle.detail and "62.5 .. 64.5" in obstacle.detail
    with pytest.raises(Refused, match=remedy) as refused:
        retuned(loop(), config(NARROW), MODEL, **options)
    assert refused.value.reason is Reason.BAD_LIMITS


def test_limits_too_narrow_for_the_noise_are_refused_with_those_that_would_do() -> None:
    noisy = replace(MODEL, noise=0.09)
    (obstacle,) = told(config(NARROW), loop().read(), noisy).obstacles
    assert "as small as the noise of PV permits: ask for PV limits of" in obstacle.detail


def test_far_from_the_limits_nothing_is_asked() -> None:
    assert near_limits(config(), retune_request(), loop().read(), MODEL) == NOTHING_EXPECTED

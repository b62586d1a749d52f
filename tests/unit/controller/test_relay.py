"""The relay: what switches it, its two amplitudes, its mean, and what it leaves behind."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from loopwright.controller.channel import Channel, Mode, Parameters, RelaySettings, RelayState, Settings
from loopwright.controller.relay import MAX_AVERAGED, Relay
from loopwright.plantsim.plant import LinearPlant

PI = Parameters(1.0, Ti=5.0)
PLAIN = RelaySettings(10.0, 0.0, 50.0, 1000, 0.0, 100.0)


def channel(reverse: bool = True, **limits: float) -> Channel:
    return Channel(0.1, Settings(reverse=reverse, **limits), PI, 50.0, Mode.AUTOMATIC, 45.0)


def relay_on(c: Channel, pv: float, settings: RelaySettings = PLAIN) -> Channel:
    c.step(pv)
    c.start_relay(settings)
    return c


@pytest.mark.parametrize("reverse", [True, False], ids=["reverse", "direct"])
def test_relay_switches_on_the_sign_of_the_error(reverse: bool) -> None:
    c = relay_on(channel(reverse), 50.0)
    assert c.mode is Mode.EXPERIMENT and c.relay_state is RelayState.RUNNING
    below, above = (60.0, 40.0) if reverse else (40.0, 60.0)
    assert [c.step(pv) for pv in (49.9, 50.1, 49.9)] == [below, above, below]
    assert c.step(50.0) == 60.0


def test_relay_keeps_its_side_within_the_hysteresis() -> None:
    c = relay_on(channel(), 50.0, replace(PLAIN, hysteresis=1.0))
    assert [c.step(pv) for pv in (49.5, 50.5, 51.0, 50.5, 49.5, 49.0, 50.9)] == [60, 60, 40, 40, 40, 60, 60]


def test_relay_keeps_the_limits() -> None:
    c = relay_on(channel(mv_high=55.0, mv_low=47.0), 50.0)
    assert [c.step(40.0), c.step(60.0)] == [55.0, 47.0]


def test_a_bad_measurement_holds_the_relay_on_its_side() -> None:
    c = relay_on(channel(), 50.0)
    assert [c.step(pv) for pv in (51.0, math.nan, 1e30, 49.0)] == [40.0, 40.0, 40.0, 60.0]


def test_a_relay_started_before_any_measurement_begins_high() -> None:
    c = channel()
    c.start_relay(PLAIN)
    assert c.step(math.nan) == 45.0 and c.step(50.0) == 60.0


@pytest.mark.parametrize("mode", [Mode.AUTOMATIC, Mode.MANUAL], ids=str)
def test_a_relay_ends_at_its_working_output_not_at_its_side(mode: Mode) -> None:
    c = relay_on(channel(), 50.0, replace(PLAIN, working_output=52.0))
    assert c.step(51.0) == 42.0
    c.command_mode(mode)
    assert (c.step(51.0), c.relay_state) == (pytest.approx(52.0), RelayState.DONE)


def test_a_relay_ends_off_at_the_safe_output() -> None:
    c = relay_on(channel(safe_output=7.0, rate_limit_per_s=1.0), 50.0)
    c.command_mode(Mode.OFF)
    assert c.step(51.0) == 7.0


def test_a_relay_leaves_its_side_no_faster_than_the_rate_limit_allows() -> None:
    c = relay_on(channel(rate_limit_per_s=50.0), 50.0)
    c.step(51.0)
    side = c.step(51.0)
    assert side == pytest.approx(40.0)
    c.command_mode(Mode.MANUAL)
    assert [c.step(51.0), c.step(51.0), c.step(51.0)] == pytest.approx([45.0, 50.0, 50.0])


def test_relay_swings_a_plant_at_its_ultimate_period() -> None:
    plant = LinearPlant([1], [1, 5, 10, 10, 5, 1], 0.0, 0.02, mv_nominal=50, pv_nominal=50)
    c = Channel(0.02, Settings(), PI, 50.0, Mode.AUTOMATIC, 50.0)
    relay_on(c, plant.pv, replace(PLAIN, max_samples=10**6))
    y = np.array([plant.step(c.step(plant.pv)) for _ in range(6000)]) - 50
    ups = np.nonzero((y[:-1] < 0) & (y[1:] >= 0))[0]
    assert np.diff(ups)[-5:].mean() * 0.02 == pytest.approx(8.648, rel=0.02)
    assert 4 * 10 / (math.pi * np.ptp(y[-1000:]) / 2) == pytest.approx(2.885, rel=0.03)


BIASED = replace(PLAIN, hysteresis=0.5, amplitude_low=5.0)


def test_a_biased_relay_has_two_amplitudes_and_begins_high_within_its_hysteresis() -> None:
    c = relay_on(channel(), 50.4, BIASED)
    outputs = [c.step(pv) for pv in (50.4, 50.6, 50.0, 49.6, 49.4, 50.0)]
    assert outputs == [60.0, 45.0, 45.0, 45.0, 60.0, 60.0]


def test_a_relay_that_averages_is_not_switched_by_one_sample() -> None:
    c = relay_on(channel(), 50.0, replace(PLAIN, hysteresis=0.5, average=3))
    # means of the last three: 0, 0.4, 0.4, 0.6
    assert [c.step(pv) for pv in (50.0, 51.2, 50.0, 50.6)] == [60.0, 60.0, 60.0, 40.0]


def test_a_running_relay_takes_new_amplitudes_on_the_side_it_is_on() -> None:
    c = relay_on(channel(), 50.0, replace(PLAIN, hysteresis=0.5))
    assert [c.step(pv) for pv in (51.0, 50.0)] == [40.0, 40.0]
    c.start_relay(replace(PLAIN, amplitude=20.0, hysteresis=0.5, amplitude_low=15.0))
    assert [c.step(pv) for pv in (50.0, 49.0)] == [35.0, 70.0]


@pytest.mark.parametrize(
    "change",
    [
        {"amplitude": 0.0},
        {"hysteresis": -1.0},
        {"max_samples": 0},
        {"pv_low": 60.0, "pv_high": 40.0},
        {"working_output": math.nan},
        {"amplitude_low": -1.0},
        {"amplitude_low": math.nan},
        {"average": 0},
        {"average": MAX_AVERAGED + 1},
    ],
    ids=str,
)
def test_a_relay_refuses_what_has_no_meaning(change: dict[str, float]) -> None:
    with pytest.raises(ValueError):
        replace(PLAIN, **change)  # type: ignore[arg-type]


@given(st.lists(st.floats(-100.0, 100.0), min_size=1, max_size=60), st.floats(0.0, 5.0), st.integers(1, 10))
def test_a_relay_knows_two_outputs_and_switches_beyond_its_hysteresis_only(
    errors: Sequence[float], hysteresis: float, average: int
) -> None:
    relay = Relay(replace(BIASED, hysteresis=hysteresis, average=average), 0.0)
    before, window = 60.0, [0.0]
    for error in errors:
        output = relay.output(error)
        window = [*window, error][-average:]
        assert output in (60.0, 45.0)
        if output != before:
            mean = sum(window) / len(window)
            assert mean >= hysteresis if output == 60.0 else mean <= -hysteresis
        before = output

"""A plant of one's own is retuned as a model of it is, by the same controller and runner; a bad one is named."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import typer

from loopwright import rehearsal, tuning
from loopwright.plantsim.plant import LinearPlant
from loopwright.service.cli import own_plants


class Tank:
    """An outlet by Torricelli's law, a pump in percent, and 4 s of dead time; Euler's steps of 1 s."""

    sample_time_s, t95_s = 1.0, 130.0

    def __init__(self) -> None:
        self.level, self.arriving = 1.0, [50.0] * 5

    def step(self, mv: float) -> float:
        self.arriving = [*self.arriving[1:], mv]
        self.level += 0.05 * (self.arriving[0] / 50.0 - self.level**0.5)
        return self.level


LINEARISED = tuning.FOPDT(K=0.04, T=-1.0 / math.log(1.0 - 0.025), L=4.0)
"""The tank where it rests: d(level) = 0.05 (d(mv)/50 - d(level)/2) a step."""


def test_a_tank_is_retuned_for_the_robustness_asked_and_its_record_is_its_own() -> None:
    present = rehearsal.Gains(Kp=7.0, Ti=40.0)
    found = rehearsal.retune(Tank(), Ms=1.4, pv=1.0, sp_deviation=0.2, gains=present, reverse_acting=True)
    assert found.ended is None and found.gains and found.record and found.model
    half_a_sample_later = tuning.FOPDT(LINEARISED.K, LINEARISED.T, LINEARISED.L + 0.5)
    assert tuning.margins(half_a_sample_later, found).Ms == pytest.approx(1.4, abs=0.03)
    w = np.array([0.02, 0.1])
    assert np.allclose(tuning.as_model(found).frequency_response(w), LINEARISED.frequency_response(w), rtol=0.05)
    t, sp, pv, mv = found.record.t, found.record.sp, found.record.pv, found.record.mv
    again = Tank()
    assert pv[0] == 1.0 and np.array_equal(pv[1:], [again.step(each) for each in mv[:-1]])
    assert len(t) == len(sp) == len(found.record.stages) and 0.0 < np.ptp(sp) <= 0.2 and np.ptp(t) == len(t) - 1.0
    assert repr(found).startswith(f"fast on Tank: {found.gains}; Ms 1.4; ") and "<svg" in found._repr_html_()


class Heater:
    """A linear plant around an operating point."""

    def __init__(self) -> None:
        self.linear = LinearPlant([2.0], [5.0, 1.0], 1.0, 0.1)

    def step(self, mv: float) -> Any:
        return np.array([60.0 + self.linear.step(mv - 40.0)])  # as a state space gives it


@pytest.mark.parametrize("method", ["fast", "setpoint", "five-stage"])
def test_it_is_retuned_as_the_model_of_it_is(method: str) -> None:
    gains = {"Kp": 0.15, "Ti": 5.0}
    both = {"sample_time_s": 0.1, "t95_s": 16.0, "sp_deviation": 2.0}
    model = {"K": 2.0, "T_s": 5.0, "L_s": 1.0, "mv_limits": [-40.0, 40.0], "gains": gains, **both}
    expected = rehearsal.rehearse(model, method)
    found = rehearsal.retune(
        Heater(), method, mv=40.0, pv=60.0, mv_limits=(0.0, 80.0), gains=rehearsal.Gains(**gains), reverse_acting=True,
        **both,
    )  # fmt: skip
    assert found.gains and expected.gains
    assert [found.gains.Kp, found.gains.Ti] == pytest.approx([expected.gains.Kp, expected.gains.Ti], rel=1e-3)


def test_what_is_left_out_is_chosen_by_the_gain_that_a_move_of_mv_shows() -> None:
    found = rehearsal.retune(Heater(), sample_time_s=0.1, t95_s=16.0, mv=40.0)
    own = found.as_json()["input"]
    assert isinstance(own, dict) and found.gains
    assert (own["pv"], own["sp_deviation"]) == pytest.approx((60.0, 0.2 * 40.0 * 2.0), rel=1e-3)
    assert own["gains"]["Kp"] == pytest.approx(0.15, rel=1e-3) and own["reverse_acting"] is True


class Bad:
    sample_time_s, t95_s = 1.0, 60.0

    def __init__(self, good: int, then: object) -> None:
        self.good, self.then, self.pv_now = good, then, 0.0

    def step(self, mv: float) -> Any:
        self.good, self.pv_now = self.good - 1, self.pv_now + 0.05 * (mv - 50.0 - self.pv_now)
        if self.good >= 0:
            return self.pv_now
        if isinstance(self.then, Exception):
            raise self.then
        return self.then


@pytest.mark.parametrize("good", [10, 850], ids=["at rest", "in the test"])
def test_a_plant_that_breaks_is_named(good: int) -> None:
    for then, error, said in (
        ("warm", TypeError, r"Bad.step\(50\) returned 'warm': PV must be a number"),
        (None, TypeError, r"returned None: PV must be a number"),
        (OSError("the pump broke"), OSError, "the pump broke"),
    ):
        with pytest.raises(error, match=said) as caught:
            rehearsal.retune(Bad(good, then))
        assert caught.value.__notes__ == ["in Bad.step(50), of a rehearsal"]
    found = rehearsal.retune(Bad(good, math.nan))
    assert found.gains is None and "failed, bad_sample: " in repr(found) and " is nan" in repr(found)


@pytest.mark.parametrize(
    ("plant", "arguments", "error", "said"),
    [
        (Tank, {}, TypeError, r"Tank is a class: give an object of it, Tank\("),
        (3.0, {}, TypeError, r"float is no plant: give an object with step\(mv\)"),
        (tuning.FOPDT(1.0, 2.0, 3.0), {}, TypeError, "a model is rehearsed by rehearse"),
        (Heater(), {"t95_s": 1.0}, rehearsal.Refused, r"sample_time_s is missing: the time that one step\(mv\)"),
        (Tank(), {"mv": 100.0}, rehearsal.Refused, "mv must be between its limits 0 and 100, not 100"),
        (Tank(), {"gains": 3.0}, rehearsal.Refused, "gains: a mapping of names to values is expected, not 3"),
        (Tank(), {"ms": 1.4}, rehearsal.Refused, "fast has no option 'ms'; did you mean Ms"),
        (Tank(), {"method": "magic"}, rehearsal.Refused, "method must be one of fast, setpoint, five-stage, zn-ult"),
    ],
)
def test_a_wrong_argument_is_named_with_what_to_give(plant: Any, arguments: Any, error: Any, said: str) -> None:
    with pytest.raises(error, match=said):
        rehearsal.retune(plant, **arguments)


def test_a_plant_that_does_not_answer_is_refused_with_the_reason() -> None:
    found = rehearsal.retune(Bad(0, 5.0))
    assert found.ended is not None and found.ended.reason == "no_response" and "stayed at 5" in found.ended.detail


FILE = """
class Tank:
    def step(self, mv):
        return mv

def made():
    return Tank()

def broken():
    return 1 / 0

tank, number = Tank(), 3
"""


def test_a_plant_in_a_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "a_plant_of_mine.py"
    file.write_text(FILE)
    for name in ("Tank", "made", "tank"):
        assert own_plants.plant_of(f"{file}:{name}").step(3.0) == 3.0
    assert own_plants.plant_of("K=2,T=10,L=3") is None and own_plants.plant_of("plant.json") is None
    for name, said in (
        ("", f"name the plant, {file}:NAME; it has Tank, tank"),
        (":none", "it has Tank, tank"),
        (":number", "is no plant: give an object with step(mv)"),
        (":broken", "made no plant: ZeroDivisionError: division by zero (line 10)"),
    ):
        with pytest.raises(typer.Exit):
            own_plants.plant_of(f"{file}{name}")
        assert said in capsys.readouterr().err
    file.write_text("x = (")
    with pytest.raises(typer.Exit):
        own_plants.plant_of(f"{file}:x")
    assert "cannot be used: SyntaxError: '(' was never closed (line 1)" in capsys.readouterr().err

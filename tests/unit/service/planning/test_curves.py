"""Page, report and alternatives show the same curves, and these are those of the controller on a simulated plant."""

from __future__ import annotations

import json
import re
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from loopwright.controller.channel import Channel, Settings
from loopwright.controller.pid import Parameters
from loopwright.plantsim.plant import LinearPlant
from loopwright.service.api.report.drawing import Picture
from loopwright.service.api.report.plots import step_pictures
from loopwright.service.jobs import design_curve as curve_of_designs
from loopwright.service.jobs.alternatives import redesigned
from loopwright.service.planning.curves import LOAD_PCT, LoopCurves, horizons, loop_curves
from loopwright.service.results import FastResult, GainsView, TransferModelView
from loopwright.service.states.job_state import JobState
from loopwright.tuning.fast.design.design import DesignSpec
from loopwright.tuning.fast.known_plant.design_trial import designed_on
from loopwright.tuning.gains import Gains
from loopwright.tuning.models import TransferFunction
from loopwright.tuning.plan import Mode

MODELS = {
    "first order": ((2.0,), (6.0, 1.0), 1.5, 0.1),
    "three lags": ((0.8,), (8.0, 12.0, 6.0, 1.0), 0.5, 0.1),
    "dead time": ((0.7,), (1.0, 1.0), 8.0, 0.1),
    "inverse response": ((-1.0, 1.0), (4.0, 4.0, 1.0), 0.5, 0.05),
    "negative gain": ((-0.5,), (5.0, 1.0), 1.0, 0.1),
    "slow heater": ((3.0,), (2400.0, 1.0), 90.0, 5.0),
    "level": ((0.0037,), (1.0, 7.09e-5), 4.0, 0.5),
    "integrates": ((0.05,), (1.0, 0.0), 2.0, 0.1),
    "integrates with a lag": ((0.02,), (5.0, 1.0, 0.0), 3.0, 0.2),
    "level that falls": ((-0.01,), (1.0, 2e-5), 1.0, 0.1),
}
"""num, den, dead time and sample time, s; the fit of a level loop has a pole near zero, not at it."""


def row_of(model: TransferFunction, Ts: float) -> tuple[Any, Gains]:
    """A finished job of fast with this model, and its gains."""
    new = designed_on(model, DesignSpec(1.6), Ts).gains
    before = GainsView(Kp=0.5 * new.Kp, Ti=1.3 * new.Ti, Td=0.0, Tf=0.0, b=1.0, c=0.0).model_dump()
    state = {
        "mode": "automatic", "sp": 50.0, "pv": 50.0, "mv": 40.0, "gains": before, "on_trial": False, "mv_low": 0.0,
        "mv_high": 100.0, "sample_time_s": Ts, "reverse_acting": True, "manual_output": 40.0,
    }  # fmt: skip
    view = TransferModelView(structure="sopdt", num=list(model.num), den=list(model.den), dead_time_s=model.L)
    result = FastResult.model_construct(model=view, new_gains=GainsView.of(new))
    return SimpleNamespace(
        id="j", loop="L", request={"method": "fast", "Ms": 1.6}, state=JobState.PROPOSED, reason=None, result=result,
        previous_gains=before, found=state,
    ), new  # fmt: skip


@pytest.mark.parametrize("name", MODELS)
def test_page_report_and_alternatives_show_the_same_curve(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(curve_of_designs, "GRID", (1.4, 1.6))
    num, den, L, Ts = MODELS[name]
    row, _ = row_of(TransferFunction(num, den, L), Ts)
    curve = curve_of_designs.design_curve(row, TransferFunction(num, den, L), None)
    page = json.loads(curve.model_dump_json())
    assert page["previous_curves"] and page["new_curves"]
    for of in (1.4, 1.6):
        other = redesigned(row, [], None, DesignSpec(of))["methods"][0]["curves"]
        mine = next(each["curves"] for each in page["designs"] if each["Ms_asked"] == of)
        if of == 1.6:  # the gains of the job
            assert_same(mine, page["new_curves"])
        assert_same(other, mine)
    shown = step_pictures(curve.previous_curves, curve.new_curves, 2.0, 1.6)
    assert shown is not None
    for picture, which, size in ((shown.setpoint, "setpoint", 2.0), (shown.load, "load", LOAD_PCT)):
        for look, curves in (("old", page["previous_curves"]), ("new", page["new_curves"])):
            assert_drawn(picture, look, size * np.asarray(curves[which]["pv"]))


def assert_same(one: dict[str, Any], other: dict[str, Any]) -> None:
    for which in ("setpoint", "load"):
        assert one[which]["horizon_s"] == pytest.approx(other[which]["horizon_s"], rel=1e-3)
        largest = float(np.max(np.abs(other[which]["pv"])))
        assert one[which]["pv"] == pytest.approx(other[which]["pv"], abs=1e-3 * largest)


def assert_drawn(picture: Picture, look: str, values: np.ndarray[Any, Any]) -> None:
    """The path of a look goes through these values, as precisely as its pixels say."""
    path = next(each.d for each in picture.paths if each.look == look)
    places = [float(y) for y in re.findall(r"[ML][\d.-]+ ([\d.-]+)", path)]
    assert places == pytest.approx([picture.at_y(each) for each in values], abs=0.06)


@pytest.mark.parametrize("name", MODELS)
def test_the_curves_are_those_of_the_controller_on_a_simulated_plant(name: str) -> None:
    """`controller` and `plantsim` share no code with `tuning`: sample by sample, from rest."""
    num, den, L, Ts = MODELS[name]
    sampled = TransferFunction(num, den, L + 0.5 * Ts)
    gains = designed_on(TransferFunction(num, den, L), DesignSpec(1.6), Ts).gains
    ends = horizons(sampled, (gains,))
    curves = loop_curves(sampled, gains, ends)
    assert isinstance(curves, LoopCurves)
    for curve, setpoint, load in ((curves.setpoint, 1.0, 0.0), (curves.load, 0.0, 1.0)):
        t, pv = simulated(name, gains, curve.horizon_s, setpoint, load)
        # the load of the model has the half sample of delay too, which is the controller's
        found, expected = np.asarray(curve.pv), np.interp(curve.t - 0.5 * Ts * load, t, pv)
        assert float(np.max(np.abs(found - expected))) < 0.03 * float(np.max(np.abs(expected)))


def simulated(name: str, gains: Gains, end: float, setpoint: float, load: float) -> tuple[Any, Any]:
    num, den, L, Ts = MODELS[name]
    reverse = (num[-1] or num[0]) > 0
    settings = Settings(-1e6, 1e6, safe_output=0.0, pv_low=-1e9, pv_high=1e9, reverse=reverse)
    parameters = Parameters(gains.Kp, gains.Ti, gains.Td, gains.Tf, gains.b, gains.c)
    channel = Channel(Ts, settings, parameters, 0.0, int(Mode.AUTOMATIC), 0.0)
    plant = LinearPlant(list(num), list(den), L, Ts, mv_low=-1e6, mv_high=1e6)
    channel.step(plant.pv)
    channel.setpoint = setpoint
    pvs = []
    for _ in range(int(end / Ts) + 2):
        pvs.append(plant.pv)
        plant.step(channel.step(plant.pv) + load)
    return Ts * np.arange(len(pvs)), np.asarray(pvs)


def test_a_loop_that_is_not_stable_has_no_curves() -> None:
    model = TransferFunction((2.0,), (6.0, 1.0), 1.5)
    assert loop_curves(model, Gains(9.0, 3.0), (20.0, 20.0)) is None
    assert step_pictures(None, None, 1.0, None) is None

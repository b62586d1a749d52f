"""Method setpoint in memory: what it proposes on the true plant, where the loop stays, and what it refuses."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from loopwright.service.jobs.stored_record import stored_record
from loopwright.tuning.analysis.margins import ultimate_point
from loopwright.tuning.fast.design.design import DesignSpec
from loopwright.tuning.fast.evaluation.record_evaluation import evaluate_again
from loopwright.tuning.fast.record import Excitation
from loopwright.tuning.models import TransferFunction
from loopwright.tuning.plan import Event, Mode, Sample, StageStarted
from tests.rehearsal.test_fast import PLANTS, spec, true_Ms
from tests.rehearsed import rehearse


def ultimate(plant: dict[str, Any]) -> tuple[float, float]:
    model = TransferFunction(tuple(plant["num"]), tuple(plant["den"]), plant["dead_time_s"])
    return ultimate_point(model)


def under(name: str, part: float, **more: Any) -> dict[str, Any]:
    """A plant under a PI whose Kp is this part of the ultimate gain."""
    plant = spec(name)
    Ku, Pu = ultimate(plant)
    return spec(name, gains={"Kp": part * Ku, "Ti": 1.2 * Pu if PLANTS[name]["den"][-1] else 4.0 * Pu}) | more


@pytest.mark.parametrize("part", [0.15, 0.4])
@pytest.mark.parametrize("name", PLANTS)
def test_the_loop_gets_the_Ms_asked_and_never_leaves_automatic(name: str, part: float) -> None:
    plant = under(name, part)
    taken: list[Sample] = []
    answer = rehearse(plant, method="setpoint", on_samples=taken.extend, propose_anyway=True)
    assert answer["outcome"] == "proposed", answer["detail"]
    assert answer["method"] == "setpoint"
    assert abs(true_Ms(plant, answer["new_gains"]) - 1.6) < 0.05
    assert {sample.mode for sample in taken} == {int(Mode.AUTOMATIC)}
    step = answer["input"]["sp_deviation"]
    moved = np.abs([sample.sp for sample in taken])
    assert moved.max() <= step * (1.0 + 1e-9), "the set-point goes no further than is permitted"
    assert taken[-1].sp == 0.0
    assert answer["stages"]["pulses"]["turns"] == 2
    assert answer["stages"]["redesign"]["uncertainty"] < 0.06


def test_new_gains_take_over_without_a_bump() -> None:
    """What moves MV at that sample is the set-point's step, by the proportional action of the new gains."""
    plant = under("first order", 0.15, noise_std=0.0)
    taken: list[Sample] = []
    answer = rehearse(plant, method="setpoint", on_samples=taken.extend)
    step, Kp, b = (answer["verification"][name] for name in ("step", "Kp", "b"))
    at = max(i for i in range(1, len(taken)) if taken[i].sp != taken[i - 1].sp)
    assert taken[at].mv - taken[at - 1].mv == pytest.approx(b * Kp * step, rel=0.05)
    assert b < 1.0


def test_the_pulses_leave_room_for_MV() -> None:
    """The present Kp makes a swing of MV of each swing of the set-point: where MV has little room, pulses are small."""
    plant = under("first order", 0.4, mv_limits=[-1.0, 1.0], sp_deviation=2.0)
    taken: list[Sample] = []
    answer = rehearse(plant, method="setpoint", on_samples=taken.extend, verify=False, propose_anyway=True)
    size = answer["stages"]["pulses"]["size"]
    assert size == pytest.approx(0.7 / (2.0 * plant["gains"]["Kp"]), rel=0.01)
    assert max(abs(sample.mv) for sample in taken) < 1.0


@pytest.mark.parametrize("name", ["first order", "three lags", "inverse response"])
def test_PV_stays_within_one_and_a_half_steps_under_gains_that_are_nearly_unstable(name: str) -> None:
    """Pulses of one size would move PV by 2 permitted steps and more. A forecast on so short a record may be off by a
    tenth."""
    plant = under(name, 0.75)
    moved: list[float] = []
    stages: list[str] = []

    def hear(event: Event) -> None:
        if isinstance(event, StageStarted):
            stages.append(event.stage)

    def take(samples: list[Sample]) -> None:
        moved.extend(abs(sample.pv) for sample in samples if stages[-1:] == ["pulses"])

    answer = rehearse(plant, method="setpoint", on_event=hear, on_samples=take, propose_anyway=True)
    assert answer["outcome"] == "proposed", answer["detail"]
    assert abs(true_Ms(plant, answer["new_gains"]) - 1.6) < 0.05
    assert max(moved) <= 1.65 * answer["input"]["sp_deviation"]


@pytest.mark.parametrize(("name", "part", "limit"), [("first order", 0.015, 0.08), ("three lags", 0.02, 0.15)])
def test_the_set_point_is_brought_near_where_the_new_Kp_is_many_times_the_present_one(
    name: str, part: float, limit: float
) -> None:
    """The step home from the pulse's level would take MV to its limit."""
    taken: list[Sample] = []
    plant = under(name, part, mv_limits=[-limit, limit], sp_deviation=0.1)
    answer = rehearse(plant, method="setpoint", on_samples=taken.extend)
    assert answer["outcome"] == "proposed", answer["detail"]
    assert abs(true_Ms(plant, answer["new_gains"]) - 1.6) < 0.05
    assert answer["new_gains"]["Kp"] > 8.0 * plant["gains"]["Kp"]
    assert answer["new_gains"]["Kp"] * 0.1 > limit, "a full step would not fit"
    step, Kp, b = (answer["verification"][name] for name in ("step", "Kp", "b"))
    assert abs(step) * b * Kp <= 0.71 * limit
    assert max(abs(sample.mv) for sample in taken) < limit


def test_a_plant_of_the_other_sign_is_refused() -> None:
    answer = rehearse(under("first order", 0.05, reverse_acting=False), method="setpoint")
    assert answer["outcome"] == "refused"


def test_a_loop_that_hardly_moves_is_refused_with_the_figures() -> None:
    plant = under("first order", 0.0005, noise_std=0.02, sp_deviation=0.3)
    answer = rehearse(plant, method="setpoint")
    assert answer["outcome"] == "refused"
    assert answer["reason"] in ("no_response", "stalled") and "after the set-point moved by" in answer["detail"]


def test_the_record_of_a_job_is_evaluated_again_from_its_samples() -> None:
    starts: list[str] = []
    taken: list[Sample] = []
    stage: list[str] = []

    def hear(event: Event) -> None:
        if isinstance(event, StageStarted):
            starts.append(event.stage)

    def take(samples: list[Sample]) -> None:
        taken.extend(samples)
        stage.extend(len(samples) * starts[-1:])

    answer = rehearse(under("three lags", 0.15), method="setpoint", on_event=hear, on_samples=take)
    columns = {name: [getattr(sample, key) for sample in taken] for name, key in
               (("t_s", "t"), ("sp", "sp"), ("pv", "pv"), ("mv", "mv"), ("mode", "mode"))}  # fmt: skip
    record = stored_record({"stage": stage, **columns})
    assert record is not None and record.excitation is Excitation.SETPOINT
    evidence = record.experiment_record()
    assert evidence is not None and evidence.turns == 2 and len(evidence.steps) >= 1 and evidence.direction == 1.0
    again = evaluate_again(evidence, DesignSpec(1.6))
    assert again.reason is None
    assert again.best.gains.Kp == pytest.approx(answer["new_gains"]["Kp"], rel=0.02)

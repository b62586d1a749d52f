"""Pulses of the manual output in memory: what is proposed on the true plant, where MV and PV stay, what is refused."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from loopwright.service.execution.rehearsal import RehearsedLoop
from loopwright.service.jobs.stored_record import stored_record
from loopwright.tuning.fast.design.design import DesignSpec
from loopwright.tuning.fast.evaluation.record_evaluation import evaluate_again
from loopwright.tuning.fast.experiment import Experiment
from loopwright.tuning.fast.manual.manual_test import CAME_BACK
from loopwright.tuning.fast.record import Excitation
from loopwright.tuning.plan import Command, Event, Mode, Plan, Sample, SetOutput, StageStarted
from tests.rehearsal.test_fast import PLANTS, spec, true_Ms
from tests.rehearsal.test_setpoint import under
from tests.rehearsed import rehearse

MANUAL = (Excitation.MANUAL,)
RETURNING = [name for name, plant in PLANTS.items() if plant["den"][-1]]


def pulsed(plant: dict[str, Any], **options: Any) -> tuple[dict[str, Any], list[Sample]]:
    taken: list[Sample] = []
    answer = rehearse(plant, excitations=MANUAL, on_samples=taken.extend, **options)
    return answer, taken


@pytest.mark.parametrize("part", [0.05, 0.4])
@pytest.mark.parametrize("name", RETURNING)
def test_the_loop_gets_the_Ms_asked_and_never_leaves_manual(name: str, part: float) -> None:
    plant = under(name, part)
    answer, taken = pulsed(plant, propose_anyway=True)
    assert answer["outcome"] == "proposed", answer["detail"]
    assert abs(true_Ms(plant, answer["new_gains"]) - 1.6) < 0.05
    assert {sample.mode for sample in taken} == {int(Mode.MANUAL)}
    assert {sample.sp for sample in taken} == {0.0}
    assert taken[-1].mv == 0.0
    assert max(abs(sample.pv) for sample in taken) <= answer["input"]["sp_deviation"]
    assert answer["verification"] is None and answer["step_after"] is None
    assert "never tested" in answer["notes"][0]


@pytest.mark.parametrize("name", RETURNING[::2])
def test_every_pulse_comes_back_and_none_lasts(name: str) -> None:
    """No pulse is longer than half of T95, and MV is home for more than a third of the time."""
    answer, taken = pulsed(under(name, 0.2), propose_anyway=True)
    away = np.array([sample.mv != 0.0 for sample in taken])
    edges = np.flatnonzero(away[1:] != away[:-1]) + 1
    widths = (edges[1::2] - edges[::2]) * answer["input"]["sample_time_s"]
    assert len(edges) % 2 == 0 and len(widths) >= 3
    assert widths.max() <= 0.5 * answer["input"]["t95_s"] + 1e-9
    signs = [math.copysign(1.0, taken[i].mv) for i in edges[::2]]
    assert set(signs) == {1.0, -1.0}, "up and down"


@pytest.mark.parametrize(("direction", "side"), [("up", 1.0), ("down", -1.0)])
@pytest.mark.parametrize("name", ["first order", "negative gain"])
def test_pulses_to_one_side_move_PV_there(name: str, direction: str, side: float) -> None:
    plant = under(name, 0.2, directions=direction)
    answer, taken = pulsed(plant, propose_anyway=True)
    assert answer["outcome"] == "proposed", answer["detail"]
    assert abs(true_Ms(plant, answer["new_gains"]) - 1.6) < 0.05
    of_mv = side if PLANTS[name]["num"][-1] > 0.0 else -side
    assert min(of_mv * sample.mv for sample in taken) == 0.0
    step, noise = answer["input"]["sp_deviation"], plant["noise_std"]
    assert max(side * sample.pv for sample in taken) > 0.5 * step
    assert min(side * sample.pv for sample in taken) > -6.0 * noise
    assert any(f"PV was moved {direction} only" in note for note in answer["notes"])


def test_pulses_keep_to_the_largest_jump_and_to_the_room_of_MV() -> None:
    for more in ({"mv_step_max": 0.3}, {"mv_limits": [-0.3, 5.0]}):
        answer, taken = pulsed(under("first order", 0.4, sp_deviation=4.0, **more), propose_anyway=True)
        assert answer["outcome"] == "proposed", answer["detail"]
        assert 0.2 < max(abs(sample.mv) for sample in taken) <= 0.3


def test_an_integrating_plant_is_refused_after_the_first_pulse() -> None:
    answer, taken = pulsed(under("integrates", 0.2))
    assert (answer["outcome"], answer["reason"]) == ("refused", "not_self_regulating")
    moved = np.flatnonzero(np.diff([sample.mv for sample in taken]))
    assert len(moved) == 2, "one pulse, up and back"
    assert taken[-1].mv == 0.0


def test_an_unstable_plant_is_refused_after_the_first_pulse() -> None:
    """1 / (10 s - 1): in manual PV runs away from wherever it is; here it begins exactly at rest."""
    plant = spec("first order", num=[1.0], den=[10.0, -1.0], dead_time_s=1.0, t95_s=10.0, sample_time_s=0.1,
                 noise_std=0.0, gains={"Kp": 3.0, "Ti": 20.0}, sp_deviation=1.0, reverse_acting=True)  # fmt: skip
    answer, taken = pulsed(plant)
    assert (answer["outcome"], answer["reason"]) == ("refused", "not_self_regulating")
    assert len(np.flatnonzero(np.diff([sample.mv for sample in taken]))) == 2
    assert taken[-1].mv == 0.0


def test_a_plant_that_does_not_answer_is_refused() -> None:
    plant = under("first order", 0.001, noise_std=0.05, num=[1e-4], sp_deviation=1.0)
    answer, taken = pulsed(plant)
    assert (answer["outcome"], answer["reason"]) == ("refused", "no_response")
    assert taken[-1].mv == 0.0


def test_a_load_in_the_first_pulse_is_no_integrating_plant(monkeypatch: pytest.MonkeyPatch) -> None:
    """PV comes to rest elsewhere: of a loop in manual nothing brings it back."""
    plant = under("first order", 0.2)
    pulses = 0
    seen: list[float] = []

    class Loaded(RehearsedLoop):
        def step(self, commands: Any) -> Sample:
            nonlocal pulses
            pulses += sum(isinstance(each, SetOutput) for each in commands)
            if pulses == 2:
                self._plant.disturbance = 0.15  # type: ignore[attr-defined]  # of a LinearPlant
            sample = super().step(commands)
            seen.append(sample.pv)
            return sample

    monkeypatch.setattr("loopwright.service.execution.rehearsal.RehearsedLoop", Loaded)
    answer, _ = pulsed(plant, propose_anyway=True)
    assert max(seen[-50:]) > 2.0 * CAME_BACK * 0.1, "the load has stayed"
    assert answer["reason"] != "not_self_regulating", answer["detail"]
    if answer["outcome"] == "proposed":
        assert abs(true_Ms(plant, answer["new_gains"]) - 1.6) < 0.1


@pytest.mark.parametrize("at", [0.4, 0.9, 1.4])
@pytest.mark.parametrize("size", [0.35, -0.35])
def test_a_load_near_a_pulse_does_not_hide_in_the_model(
    monkeypatch: pytest.MonkeyPatch, at: float, size: float
) -> None:
    """at: in ultimate periods after the first pulse. size: in MV that moves PV by the permitted step. A fit without the
    load had Ms off by 0.13 here."""
    plant = spec("three lags", num=[8.0, 13.0, 5.0], den=[9.0, 31.0, 34.0, 13.0, 1.0], dead_time_s=2.0, t95_s=28.0,
                 sample_time_s=0.116, sp_deviation=1.0, noise_std=0.01, gains={"Kp": 0.25, "Ti": 9.0})  # fmt: skip
    begun = 0

    class Loaded(RehearsedLoop):
        def step(self, commands: Any) -> Sample:
            nonlocal begun
            begun += bool(begun) or any(isinstance(each, SetOutput) for each in commands)
            if begun == round(at * 9.27 / 0.116):
                self._plant.disturbance = size / 5.0  # type: ignore[attr-defined]  # of a LinearPlant
            return super().step(commands)

    monkeypatch.setattr("loopwright.service.execution.rehearsal.RehearsedLoop", Loaded)
    answer, _ = pulsed(plant, propose_anyway=True)
    assert answer["outcome"] == "refused" or abs(true_Ms(plant, answer["new_gains"]) - 1.6) < 0.05, answer["notes"]


def test_slow_computations_do_not_end_the_pulses(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each takes seven ultimate periods, on a busy machine."""
    computed = Experiment.computed

    def slowly(self: Experiment, compute: Callable[[], object]) -> Plan[object]:
        found = yield from computed(self, compute)
        for _ in range(600):
            self._commands = self._on_sample((yield self._commands))
        return found

    monkeypatch.setattr(Experiment, "computed", slowly)
    plant = under("three lags", 0.2)
    answer, _ = pulsed(plant, propose_anyway=True)
    assert answer["outcome"] == "proposed", answer["detail"]
    assert abs(true_Ms(plant, answer["new_gains"]) - 1.6) < 0.05


def test_MV_that_does_not_follow_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    """A limit of the controller that is not among those that were read."""

    class Held(RehearsedLoop):
        def _carry_out(self, command: Command) -> None:
            super()._carry_out(SetOutput(min(command.value, 0.01)) if isinstance(command, SetOutput) else command)

    monkeypatch.setattr("loopwright.service.execution.rehearsal.RehearsedLoop", Held)
    answer, taken = pulsed(under("first order", 0.4))
    assert (answer["outcome"], answer["reason"]) == ("refused", "mv_limit")
    assert "a limit of the controller holds it" in answer["detail"]
    assert taken[-1].mv <= 0.01


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

    plant = under("three lags", 0.15)
    answer = rehearse(plant, excitations=MANUAL, on_event=hear, on_samples=take, propose_anyway=True)
    columns = {name: [getattr(sample, key) for sample in taken] for name, key in
               (("t_s", "t"), ("sp", "sp"), ("pv", "pv"), ("mv", "mv"), ("mode", "mode"))}  # fmt: skip
    record = stored_record({"stage": stage, **columns})
    assert record is not None and record.excitation is Excitation.MANUAL
    evidence = record.experiment_record()
    assert evidence is not None and evidence.direction == 1.0 and not evidence.steps and not evidence.one_sided
    again = evaluate_again(evidence, DesignSpec(1.6))
    assert again.reason is None
    assert again.best.gains.Kp == pytest.approx(answer["new_gains"]["Kp"], rel=0.02)

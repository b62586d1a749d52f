"""Loops that may be moved to one side of their rest only, or no faster than at a rate, by every method in memory."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from loopwright.controller.channel import Channel, Settings
from loopwright.controller.pid import Parameters
from loopwright.plantsim.plant import LinearPlant
from loopwright.service.execution.guard import RunLimits
from loopwright.service.execution.rehearsal import RehearsedLoop
from loopwright.service.execution.runner import RunResult, run
from loopwright.service.jobs.stored_record import moves_of, stored_record
from loopwright.tuning.analysis.margins import margins
from loopwright.tuning.experiments.primitives import Directions, Facts
from loopwright.tuning.fast.design.design import DesignSpec
from loopwright.tuning.fast.design.options import DesignOptions
from loopwright.tuning.fast.evaluation.proposal import FastProposal
from loopwright.tuning.fast.evaluation.record_evaluation import evaluate_again
from loopwright.tuning.fast.pulses.procedure import setpoint
from loopwright.tuning.fast.record import Excitation
from loopwright.tuning.gains import Gains
from loopwright.tuning.models import FOPDT
from loopwright.tuning.plan import Mode, Sample
from tests.rehearsal.test_excitation_choice import Heard
from tests.rehearsal.test_fast import PLANTS, true_Ms
from tests.rehearsal.test_setpoint import ultimate, under
from tests.rehearsed import rehearse

UNSEEN = "A gain of the plant that differs above and below where the test began cannot be seen"


def moved(plant: dict[str, Any], method: str = "setpoint", **more: Any) -> tuple[dict[str, Any], list[Sample]]:
    taken: list[Sample] = []
    return rehearse(plant, method=method, on_samples=taken.extend, propose_anyway=True, **more), taken


def periods(plant: dict[str, Any], step_in: float) -> float:
    """The rate at which the permitted step takes so many ultimate periods; the step is the one that is chosen."""
    return float(plant["sp_deviation"] / (step_in * ultimate(plant)[1]))


@pytest.mark.parametrize("name", PLANTS)
@pytest.mark.parametrize(("directions", "part"), [("up", 0.15), ("down", 0.4)])
def test_the_set_point_goes_to_the_side_that_is_permitted_alone(name: str, directions: str, part: float) -> None:
    plant = under(name, part, directions=directions)
    answer, taken = moved(plant)
    assert answer["outcome"] == "proposed", answer["detail"]
    assert abs(true_Ms(plant, answer["new_gains"]) - 1.6) < 0.05
    sp, step = np.array([sample.sp for sample in taken]), answer["input"]["sp_deviation"]
    away = -sp if directions == "down" else sp
    assert away.min() == 0.0 and 0.0 < away.max() <= step * (1.0 + 1e-9)
    assert np.count_nonzero(np.diff(away) < 0.0) >= 2, "back, and home under the new gains"
    assert {sample.mode for sample in taken} == {int(Mode.AUTOMATIC)}
    assert any(f"moved {directions} only. {UNSEEN}" in note for note in answer["notes"])


def test_of_pulses_to_both_sides_nothing_is_said() -> None:
    assert not any(UNSEEN in note for note in moved(under("first order", 0.15))[0]["notes"])


@pytest.mark.parametrize("name", ["first order", "negative gain"])
def test_down_is_the_mirror_image_of_up(name: str) -> None:
    """Without noise the one record is the other one with its sign changed."""
    up, down = (moved(under(name, 0.3, noise_std=0.0, directions=way))[0] for way in ("up", "down"))
    assert up["new_gains"]["Kp"] == pytest.approx(down["new_gains"]["Kp"], rel=0.01)
    assert up["plant_time_s"]["pulses"] == pytest.approx(down["plant_time_s"]["pulses"], rel=0.05)


def test_pulses_to_one_side_may_be_twice_as_large_where_MV_bounds_them() -> None:
    plant = under("first order", 0.4, mv_limits=[-1.0, 1.0], sp_deviation=2.0)
    both, up = (moved(plant | {"directions": way}, verify=False)[0] for way in ("both", "up"))
    assert up["stages"]["pulses"]["size"] == pytest.approx(2.0 * both["stages"]["pulses"]["size"], rel=0.01)


class TwoSided(LinearPlant):
    """A plant whose gain below rest is another one: the lower actuator is weaker or stronger."""

    below = 1.0

    def step(self, mv: float) -> float:
        return super().step(mv if mv > 0.0 else self.below * mv)


def of_two_sided(
    below: float, directions: Directions, Kp: float = 1.0, Ti: float = 8.0, seed: int = 3
) -> RunResult[FastProposal]:
    """The end of a test of a lag of 10 s with a gain of 2 and a dead time of 2 s above rest, noise 0.5 %."""
    Ts = 0.1
    plant = TwoSided([2.0], [10.0, 1.0], 2.0, Ts, noise_std=0.005, seed=seed)
    plant.below = below
    gains = Gains(Kp, Ti)
    channel = Channel(Ts, Settings(-1e3, 1e3, 0.0, pv_low=-1e3, pv_high=1e3), Parameters(Kp, Ti), 0.0, Mode.AUTOMATIC)
    facts = Facts(Ts, 32.0, -1e3, 1e3, 1.0, gains, directions=directions)
    plan = setpoint(facts, DesignOptions(propose_anyway=True))
    return run(plan, RehearsedLoop(plant, channel, Ts), limits=RunLimits(max_time_s=3000.0))


@pytest.mark.parametrize(("below", "directions"), [(0.7, Directions.UP), (1.5, Directions.BOTH)])
def test_a_gain_that_differs_below_is_refused_where_MV_goes_there(below: float, directions: Directions) -> None:
    """On the way back these gains take MV below its rest."""
    assert of_two_sided(below, directions).value is None


@pytest.mark.parametrize("seed", [2, 16])
def test_where_MV_hardly_goes_there_the_gains_hold_for_the_side_that_was_tested(seed: int) -> None:
    """Under other noise the difference shows and is refused; under some of it, whether it shows depends on rounding."""
    found = of_two_sided(0.7, Directions.UP, 0.25, 12.0, seed).value
    assert found is not None and any(UNSEEN in note for note in found.notes)
    above, below = (margins(FOPDT(K, 10.0, 2.0 + 0.05), found.gains).Ms for K in (2.0, 1.4))
    assert above == pytest.approx(1.6, abs=0.05)
    assert below < 1.5, "another one, which the test cannot know"


class TestRefused:
    def test_the_relay_under_one_direction(self) -> None:
        answer, taken = moved(under("first order", 0.15, directions="up"), "fast")
        assert (answer["outcome"], answer["reason"]) == ("refused", "bad_limits")
        assert "may be moved up only, and a relay moves PV to both sides" in answer["detail"]
        assert not np.any([sample.sp for sample in taken])

    @pytest.mark.parametrize(
        ("limits", "words"),
        [({"directions": "down"}, "to both sides of its rest by relay and ultimate"),
         ({"sp_rate_max_per_s": 0.01}, "a step, which a ramp does not show")],
    )  # fmt: skip
    def test_the_five_stages(self, limits: dict[str, Any], words: str) -> None:
        answer, taken = moved(under("first order", 0.15, **limits), "five-stage")
        assert (answer["outcome"], answer["reason"]) == ("refused", "bad_limits") and words in answer["detail"]
        assert not np.any([sample.sp for sample in taken])

    def test_the_trial_of_gains_for_a_model_by_a_ramp(self) -> None:
        model = FOPDT(2.0, 10.0, 2.03)
        answer, _ = moved(under("first order", 0.15, sp_rate_max_per_s=0.01), "fast", model=model)
        assert answer["reason"] == "bad_limits" and "measured by verify" in answer["detail"]

    def test_a_rate_at_which_nothing_is_seen_before_anything_is_moved(self) -> None:
        plant = under("first order", 0.15, sp_deviation=0.2, noise_std=0.002)
        plant["sp_rate_max_per_s"] = periods(plant, 1000.0)
        answer, taken = moved(plant)
        assert (answer["outcome"], answer["reason"]) == ("refused", "uncertain")
        assert "the set-point takes" in answer["detail"] and "at least is needed" in answer["detail"]
        assert not np.any([sample.sp for sample in taken])


def test_the_trial_of_gains_for_a_model_goes_down_where_that_is_permitted() -> None:
    plant = under("first order", 0.15, directions="down")
    answer, taken = moved(plant, "fast", model=FOPDT(2.0, 10.0, 2.03))
    assert answer["outcome"] == "proposed", answer["detail"]
    sp = [sample.sp for sample in taken]
    assert max(sp) == 0.0 > min(sp)
    assert 0.0 <= answer["step_after"]["overshoot_pct"] < 30.0 and answer["step_after"]["step"] < 0.0


@pytest.mark.parametrize("step_in", [0.25, 1.0])
@pytest.mark.parametrize(("method", "excitations"), [("setpoint", ()), ("fast", (Excitation.RELAY,))])
@pytest.mark.parametrize("name", ["first order", "three lags", "negative gain"])
def test_no_test_moves_the_set_point_faster_than_is_permitted(
    name: str, method: str, excitations: tuple[Excitation, ...], step_in: float
) -> None:
    plant = under(name, 0.3, sp_deviation=0.2)
    plant["sp_rate_max_per_s"] = rate = periods(plant, step_in)
    more = {"excitations": excitations} if excitations else {}
    answer, taken = moved(plant, method, **more)
    assert answer["outcome"] == "proposed", answer["detail"]
    assert abs(true_Ms(plant, answer["new_gains"]) - 1.6) < 0.05
    sp = np.array([sample.sp for sample in taken])
    assert np.abs(np.diff(sp)).max() <= rate * plant["sample_time_s"] * (1.0 + 1e-6)
    assert sp[-1] == 0.0, "home by a ramp, before the controller brings it there in one step"


def test_to_one_side_and_by_ramps() -> None:
    plant = under("three lags", 0.3, sp_deviation=0.2, directions="down")
    plant["sp_rate_max_per_s"] = rate = periods(plant, 1.0)
    answer, taken = moved(plant)
    assert answer["outcome"] == "proposed", answer["detail"]
    assert abs(true_Ms(plant, answer["new_gains"]) - 1.6) < 0.05
    sp = np.array([sample.sp for sample in taken])
    assert sp.max() == 0.0 and np.abs(np.diff(sp)).max() <= rate * plant["sample_time_s"] * (1.0 + 1e-6)


def test_a_stored_record_of_ramps_is_judged_as_the_procedure_did() -> None:
    """Each ramp is one turn, or one step; that the set-point went to one side is seen in the record itself."""
    plant = under("first order", 0.3, sp_deviation=0.2, directions="down")
    plant["sp_rate_max_per_s"] = periods(plant, 1.0)
    heard = Heard()
    answer = heard.rehearse(plant, method="setpoint")
    assert answer["outcome"] == "proposed", answer["detail"]
    columns = {key: [getattr(sample, source) for sample in heard.taken] for key, source in
               (("t_s", "t"), ("sp", "sp"), ("pv", "pv"), ("mv", "mv"), ("mode", "mode"))}  # fmt: skip
    found = stored_record({"stage": heard.stages, **columns})
    assert found is not None and len(found.switches) == 2
    evidence = found.experiment_record()
    assert evidence is not None and evidence.one_sided and evidence.direction == 1.0
    assert len(evidence.steps) == 1 and evidence.steps[0] == found.excited
    again = evaluate_again(evidence, DesignSpec(1.6))
    assert again.reason is None, again.detail
    assert again.best.gains.Kp == pytest.approx(answer["new_gains"]["Kp"], rel=0.05)


def test_a_move_begins_where_the_set_point_stood_or_turns() -> None:
    sp = np.array([0.0, 0.0, 1.0, 2.0, 3.0, 3.0, 2.0, 1.0, *[1.0] * 20, 0.5, 0.0])
    assert list(moves_of(sp)) == [2, 6, 28]
    in_blocks = np.repeat([0.0, 1.0, 2.0, 3.0, 2.0], 10)
    assert list(moves_of(in_blocks)) == [10, 40]

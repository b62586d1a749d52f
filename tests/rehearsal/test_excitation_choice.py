"""Method fast where the loop permits pulses of the set-point: which excitation it takes, and what the record is."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from loopwright.service.jobs.stored_record import stored_record
from loopwright.tuning.fast.design.design import DesignSpec
from loopwright.tuning.fast.evaluation.record_evaluation import evaluate_again
from loopwright.tuning.fast.record import Excitation
from loopwright.tuning.plan import Event, Mode, Note, Sample, StageStarted
from tests.rehearsal.test_fast import true_Ms
from tests.rehearsal.test_setpoint import under
from tests.rehearsed import rehearse

BOTH = (Excitation.SETPOINT, Excitation.RELAY)


class Heard:
    """What a rehearsal reports: its stages, notes and samples, each sample with its stage."""

    def __init__(self) -> None:
        self.starts: list[str] = []
        self.notes: list[str] = []
        self.taken: list[Sample] = []
        self.stages: list[str] = []

    def event(self, event: Event) -> None:
        if isinstance(event, StageStarted):
            self.starts.append(event.stage)
        if isinstance(event, Note):
            self.notes.append(event.text)

    def samples(self, samples: list[Sample]) -> None:
        self.taken.extend(samples)
        self.stages.extend(len(samples) * self.starts[-1:])

    def rehearse(self, plant: dict[str, Any], **more: Any) -> dict[str, Any]:
        return rehearse(plant, on_event=self.event, on_samples=self.samples, propose_anyway=True, **more)


@pytest.mark.parametrize("excitations", [(Excitation.SETPOINT,), BOTH], ids=["pulses alone", "either"])
def test_gains_that_excite_enough_need_no_relay(excitations: tuple[Excitation, ...]) -> None:
    plant, heard = under("three lags", 0.4), Heard()
    answer = heard.rehearse(plant, excitations=excitations)
    assert answer["outcome"] == "proposed", answer["detail"]
    assert answer["method"] == "fast"
    assert abs(true_Ms(plant, answer["new_gains"]) - 1.6) < 0.05
    assert {sample.mode for sample in heard.taken} == {int(Mode.AUTOMATIC)}
    assert "relay" not in heard.starts and "pulses" in heard.starts


@pytest.mark.parametrize("name", ["three lags", "inverse response"])
def test_where_sluggish_gains_excite_too_little_the_relay_follows_in_the_same_record(name: str) -> None:
    """A PID needs to know the plant above the crossover, where a twentieth of Ku excites nothing."""
    plant, heard = under(name, 0.02), Heard()
    answer = heard.rehearse(plant, derivative=True, excitations=BOTH)
    assert answer["outcome"] == "proposed", answer["detail"]
    assert abs(true_Ms(plant, answer["new_gains"]) - 1.6) < 0.1
    at = heard.starts.index("relay")
    assert heard.starts[at - 1] == "pulses", "nothing is waited for between the two"
    assert any("the relay follows" in note for note in heard.notes)
    before = [sample.mode for sample, stage in zip(heard.taken, heard.stages, strict=True) if stage == "pulses"]
    assert set(before) == {int(Mode.AUTOMATIC)}

    columns = {key: [getattr(sample, source) for sample in heard.taken] for key, source in
               (("t_s", "t"), ("sp", "sp"), ("pv", "pv"), ("mv", "mv"), ("mode", "mode"))}  # fmt: skip
    record = stored_record({"stage": heard.stages, **columns})
    assert record is not None and record.excitation is Excitation.RELAY
    pulses = np.flatnonzero(np.diff(record.sp))
    assert record.listened == pulses[0] + 1, "the record is at rest up to the first pulse"
    evidence = record.experiment_record()
    assert evidence is not None
    again = evaluate_again(evidence, DesignSpec(1.6, derivative=True))
    assert again.best.gains.Kp == pytest.approx(answer["new_gains"]["Kp"], rel=0.05)


def test_without_a_choice_the_relay_moves_the_loop() -> None:
    heard = Heard()
    assert heard.rehearse(under("three lags", 0.4))["outcome"] == "proposed"
    assert "relay" in heard.starts and "pulses" not in heard.starts


def test_where_the_relay_is_not_permitted_pulses_that_tell_too_little_are_refused() -> None:
    heard = Heard()
    answer = heard.rehearse(under("first order", 0.0005, noise_std=0.02, sp_deviation=0.3), excitations=BOTH[:1])
    assert answer["outcome"] == "refused" and "relay" not in heard.starts

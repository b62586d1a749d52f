"""The record of a fast job, read again from its samples."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from loopwright.service.jobs.stored_record import stored_record
from loopwright.tuning.fast.structure_choice import choose_structure
from loopwright.tuning.identification.output_error import Fit
from loopwright.tuning.plan import Event, Mode, Sample, StageStarted
from tests.rehearsed import rehearse

SPEC = {"num": [-1.5], "den": [8.0, 1.0], "dead_time_s": 2.0, "sample_time_s": 0.1, "noise_std": 0.002, "t95_s": 26.0}


def rehearsed(**options: Any) -> tuple[dict[str, Any], dict[str, list[Any]]]:
    """The answer, and the samples as the API gives them."""
    starts: list[str] = []
    taken: list[Sample] = []

    def hear(event: Event) -> None:
        if isinstance(event, StageStarted):
            starts.append(event.stage)

    answer = rehearse(SPEC, on_event=hear, on_samples=taken.extend, **options)
    times = answer["plant_time_s"]
    stage = [name for name in starts for _ in range(round(times[name] / SPEC["sample_time_s"]))]  # type: ignore[operator]
    stage += stage[-1:] * (len(taken) - len(stage))
    columns = {
        "stage": stage[: len(taken)], "t_s": [s.t for s in taken], "sp": [s.sp for s in taken],
        "pv": [s.pv for s in taken], "mv": [s.mv for s in taken], "mode": [s.mode for s in taken],
    }  # fmt: skip
    return answer, columns


@pytest.fixture(scope="module")
def job() -> tuple[dict[str, Any], dict[str, list[Any]]]:
    answer, columns = rehearsed()
    assert answer["outcome"] == "proposed"
    return answer, columns


def without(columns: dict[str, list[Any]], lost: set[int]) -> dict[str, list[Any]]:
    return {name: [x for i, x in enumerate(values) if i not in lost] for name, values in columns.items()}


@pytest.mark.parametrize("lost", [(), (300, 301, 302), (40, 250, 420, 421)])
def test_the_same_model_comes_out_of_it_again(
    job: tuple[dict[str, Any], dict[str, list[Any]]], lost: tuple[int, ...]
) -> None:
    answer, columns = job
    record = stored_record(without(columns, set(lost)))
    assert record is not None and len(record.t) == len(columns["t_s"])
    assert record.Ts == pytest.approx(0.1) and record.t[record.listened] == 0.0
    evidence = record.experiment_record()
    assert evidence is not None
    assert evidence.turns == answer["evidence"]["switches"]
    assert evidence.direction == -1.0  # the plant's gain is negative
    fit = Fit(evidence)
    model = fit.model(choose_structure(fit).best)
    assert model.num[-1] / model.den[-1] == pytest.approx(-1.5, rel=0.01)
    assert abs(model.L - 2.0) < 0.05


def test_single_wrong_samples_are_taken_out_again(job: tuple[dict[str, Any], dict[str, list[Any]]]) -> None:
    _, columns = job
    pv = list(columns["pv"])
    for k in range(7, len(pv) - 20, 83):
        pv[k] += 0.4 if k % 2 else -0.4
    whole, spoilt = stored_record(columns), stored_record(columns | {"pv": pv})
    assert whole is not None and spoilt is not None
    right, again = whole.experiment_record(), spoilt.experiment_record()
    assert right is not None and again is not None
    assert np.max(np.abs(spoilt.pv - whole.pv)) == pytest.approx(0.4)
    assert np.max(np.abs(again.y - right.y)) < 0.05


def test_the_last_attempt_counts(job: tuple[dict[str, Any], dict[str, list[Any]]]) -> None:
    columns = job[1]
    half = len(columns["t_s"]) // 2
    cut = {name: values[:half] for name, values in columns.items()}
    later = cut["t_s"][-1] + 0.1
    both = {name: cut[name] + values for name, values in columns.items() if name != "t_s"}
    both["t_s"] = cut["t_s"] + [t + later for t in columns["t_s"]]
    again, once = stored_record(both), stored_record(columns)
    assert again is not None and once is not None
    assert again.switches == once.switches and np.array_equal(again.pv, once.pv)


def test_the_last_look_at_the_loop_counts(job: tuple[dict[str, Any], dict[str, list[Any]]]) -> None:
    """A loop that was not at rest at first: what was seen then is no part of the record."""
    columns = job[1]
    first = [i for i, name in enumerate(columns["stage"]) if name == "preflight"]
    looked = {name: [values[i] for i in first] for name, values in columns.items()}
    looked["pv"] = [pv + 5.0 for pv in looked["pv"]]
    both = {name: 2 * looked[name] + values for name, values in columns.items()}
    both["stage"][len(first) : 2 * len(first)] = len(first) * ["settle"]
    both["t_s"] = [0.1 * i for i in range(len(both["t_s"]))]
    again, once = stored_record(both), stored_record(columns)
    assert again is not None and once is not None
    assert again.listened == once.listened and np.array_equal(again.pv, once.pv)


def test_no_relay_no_record(job: tuple[dict[str, Any], dict[str, list[Any]]]) -> None:
    columns = job[1]
    quiet = [i for i, mode in enumerate(columns["mode"]) if mode != Mode.EXPERIMENT]
    assert stored_record({name: [values[i] for i in quiet] for name, values in columns.items()}) is None
    assert stored_record({name: [] for name in columns}) is None
    first = columns["mode"].index(Mode.EXPERIMENT)
    begun = stored_record({name: values[: first + 5] for name, values in columns.items()})
    assert begun is not None and begun.experiment_record() is None


@pytest.mark.parametrize("gain", [1.5, -1.5])
@pytest.mark.parametrize("down", [-1.0, 1.0], ids=["both sides", "one side"])
def test_the_sign_of_the_gain_where_the_first_pulse_is_over_before_pv_answers(gain: float, down: float) -> None:
    """Pulses of the manual output of 1 / (s + 1) with a dead time of 5 s, the first of which lasts 4 s."""
    dead_time, decay = 50, float(np.exp(-0.1))
    pulses = [(0.0, 100), (1.0, 40), (0.0, 110), (2.0 * down, 60), (0.0, 90), (2.0, 40), (0.0, 90)]
    mv = np.concatenate([np.full(samples, level) for level, samples in pulses])
    pv, answer = np.random.default_rng(4).normal(0.0, 0.01, len(mv)), 0.0
    for i in range(dead_time, len(mv)):
        pv[i] += answer
        answer = decay * answer + (1.0 - decay) * gain * mv[i - dead_time]
    record = stored_record(
        {
            "stage": ["preflight"] * 100 + ["manual"] * (len(mv) - 100), "t_s": np.arange(len(mv)) / 10.0,
            "sp": np.zeros(len(mv)), "pv": 40.0 + pv, "mv": 50.0 + mv, "mode": [int(Mode.MANUAL)] * len(mv),
        }
    )  # fmt: skip
    assert record is not None and record.switches[0] == 140
    evidence = record.experiment_record()
    assert evidence is not None and evidence.one_sided == (down > 0.0)
    assert evidence.direction == np.sign(gain)

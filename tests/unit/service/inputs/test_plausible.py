"""What no plant can be is refused at the edge by name; what a plant can be is not."""

from __future__ import annotations

import json
from collections.abc import Iterator
from typing import Any

import pytest
from fastapi.testclient import TestClient
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import ValidationError

from benchmarks.plants import plants
from loopwright.service.inputs.config import ConfigError, parse_site
from loopwright.service.inputs.model_json import BadModel, dump_model, parse_model
from loopwright.service.inputs.plausible import Implausible, check_model, check_sampling
from loopwright.service.inputs.request import BadLimits, retune_request, within
from loopwright.service.offline.tunings import BadTuning, tune_model
from tests.rehearsed import rehearse
from tests.unit.service.fakes import TAG, Service, loop_entry
from validation.references import References, load

FAR_OUTSIDE: list[tuple[dict[str, Any], str]] = [
    ({"K": 1e-308, "T_s": 1.0, "L_s": 1.0}, "1e-308"),
    ({"K": 1e300, "T_s": 1.0, "L_s": 1.0}, "1e+300"),
    ({"K": 1e-10, "T_s": 1.0, "L_s": 1.0}, "a gain of 1e-10"),
    ({"K": 1.0, "T_s": 1.0, "L_s": 1e-9}, "a dead time of 1e-09 s"),
    ({"K": 1.0, "T_s": 1.0, "L_s": 2e-6}, "give 0"),
    ({"K": 1.0, "T_s": 1.0, "L_s": 4e6}, "a dead time of 4e+06 s"),
    ({"K": 1.0, "T_s": 1e-300, "L_s": 1.0}, "1e-300"),
    ({"K": 1.0, "T1_s": 10.0, "T2_s": 1e-5, "L_s": 1.0}, "differ by a factor 1e+06"),
    ({"K": 1.0, "T_s": 1.0, "zeta": 1e-5, "L_s": 1.0}, "zeta 1e-05"),
    ({"K": 1.0, "T_s": 1.0, "zeta": 1e5, "L_s": 1.0}, "differ by a factor"),
    ({"K": 1e-20, "L_s": 1.0, "integrating": True}, "a gain of"),
    ({"num": [1.0], "den": [1e-300, 1.0, 1.0]}, "1e-300"),
    ({"num": [1.0], "den": [1e-6, 1.0, 1.0]}, "differ by a factor 1e+06"),
    ({"num": [1e7, 1.0], "den": [1.0, 1.0]}, "a zero of 1e+07 s"),
    ({"num": [1.0], "den": [1e200, 1.0, 1.0]}, "1e+200"),
]


@pytest.mark.parametrize("model, words", FAR_OUTSIDE, ids=str)
def test_no_plants_model_is_refused_by_name(client: TestClient, model: dict[str, Any], words: str) -> None:
    with pytest.raises(BadModel) as caught:
        parse_model(model)
    assert words in str(caught.value) and "permitted" in str(caught.value)
    answer = client.post("/tunings", json={"model": model, "method": "me-pso"})
    assert answer.status_code == 422 and words in answer.json()["detail"]


@pytest.mark.parametrize("model, words", [case for case in FAR_OUTSIDE if "num" in case[0]], ids=str)
def test_nor_is_it_rehearsed_on(client: TestClient, service: Service, model: dict[str, Any], words: str) -> None:
    for name in ("plant", "model"):
        answer = client.post(f"/loops/{TAG}/retune", json={"dry_run": True, name: model})
        assert answer.status_code == 422 and words in answer.json()["detail"]
    told = rehearse(model)
    assert told["reason"] == "bad_input" and words in told["detail"]
    assert not service.store.recent()


@pytest.mark.parametrize(
    "plant",
    [{"model": {"K": 1.0, "T_s": 1e6, "L_s": 4e6}}, {"plant": {"num": [1.0], "den": [1e6, 1.0], "dead_time_s": 4e6}}],
)
def test_a_dead_time_far_beyond_the_t95_of_the_loop_makes_no_job(
    client: TestClient, service: Service, plant: dict[str, Any]
) -> None:
    """It was refused by the dry run, in a process of its own and after the controller had been read: who asked again at
    once kept the service busy with that, and other loops of that controller waiting for their turn."""
    answer = client.post(f"/loops/{TAG}/retune", json={"dry_run": True, **plant})
    assert answer.status_code == 422 and "at most 90 s are permitted" in answer.json()["detail"]
    assert not service.store.recent()


def test_every_plant_of_the_benchmarks_and_the_papers_is_plausible() -> None:
    found = plants()
    assert len(found) == 121
    for plant in found:
        check_model(plant.num, plant.den, plant.L)
        parse_model({"num": plant.num, "den": plant.den, "dead_time_s": plant.L})
    papers = [model for table in vars_of(load()) for model in models_in(table)]
    assert len(papers) > 100
    for num, den, dead_time in papers:
        check_model(num, den, dead_time)


def vars_of(references: References) -> list[Any]:
    return [getattr(references, name) for name in References.__dataclass_fields__]


def models_in(table: Any) -> Iterator[tuple[list[float], list[float], float]]:
    """Whatever in the data of the papers reads as a model."""
    if isinstance(table, list):
        for part in table:
            yield from models_in(part)
    elif isinstance(table, dict):
        if {"num", "den"} <= table.keys():
            yield table["num"], table["den"], float(table.get("delay", table.get("L", 0.0)))
        for gain, lag, dead_time in (("K", "T", "L"), ("k", "T", "tau")):
            if all(isinstance(table.get(name), int | float) for name in (gain, lag, dead_time)):
                yield [table[gain]], [table[lag], 1.0], float(table[dead_time])
        for part in table.values():
            yield from models_in(part)


@pytest.mark.parametrize(
    "changes, words",
    [
        ({"t95_s": 1e-300}, "1e-300"),
        ({"t95_s": 1e12}, "1e+12"),
        ({"sp_deviation": 1e-12}, "sp_deviation 1e-12"),
        ({"pv_limits": {"low": 0.0, "high": 1e300}}, "1e+300"),
        ({"noise_std_hint": 1e300}, "1e+300"),
    ],
)
def test_loops_far_outside(changes: dict[str, Any], words: str) -> None:
    with pytest.raises(ConfigError) as caught:
        parse_site({"loops": [loop_entry(**changes)]}, "loops.yaml")
    assert words in str(caught.value) and TAG in str(caught.value)


@pytest.mark.parametrize(
    "spec, words",
    [
        ({"dead_time_s": 4e5, "den": [400.0, 1.0], "t95_s": 9.0}, "dead time"),
        ({"sample_time_s": 1e-6, "t95_s": 30.0}, "sample_time_s"),
        ({"sample_time_s": 100.0, "t95_s": 30.0}, "sample_time_s"),
        ({"noise_std": 1e300}, "1e+300"),
        ({"gains": {"Kp": 1e-300}}, "1e-300"),
        ({"mv_limits": [-1e300, 1e300]}, "1e+300"),
    ],
)
def test_rehearsals_far_outside(spec: dict[str, Any], words: str) -> None:
    told = rehearse({"num": [1.0], "den": [10.0, 1.0], "dead_time_s": 1.0} | spec)
    assert told["outcome"] == "refused" and told["reason"] == "bad_input" and words in told["detail"]


def test_a_dry_run_never_holds_more_than_its_limit_of_samples() -> None:
    """A dead time of 4e6 s took 1.6 GiB."""
    with pytest.raises(Implausible, match="200,000"):
        check_sampling(4e6, 1e6, 1.0)


def test_options_and_wishes_far_outside() -> None:
    model = parse_model({"K": 1.0, "T_s": 3.0, "L_s": 1.0})
    for value in (1e300, 1e-300):
        with pytest.raises(BadTuning, match="tau_c_s"):
            tune_model(model, "simc", {"tau_c_s": value})
        with pytest.raises(ValidationError, match="tau_c_s"):
            retune_request(method="simc", method_options={"tau_c_s": value})
    loop = parse_site({"loops": [loop_entry()]}, "test").loops[TAG]
    for wish in ({"sp_deviation": 1e-12}, {"amplitude_pct": 1e-9}):
        with pytest.raises(BadLimits, match=next(iter(wish))):
            within(loop, retune_request(**wish))


_TIME = st.floats(-6.0, 8.0).map(lambda power: 10.0**power)
_GAIN = st.floats(-9.0, 9.0).map(lambda power: 10.0**power)
_MODEL = (
    st.fixed_dictionaries({"K": _GAIN, "T_s": _TIME, "L_s": _TIME | st.just(0.0)})
    | st.fixed_dictionaries({"K": _GAIN, "T1_s": _TIME, "T2_s": _TIME, "L_s": _TIME | st.just(0.0)})
    | st.fixed_dictionaries({"K": _GAIN, "T_s": _TIME, "zeta": st.floats(1e-3, 10.0), "L_s": _TIME})
    | st.fixed_dictionaries({"K": _GAIN, "L_s": _TIME, "integrating": st.just(True)})
)


@settings(max_examples=60, deadline=None, derandomize=True)
@given(_MODEL, st.sampled_from(["simc", "amigo", "lambda", "kappa-tau"]))
def test_what_is_permitted_is_answered_with_gains_or_a_reason(model: dict[str, Any], method: str) -> None:
    try:
        plant = parse_model(model)
    except BadModel:
        return
    (found,) = tune_model(plant, method)
    why = found.refusal and found.refusal.detail
    assert found.refusal is None or found.refusal.reason.value != "internal", f"{json.dumps(dump_model(plant))}: {why}"

"""Models as JSON objects: the five forms, back again, and what is said of everything else."""

from __future__ import annotations

import json
import math
from typing import Any

import numpy as np
import pytest
from pydantic import BaseModel

from loopwright.service.inputs.model_json import BadModel, describe, dump_model, form_shown, parse_model
from loopwright.tuning.models import FOPDT, SOPDT, Integrating, Model, TransferFunction

FORMS: list[tuple[dict[str, Any], Model]] = [
    ({"K": 2, "T_s": 10, "L_s": 3}, FOPDT(2.0, 10.0, 3.0)),
    ({"K": -2.5, "T_s": 10, "L_s": 0}, FOPDT(-2.5, 10.0, 0.0)),
    ({"K": 2, "T_s": 6, "zeta": 0.5, "L_s": 3}, SOPDT(2.0, 6.0, 0.5, 3.0)),
    ({"K": 0.1, "L_s": 3, "integrating": True}, Integrating(0.1, 3.0)),
    ({"K": 0.1, "L_s": 3, "integrating": True, "T_s": 5}, Integrating(0.1, 3.0, 5.0)),
    ({"num": [3, 2], "den": [3, 4, 1], "dead_time_s": 1}, TransferFunction((3.0, 2.0), (3.0, 4.0, 1.0), 1.0)),
    ({"num": [1], "den": [1, 0]}, TransferFunction((1.0,), (1.0, 0.0), 0.0)),
]


@pytest.mark.parametrize(("data", "model"), FORMS)
def test_each_form_and_back(data: dict[str, Any], model: Model) -> None:
    assert parse_model(data) == model
    assert parse_model(json.loads(json.dumps(dump_model(model)))) == model


def test_two_real_lags() -> None:
    model = parse_model({"K": 2, "T1_s": 4, "T2_s": 10, "L_s": 3})
    assert isinstance(model, SOPDT)
    w = np.array([0.01, 0.1, 1.0])
    direct = 2.0 * np.exp(-3j * w) / ((4j * w + 1.0) * (10j * w + 1.0))
    assert model.frequency_response(w) == pytest.approx(direct)
    assert parse_model(dump_model(model)) == model


def test_a_plant_file_of_rehearse() -> None:
    data = {
        "name": "heater", "num": [0.8], "den": [30, 13, 1], "dead_time_s": 2, "noise_std": 0.002, "seed": 1,
        "mv_limits": [-40, 40], "sp_deviation": 1, "sample_time_s": 0.1, "t95_s": 50, "gains": {"Kp": 1},
    }  # fmt: skip
    assert parse_model(data) == TransferFunction((0.8,), (30.0, 13.0, 1.0), 2.0)


@pytest.mark.parametrize(
    ("data", "words"),
    [
        ([1, 2], "must be a JSON object"),
        ({}, "K, T_s, L_s: missing"),
        ({"K": 2, "T_s": 10}, "L_s: missing"),
        ({"K": 2, "T_s": 10, "L_s": 3, "tau": 1}, "tau: not a quantity"),
        ({"K": 2, "T_s": 10, "T1_s": 10, "T2_s": 1, "L_s": 3}, "T_s: not a quantity"),
        ({"K": 2, "T1_s": 10, "L_s": 3}, "T2_s: missing"),
        ({"K": 2, "T_s": 10, "zeta": 1, "integrating": True, "L_s": 3}, "zeta: not a quantity"),
        ({"num": [1], "den": [1, 1], "K": 2}, "K: not a quantity"),
        ({"num": [1], "den": [1, 1], "T_s": 2}, "T_s: not a quantity"),
        ({"num": [1]}, "den: missing"),
        ({"K": 0, "T_s": 10, "L_s": 3}, "K must not be 0"),
        ({"K": math.nan, "T_s": 10, "L_s": 3}, "K must be a finite number, not nan"),
        ({"K": 2, "T_s": math.inf, "L_s": 3}, "T_s must be a finite number, not inf"),
        ({"K": 10**400, "T_s": 1, "L_s": 3}, "K must be a finite number"),
        ({"K": "2", "T_s": 10, "L_s": 3}, "K must be a finite number, not '2'"),
        ({"K": True, "T_s": 10, "L_s": 3}, "K must be a finite number, not True"),
        ({"K": 2, "T_s": -10, "L_s": 3}, "T_s must be a number > 0 (s), not -10"),
        ({"K": 2, "T_s": 0, "L_s": 3}, "T_s must be a number > 0 (s), not 0"),
        ({"K": 2, "T_s": 10, "L_s": -3}, "L_s must be a number >= 0 (s), not -3"),
        ({"K": 2, "T_s": 10, "zeta": 0, "L_s": 3}, "zeta must be a number > 0, not 0"),
        ({"K": 2, "L_s": 3, "integrating": False}, "integrating must be true"),
        ({"K": 2, "L_s": 3, "integrating": 1}, "integrating must be true"),
        ({"K": 2, "L_s": 3, "integrating": True, "T_s": -1}, "T_s must be a number >= 0 (s), not -1"),
        ({"num": 1, "den": [1, 1]}, "num must be a list of 1 to 12 numbers, not 1"),
        ({"num": [], "den": [1, 1]}, "num must be a list"),
        ({"num": [1], "den": [1] * 13}, "den must be a list"),
        ({"num": [1, None], "den": [1, 1]}, "num[1] must be a finite number, not None"),
        ({"num": [1], "den": [0, 1]}, "den must begin with"),
        ({"num": [1], "den": [2]}, "den must have a pole"),
        ({"num": [1], "den": [1, 0, 0]}, "at most one at 0"),
        ({"num": [1, 0], "den": [1, 1]}, "num must end with"),
        ({"num": [1, 1, 1], "den": [1, 1]}, "no more coefficients than den"),
        ({"num": [1], "den": [1, 1], "dead_time_s": -1}, "dead_time_s must be a number >= 0 (s), not -1"),
    ],
)
def test_everything_else_is_named(data: object, words: str) -> None:
    with pytest.raises(BadModel) as caught:
        parse_model(data)
    assert words in str(caught.value)


def test_in_words() -> None:
    assert describe({"K": 0.1, "L_s": 3.0, "integrating": True}) == "integrating, K 0.1, L 3 s"
    assert describe(dump_model(SOPDT(K=2.0, T1=4.0, T2=10.0, L=3.0))) == "K 2, T1 10 s, T2 4 s, L 3 s"
    assert describe(dump_model(SOPDT(2.0, 4.0, 0.5, 3.0))) == "K 2, T 4 s, zeta 0.5, L 3 s"
    assert describe({"num": [2.0], "den": [10.0, 1.0], "dead_time_s": 3.0}) == "num [2], den [10, 1], dead time 3 s"


def test_what_a_fit_has_found_is_shown_also_where_nobody_could_type_it() -> None:
    found = dump_model(TransferFunction((1e-12, 2.0), (1e-9, 10.0, 1.0), 3.0))
    with pytest.raises(BadModel):
        parse_model(found)
    shown = form_shown(found)
    assert isinstance(shown, BaseModel) and shown.model_dump() == found
    integrating = dump_model(Integrating(1e-30, 1e12))
    shown = form_shown(integrating)
    assert isinstance(shown, BaseModel) and shown.model_dump() == integrating


@pytest.mark.parametrize(
    "data",
    [{"K": 1, "T1_s": 1e300, "T2_s": 1e300, "L_s": 1}, {"K": 1, "T1_s": 1e-200, "T2_s": 1e-200, "L_s": 1}],
)
def test_times_whose_product_no_number_holds(data: dict[str, Any]) -> None:
    with pytest.raises(BadModel, match=r"T1_s 1e.* s is not plausible; permitted are 1e-06 to 1e\+08 s"):
        parse_model(data)

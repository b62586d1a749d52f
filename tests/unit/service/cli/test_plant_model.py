"""`loopwright plant --model` with a user's own plant."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import typer

from loopwright.plantsim.own_plant import own_plant
from loopwright.service.cli.plant_model import with_own_plants

HEATER = {"K": 0.8, "T_s": 120, "L_s": 15, "mv": 40, "pv": 65}


def model_of(*arguments: str) -> str:
    found = with_own_plants(["--bus", "virtual:x", *arguments, "--ts", "1"])
    assert found[:3] == ["--bus", "virtual:x", "--model"] and found[4:] == ["--ts", "1"]
    return found[3]


def test_a_name_of_the_catalogue_stays() -> None:
    assert model_of("--model", "model-4") == model_of("--model=model-4") == "model-4"


def test_a_model_of_any_form_runs_at_its_operating_point(tmp_path: Path) -> None:
    file = tmp_path / "heater.json"
    file.write_text(json.dumps(HEATER))
    given = model_of("--model", json.dumps(HEATER))
    assert given == model_of(f"--model={json.dumps(HEATER)}") == model_of("--model", str(file))
    entry = own_plant(given)
    assert entry.facts.mv_nominal_pct == 40.0 and entry.facts.reverse
    plant = entry.build(1.0)
    assert [plant.step(40.0) for _ in range(50)][-1] == pytest.approx(65.0)
    answer = [plant.step(50.0) for _ in range(1500)]
    assert answer[13] == pytest.approx(65.0) and answer[-1] == pytest.approx(65.0 + 10 * 0.8, abs=1e-3)


def test_what_a_plant_has_besides_reaches_the_plant_process() -> None:
    more = {"second_path": {"share": 0.4, "later_s": 180}, "valve": {"backlash_pct": 2}}
    plant = own_plant(model_of("--model", json.dumps(HEATER | more))).build(1.0)
    answer = [plant.step(50.0) for _ in range(3000)]
    assert answer[-1] == pytest.approx(65.0 + 1.4 * 9.0 * 0.8, abs=1e-3)


@pytest.mark.parametrize("given", ['{"K": 0.8, "tau": 120, "L_s": 15}', "{", "[]{}", '{"K": 0, "T_s": 1, "L_s": 1}'])
def test_what_is_no_model_is_refused_in_words(given: str, capsys: pytest.CaptureFixture[str]) -> None:
    if not given.startswith("{"):
        assert model_of("--model", given) == given  # perhaps a name: the plant process says which there are
        return
    with pytest.raises(typer.Exit) as caught:
        model_of("--model", given)
    assert caught.value.exit_code == 2 and "--model: " in capsys.readouterr().err


@pytest.mark.parametrize("text", ["{}", '{"num": [1]}', '{"num": [1], "den": [1, 1], "colour": 1}',
                                  '{"num": [1], "den": [1, 1], "mv": 140}', '{"num": [], "den": [1]}',
                                  '{"num": [1], "den": [0]}'])  # fmt: skip
def test_the_plant_process_refuses_what_is_no_plant(text: str) -> None:
    with pytest.raises(ValueError, match=r"a plant is a JSON object|MV is in percent|need coefficients"):
        own_plant(text)

"""`loopwright methods`, `tune` and `identify`: what they answer, and what they say of bad input."""

from __future__ import annotations

import json
import math
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner, Result

from loopwright.plantsim.plant import LinearPlant
from loopwright.service.cli.main import app
from loopwright.tuning.analysis.margins import margins
from loopwright.tuning.fast.known_plant.tuned import METHODS
from loopwright.tuning.gains import Gains
from loopwright.tuning.models import Reals, TransferFunction
from loopwright.tuning.reasons import Reason
from tests.rehearsal.test_observe import LAG, PI, TS, changes, operated
from tests.unit.service.cli.columns import columns

MODELS = {
    "lag-dominant": '{"K": 2, "T_s": 50, "L_s": 2}',
    "balanced": '{"K": 2, "T_s": 10, "L_s": 8}',
    "delay-dominant": '{"K": 1, "T_s": 2, "L_s": 10}',
    "second-order": '{"K": 2, "T1_s": 10, "T2_s": 4, "L_s": 3}',
    "integrating": '{"K": 0.1, "L_s": 3, "integrating": true}',
    "inverse-response": '{"num": [-2, 1], "den": [15, 8, 1], "dead_time_s": 1}',
}
SELF_REGULATING_ONLY = {"cohen-coon", "chr", "kappa-tau", "direct-synthesis", "robust"}


def run(*arguments: str) -> Result:
    return CliRunner().invoke(app, list(arguments))


def answer(*arguments: str) -> dict[str, Any]:
    """Of a command with --json: strict JSON and nothing else on standard output."""
    result = run(*arguments, "--json")
    assert result.exit_code == 0, result.output
    return strict(result.stdout)


def strict(text: str) -> Any:
    def no(constant: str) -> None:
        raise AssertionError(f"{constant} is not JSON")

    return json.loads(text, parse_constant=no)


@pytest.mark.parametrize("width", [88, 60, 44])
def test_a_narrow_terminal_leaves_figures_out_and_cuts_none(monkeypatch: pytest.MonkeyPatch, width: int) -> None:
    columns(monkeypatch, width)
    model = '{"K": -1e-9, "T_s": 3e-6, "L_s": 1e-6}'
    rows = run("tune", "--model", model).stdout.split("Controller Kp")[0].splitlines()[1:]
    assert max(map(len, rows)) <= width and not any("…" in row for row in rows)
    simc = next(row.split() for row in rows if row.startswith("simc "))
    assert simc[1:4] == ["1.5e+09", "3e-06", "0"] and simc[4 if width < 60 else 5] == "1.59"
    said = " ".join(" ".join(rows).split())
    assert "A wider terminal, and --json, also show" in said and "IAE SP" in said
    assert run("tune", "--model", MODELS["lag-dominant"]).stdout.count("A wider terminal") == (width < 88)


@pytest.mark.parametrize("model", MODELS.values(), ids=MODELS)
def test_all_methods_on_six_models(model: str) -> None:
    found = answer("tune", "--model", model)
    assert [each["method"] for each in found["methods"]] == list(METHODS)
    tuned = [each for each in found["methods"] if each["outcome"] == "tuned"]
    refused = {each["method"] for each in found["methods"] if each["outcome"] == "refused"}
    assert len(tuned) >= 9
    for each in tuned:
        gains, margins = each["gains"], each["margins"]
        assert each["reason"] is None and gains["form"] == "ISA" and gains["Kp"] > 0.0
        assert each["parallel"]["Ki"] == pytest.approx(gains["Kp"] / gains["Ti"])
        assert each["parallel"]["Kd"] == pytest.approx(gains["Kp"] * gains["Td"])
        # realisable: no derivative without its filter, none on the set-point
        assert gains["Td"] == 0.0 or (gains["Tf"] > 0.0 and gains["c"] == 0.0)
        assert margins["stable"] is True
        # |1/S| >= 1/Ms on the circle: the classical bounds on both margins
        assert margins["PM_deg"] >= 2.0 * math.degrees(math.asin(0.5 / margins["Ms"])) - 1e-6
        assert margins["GM"] is None or margins["GM"] >= margins["Ms"] / (margins["Ms"] - 1.0) - 1e-6
        for figures in (each["setpoint"], each["load"]):
            assert figures["IAE"] > 0.0 and figures["settling_s"] > 0.0 and figures["TV"] > 0.0
        # the load's error integrates to Ti/Kp, and its size to no less
        assert each["load"]["IAE"] >= 0.999 * gains["Ti"] / gains["Kp"]
    for each in found["methods"]:
        if each["outcome"] == "refused":
            assert Reason(each["reason"]) and each["detail"] and each["advice"]
            assert each["gains"] is None and each["margins"] is None and each["setpoint"] is None
    if "integrating" in model:
        assert refused >= SELF_REGULATING_ONLY
    else:
        assert {"simc", "robust", "me-pso"}.isdisjoint(refused)


def test_one_method_by_its_equation() -> None:
    found = answer("tune", "--model", MODELS["balanced"], "--method", "simc", "--option", "tau_c_s=4")
    (simc,) = found["methods"]
    # Kp = T/(K (tau_c + L)), Ti = min(T, 4 (tau_c + L))
    assert simc["gains"]["Kp"] == pytest.approx(10.0 / (2.0 * 12.0)) and simc["gains"]["Ti"] == 10.0
    assert simc["design"]["tau_c_s"] == 4.0
    # pole and zero cancel: the loop is k e^(-Ls)/s with k = 1/12, of known margins
    assert simc["margins"]["GM"] == pytest.approx(math.pi / 2 * 12.0 / 8.0, rel=1e-6)
    assert simc["margins"]["PM_deg"] == pytest.approx(90.0 - math.degrees(8.0 / 12.0), rel=1e-6)
    assert found["model"] == {"K": 2.0, "T_s": 10.0, "L_s": 8.0}
    assert found["units"]["Kp"] == "MV per PV unit" and "ISA" in found["form"] and "filter" in found["figures_are"]


def test_options_go_to_the_methods_that_have_them() -> None:
    found = answer("tune", "--model", MODELS["balanced"], "--option", "Ms=2.0")
    by_name = {each["method"]: each for each in found["methods"]}
    alone = answer("tune", "--model", MODELS["balanced"], "--method", "kappa-tau", "--option", "Ms=2.0")
    assert by_name["kappa-tau"] == alone["methods"][0]
    assert by_name["kappa-tau"] != answer("tune", "--model", MODELS["balanced"], "--method", "kappa-tau")["methods"][0]


@pytest.mark.parametrize(
    ("option", "method"),
    [
        ("variant=2.2", "tyreus-luyben"),
        ("overshoot_pct=20", "chr"),
        ("extrapolate=true", "zn-step"),
        ("seed=3", "me-pso"),
    ],
)
def test_values_of_every_kind(option: str, method: str) -> None:
    found = answer("tune", "--model", MODELS["balanced"], "--method", method, "--option", option)
    assert found["methods"][0]["outcome"] == "tuned"


def test_a_model_from_a_plant_file(tmp_path: Path) -> None:
    file = tmp_path / "plant.json"
    file.write_text('{"name": "heater", "num": [0.8], "den": [13, 1], "dead_time_s": 2, "noise_std": 0.002}')
    found = answer("tune", "--model", str(file), "--method", "amigo")
    assert found["model"] == {"num": [0.8], "den": [13.0, 1.0], "dead_time_s": 2.0}
    assert found["methods"] == answer("tune", "--model", '{"K":0.8,"T_s":13,"L_s":2}', "--method", "amigo")["methods"]


def test_an_unstable_loop_is_said_to_be_one() -> None:
    model = {"num": [1.5, -2.5, 1.0], "den": [15.0, 23.0, 9.0, 1.0]}
    arguments = ("tune", "--model", json.dumps(model), "--method", "direct-synthesis", "--option")
    for c, stable in (("0.3679", True), ("1.4", False)):
        (found,) = answer(*arguments, f"c={c}")["methods"]
        g = found["gains"]
        # the roots of 1 + C G, C = Kp (1 + 1/(Ti s) + Td s/(1 + Tf s))
        over = g["Kp"] * np.array([g["Ti"] * (g["Td"] + g["Tf"]), g["Ti"] + g["Tf"], 1.0])
        under = g["Ti"] * np.array([g["Tf"], 1.0, 0.0])
        roots = np.roots(np.polyadd(np.polymul(over, model["num"]), np.polymul(under, model["den"])))
        assert (roots.real.max() < 0.0) == stable == found["margins"]["stable"]
        assert (found["setpoint"] is not None) == (found["load"] is not None) == stable
        assert any("unstable" in note for note in found["notes"]) != stable
        assert ("direct-synthesis" in run(*arguments, f"c={c}").stdout.split("Controller Kp")[0]) is True
        assert ("unstable" in run(*arguments, f"c={c}").stdout) != stable
    assert {value for name, value in found["margins"].items() if name != "stable"} == {None}


def test_the_table_names_methods_and_refusals() -> None:
    result = run("tune", "--model", MODELS["integrating"])
    assert result.exit_code == 0
    rows, refusals = result.stdout.split("Refused:")
    for name in METHODS:
        refused = name in SELF_REGULATING_ONLY | {"s-plane"}
        assert any(line.removeprefix("* ").startswith(f"{name} ") for line in rows.splitlines()) != refused, name
        assert (re.search(rf"(?<!\S){name}(,| )", refusals.split("Notes:")[0]) is not None) == refused, name
    assert "not_self_regulating" in refusals and "MV/PV" in rows


def test_refusals_of_one_reason_are_said_once() -> None:
    refusals = run("tune", "--model", MODELS["integrating"]).stdout.split("Refused:")[1]
    assert refusals.count("not_self_regulating") == 1 and "what each takes: `loopwright methods`" in " ".join(
        refusals.split()
    )


def test_a_controller_that_acts_directly_is_said_to_do_so() -> None:
    said = "The plant's gain is negative: the controller acts directly."
    assert said in run("tune", "--model", '{"K": -2, "T_s": 10, "L_s": 8}', "--method", "simc").stdout
    assert said in run("tune", "--model", '{"K": -2, "L_s": 8, "integrating": true}', "--method", "simc").stdout
    assert said not in run("tune", "--model", MODELS["balanced"], "--method", "simc").stdout


def test_one_method_is_recommended_with_its_reason() -> None:
    found = answer("tune", "--model", MODELS["balanced"])
    robust = {e["method"]: e for e in found["methods"] if e["outcome"] == "tuned" and e["margins"]["Ms"] <= 1.7}
    best = [min(each[part]["IAE"] for each in robust.values()) for part in ("setpoint", "load")]
    chosen = robust[found["recommended"]["method"]]
    total = chosen["setpoint"]["IAE"] / best[0] + chosen["load"]["IAE"] / best[1]
    assert all(e["setpoint"]["IAE"] / best[0] + e["load"]["IAE"] / best[1] >= total for e in robust.values())
    assert f"of the {len(robust)} methods with Ms at most 1.7" in found["recommended"]["reason"]
    shown = run("tune", "--model", MODELS["balanced"]).stdout
    assert f"* {chosen['method']} is recommended" in shown
    # there is nothing to recommend among one
    assert answer("tune", "--model", MODELS["balanced"], "--method", "simc")["recommended"] is None


@pytest.mark.parametrize(
    ("arguments", "headings", "row"),
    [
        ([], "Kp Ti Td", "0.417 10 0"),
        (["--minutes"], "Kp Ti Td", "0.417 0.167 0"),
        (["--pv-span", "200"], "Kp Ti Td", "0.833 10 0"),
        (["--form", "parallel"], "Kp Ki Kd", "0.417 0.0417 0"),
        (["--form", "series"], "Kp Ti Td", "0.417 10 0"),
        (["--form", "pb", "--pv-span", "200"], "PB Ti Td", "120 10 0"),
        (["--form", "repeats"], "Kp Ri Td", "0.417 6 0"),
    ],
)
def test_gains_as_a_faceplate_has_them(arguments: list[str], headings: str, row: str) -> None:
    # simc with tau_c 4: Kp = 10/(2 * 12) = 0.417 MV per PV unit, Ti = 10 s
    shown = run("tune", "--model", MODELS["balanced"], "--method", "simc", "--option", "tau_c_s=4", *arguments).stdout
    lines = [" ".join(line.split()) for line in shown.splitlines()]
    assert lines[1].startswith(headings) and any(line.startswith(f"simc {row} ") for line in lines), shown


def test_exit_status_3_when_no_method_gave_gains() -> None:
    result = run("tune", "--model", MODELS["integrating"], "--method", "robust", "--json")
    assert result.exit_code == 3
    (found,) = strict(result.stdout)["methods"]
    assert (found["outcome"], found["reason"]) == ("refused", "not_self_regulating")


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--model", "{"], "--model: not JSON"),
        (["--model", MODELS["balanced"], "--form", "pb"], "give --pv-span, such as 200 for 0..200"),
        (["--model", MODELS["balanced"], "--pv-span", "0"], "--pv-span is the span of PV in PV units, greater than 0"),
        (["--model", MODELS["balanced"], "--mv-span", "-1"], "--mv-span is the span of MV in MV units, greater than 0"),
        (["--model", MODELS["balanced"], "--minutes", "--json"], "--form, --pv-span and --minutes"),
        (["--model", '{"K": 2}'], "T_s, L_s: missing"),
        (["--model", '{"K": NaN, "T_s": 1, "L_s": 1}'], "--model: K: NaN, Infinity and what is beyond"),
        (["--model", '{"K": 2, "T_s": -1, "L_s": 1}'], "T_s must be a number > 0 (s), not -1"),
        (["--model", '{"K": 2, "T_s": 1, "L_s": 1, "x": 1}'], "x: not a quantity"),
        (["--model", "/nowhere/plant.json"], "No such file"),
        (["--model", "[1]"], "--model: expected one JSON object"),
        (["--model", MODELS["balanced"], "--method", "magic"], "method must be one of zn-ultimate"),
        (
            ["--model", MODELS["balanced"], "--method", "simc", "--option", "lambda_s=1"],
            "simc has no option 'lambda_s'",
        ),
        (["--model", MODELS["balanced"], "--option", "nothing=1"], "no method has an option 'nothing'"),
        (["--model", MODELS["balanced"], "--method", "simc", "--option", "tau_c_s"], "NAME=VALUE"),
        (["--model", MODELS["balanced"], "--method", "simc", "--option", "tau_c_s=-1"], "tau_c_s must be"),
        (["--model", MODELS["balanced"], "--method", "simc", "--option", "tau_c_s=nan"], "tau_c_s must be"),
        (["--model", MODELS["balanced"], "--method", "simc", "--option", "controller=x"], "controller must be one of"),
        (["--model", MODELS["balanced"], "--method", "simc", "--plot", "picture.gif"], "--plot must end in .png"),
        (["--model", MODELS["balanced"], "--method", "simc", "--plot", "/nowhere/x.png"], "No such file"),
    ],
)
def test_bad_input_of_tune(arguments: list[str], words: str) -> None:
    result = run("tune", *arguments)
    assert result.exit_code == 2 and result.stdout == ""
    assert result.stderr.startswith("loopwright: ") and words in result.stderr


def test_a_picture_of_the_tuned_methods(tmp_path: Path) -> None:
    file = tmp_path / "picture.svg"
    assert run("tune", "--model", MODELS["integrating"], "--plot", str(file)).exit_code == 0
    drawn = file.read_text()
    # matplotlib leaves each text in a comment: those at the lines, and those of the grey ones above
    texts = re.findall(r"<!-- (.*?) -->", drawn)
    grey = next(text for text in texts if text.startswith("grey: "))[6:].split(", ")
    for name in METHODS:
        assert (name in texts or name in grey) == (name not in SELF_REGULATING_ONLY | {"s-plane"})
    assert len({name for name in METHODS if name in texts}) == 4
    assert "<!-- time since the step, s -->" in drawn and "<!-- change of MV, MV units -->" in drawn


def test_methods() -> None:
    result = run("methods", "--json")
    found = strict(result.stdout)
    assert [each["method"] for each in found] == list(METHODS)
    assert found[-2]["options"]["seed"]["kind"] == "whole" and "Ms" in found[-1]["options"]
    told = run("methods").stdout
    assert all(name in told for name in METHODS)


@pytest.fixture(scope="module")
def record(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """600 samples of (0.4 s) steps of MV on 2 e^(-3s)/((10s + 1)(4s + 1)), by the exact simulator."""
    plant = LinearPlant([2.0], [40.0, 14.0, 1.0], 3.0, 0.4, noise_std=0.02, seed=3, mv_low=-50.0, mv_high=50.0)
    lines, pv = ["t,u,y,operator"], plant.pv
    for k in range(600):
        move = 0.0 if k < 20 else 5.0 if k < 250 else -3.0
        lines.append(f"{0.4 * k:.3f},{50.0 + move},{20.0 + pv:.6f},A")
        pv = plant.step(move)
    file = tmp_path_factory.mktemp("records") / "steps.csv"
    file.write_text("\n".join(lines) + "\n")
    return file


def test_identify_finds_the_plant(record: Path, tmp_path: Path) -> None:
    picture = tmp_path / "fit.png"
    found = answer("identify", str(record), "--plot", str(picture))
    truth = {"K": 2.0, "T_s": math.sqrt(40.0), "zeta": 14.0 / (2.0 * math.sqrt(40.0)), "L_s": 3.0}
    for name, value in truth.items():
        assert abs(found["model"][name] - value) < 4.0 * found["standard_errors"][name]
        assert found["standard_errors"][name] < 0.02 * value
    assert found["outcome"] == "identified" and found["fit_pct"] > 99.0 and found["record"]["samples"] == 600
    assert [each["structure"] for each in found["candidates"] if each["chosen"]] == ["sopdt"]
    assert picture.read_bytes().startswith(b"\x89PNG")
    # what it found is what tune takes
    assert answer("tune", "--model", json.dumps(found["model"]), "--method", "simc")["methods"][0]["outcome"] == "tuned"


def test_identify_finds_an_inverse_response_and_a_load(tmp_path: Path) -> None:
    plant = LinearPlant([-2.0, 1.0], [20.0, 9.0, 1.0], 1.0, 0.1, noise_std=0.02, seed=3, mv_low=-50.0, mv_high=50.0)
    lines, pv = ["t,u,y"], plant.pv
    for k in range(600):
        move = 2.0 * (k >= 50)
        plant.disturbance = 0.6 * (k >= 360)
        lines.append(f"{0.1 * k:.3f},{50.0 + move},{20.0 + pv:.6f}")
        pv = plant.step(move)
    file, picture = tmp_path / "load.csv", tmp_path / "fit.svg"
    file.write_text("\n".join(lines) + "\n")
    found = answer("identify", str(file), "--plot", str(picture))
    assert set(found["model"]) == {"num", "den", "dead_time_s"}
    assert list(found["parameters"]) == list(found["standard_errors"])
    for row, error in zip(enumerate(found["covariance"]), found["standard_errors"].values(), strict=True):
        assert math.sqrt(row[1][row[0]]) == pytest.approx(error)
    (load,) = found["loads"]
    assert load["t_s"] == pytest.approx(36.0, rel=0.1) and load["size"] == pytest.approx(0.6, rel=0.1)
    assert "load disturbance" in picture.read_text()
    told = run("identify", str(file)).stdout
    assert "den[0]" in told and "a load" in told and "load disturbance" in told
    assert answer("tune", "--model", json.dumps(found["model"]), "--method", "simc")["methods"][0]["outcome"] == "tuned"


def logged(file: Path, sp: Reals) -> Path:
    """The file of a historian, of a loop whose set-point moved so."""
    heard = operated(LAG, PI, sp)
    rows = zip(TS * np.arange(len(sp)), heard.sp, heard.pv, heard.mv, strict=True)
    file.write_text("time,SP,PV,MV\n" + "".join(f"{t:.1f},{sp:g},{pv:.4f},{mv:.4f}\n" for t, sp, pv, mv in rows))
    return file


def test_identify_of_normal_operation(tmp_path: Path) -> None:
    file = logged(tmp_path / "operation.csv", changes([0.8, -0.3, 0.6], 200.0))
    found = answer("identify", str(file), "--closed-loop", "--kp", "1", "--ti", "9")
    assert found["state"] == "proposal" and len(found["changes_used"]) == 3
    proposed = found["proposed"]["gains"]
    true = TransferFunction(LAG.num, LAG.den, LAG.L + 0.5 * TS)
    assert margins(true, Gains(proposed["Kp"], proposed["Ti"])).Ms == pytest.approx(1.6, abs=0.05)
    shown = run("identify", str(file), "--closed-loop", "--kp", "1", "--ti", "9")
    assert shown.exit_code == 0 and "from 3 set-point changes" in shown.stdout and "dead time" in shown.stdout
    wrong = run("identify", str(file), "--closed-loop", "--kp", "2", "--ti", "9")
    assert wrong.exit_code == 2 and "0.5 times as far" in wrong.stderr
    for given, said in (
        (["--closed-loop"], f"then: loopwright identify {file} --kp 1 --ti 9\n"),
        (["--ti", "9"], f"then: loopwright identify {file} --kp 1 --ti 9\n"),
        (["--closed-loop", "--kp", "1", "--plot", "x.png"], "neither"),
        (["--kp", "0"], "must be positive"),
        (["--closed-loop", "--kp", "1", "--ti", "-3"], "at least 0"),
        (["--closed-loop", "--kp", "1", "--ti", "9", "--ms", "0.9"], "--ms: "),
    ):
        refused = run("identify", str(file), *given)
        assert refused.exit_code == 2 and said in refused.stderr, (given, refused.stderr)
    driven = logged(tmp_path / "driven.csv", np.sin(np.arange(2000) / 200.0))
    refused = run("identify", str(driven), "--closed-loop", "--kp", "1", "--ti", "9")
    assert refused.exit_code == 3 and "another controller drives it" in refused.stderr


def test_identify_on_a_terminal(record: Path) -> None:
    result = run("identify", str(record))
    assert result.exit_code == 0
    assert "zeta" in result.stdout and "standard error" in result.stdout and "sopdt" in result.stdout
    model = json.loads(result.stdout.split("--model`: ")[1].splitlines()[0])
    assert model == answer("identify", str(record))["model"]


def test_identify_without_an_answer_in_pv(tmp_path: Path) -> None:
    plant = LinearPlant([1e-6], [1.0, 1.0], 1.0, 0.5, noise_std=1.0, seed=1, mv_low=-50.0, mv_high=50.0)
    lines = ["t,u,y"] + [f"{0.5 * k},{5.0 * (k > 20)},{plant.step(5.0 * (k > 20))}" for k in range(200)]
    file = tmp_path / "noise.csv"
    file.write_text("\n".join(lines))
    result = run("identify", str(file), "--json")
    assert result.exit_code == 3
    found = strict(result.stdout)
    assert (found["outcome"], found["reason"], found["model"]) == ("refused", "no_response", None)
    assert "no_response" in run("identify", str(file)).stdout


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "is empty"),
        ("t,u\n0,1\n", "no column for PV"),
        ("t,u,y\n0,1,x\n", "line 2: y is not a number"),
        ("t,u,y\n" + "".join(f"{k},5,{k % 3}\n" for k in range(50)), "u"),
        ("t,u,y\n0,1,2\n1,1,2\n", "too few samples: 2"),
    ],
)
def test_bad_records(tmp_path: Path, text: str, words: str) -> None:
    file = tmp_path / "data.csv"
    file.write_text(text)
    result = run("identify", str(file))
    # what was read is said before what is wrong with it
    assert result.exit_code == 2
    assert result.stdout == "" or (result.stdout.count("\n") == 1 and "; MV" in result.stdout)
    assert str(file) in result.stderr and words in result.stderr


def test_identify_goes_on_to_gains(record: Path) -> None:
    found = answer("identify", str(record), "--tune")
    assert found["tunings"] == answer("tune", "--model", json.dumps(found["model"]))
    shown = run("identify", str(record), "--tune").stdout
    assert shown.startswith("600 samples every 0.4 s, 4.0\u202fmin; MV 47..55, PV ")
    assert shown.index("standard error") < shown.index("MV/PV")
    no_test = run("identify", str(record), "--tune", "--kp", "1")
    assert no_test.exit_code == 2 and "no column of SP" in no_test.stderr


def test_identify_asks_whether_columns_are_swapped(record: Path) -> None:
    swapped = run("identify", str(record), "--u", "y")
    assert swapped.exit_code == 2 and "more than one quantity" in swapped.stderr
    file = record.with_name("swapped.csv")
    file.write_text(record.read_text().replace("t,u,y", "t,y,u"))
    asked = run("identify", str(file))
    assert asked.exit_code == 2 and 'Say which is which: --u "y" --y "u"' in asked.stderr
    assert answer("identify", str(file), "--u", "y", "--y", "u")["model"] == answer("identify", str(record))["model"]
    # who says it is not asked, and hears of it
    said = run("identify", str(file), "--u", "u", "--y", "y")
    assert "are the columns swapped?" in said.stderr
    # what is called MV there moves at every sample, as that of a loop in automatic
    assert said.exit_code == 2 and "MV has many values" in said.stderr
    assert "swapped" not in run("identify", str(record), "--u", "u", "--y", "y").stderr


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--resample", "5 days"], "--resample: a time such as 5s, 500ms or 1min is expected, not '5 days'"),
        (["--u", "valve"], "--u: no column 'valve'; there are: t, u, y, operator"),
        (["--time-format", "%H:%M"], "600 values of t are no times of the form '%H:%M', such as '0.000'"),
    ],
)
def test_identify_of_a_file_that_is_read_otherwise(record: Path, arguments: list[str], words: str) -> None:
    result = run("identify", str(record), *arguments)
    assert result.exit_code == 2 and words in result.stderr and result.stdout == ""


def test_identify_of_no_file() -> None:
    result = run("identify", "/nowhere/data.csv")
    assert result.exit_code == 2 and "No such file" in result.stderr


def test_tune_imports_nothing_that_it_does_not_use() -> None:
    code = (
        "import sys; from loopwright.service.cli.main import app\n"
        "try: app(['tune', '--method', 'simc', '--json', '--model', sys.argv[1]])\n"
        "except SystemExit as end: assert not end.code\n"
        "print(*sys.modules, file=sys.stderr)"
    )
    ran = subprocess.run([sys.executable, "-c", code, MODELS["balanced"]], capture_output=True, text=True, check=True)
    loaded = set(ran.stderr.split())
    assert "loopwright.tuning.rules.registry" in loaded
    heavy = {"fastapi", "sqlalchemy", "matplotlib", "httpx", "can", "scipy.signal", "scipy.stats"}
    assert loaded.isdisjoint(heavy), loaded & heavy


@pytest.mark.parametrize("command", [["tune", "--model"], ["rehearse"]])
def test_a_plant_file_with_a_key_twice_is_refused(tmp_path: Path, command: list[str]) -> None:
    file = tmp_path / "plant.json"
    file.write_text('{"num": [1], "den": [3, 1], "dead_time_s": 1, "gains": {"Kp": 1, "Kp": 2}}')
    result = run(*command, str(file))
    assert result.exit_code == 2 and result.stdout == ""
    assert result.stderr == f"loopwright: {file}: gains.Kp: this key is given twice: leave one of them out\n"


def test_an_output_that_takes_nothing_is_said_in_a_sentence() -> None:
    with Path("/dev/full").open("w") as full:
        ended = subprocess.run(
            [sys.executable, "-m", "loopwright.service", "methods"], stdout=full, stderr=subprocess.PIPE, text=True
        )
    assert ended.returncode == 1 and ended.stderr == "loopwright: [Errno 28] No space left on device\n"

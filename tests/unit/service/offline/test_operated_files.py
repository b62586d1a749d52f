"""`loopwright identify` of what systems write of a loop in automatic: never a model that is not the plant's."""

from __future__ import annotations

import json
import shlex
from pathlib import Path
from typing import Any

import pytest
from click.testing import Result
from typer.testing import CliRunner

from loopwright.service.cli.main import app
from loopwright.tuning.analysis.margins import margins
from loopwright.tuning.gains import Gains
from loopwright.tuning.models import FOPDT
from tests.unit.service.offline.exported_files import KP, TI, TS, ExportedFile, K, L, T, files_of, operated

QUIET, LOADED = files_of(*operated(0.0)), files_of(*operated(2.0))
WITH_SP = ("scada", "logger")
SOME = (*WITH_SP, "dcs", "spreadsheet", "uneven")
"""A load makes the search long, so that not all systems' files are tried with one."""
TRUE = FOPDT(K, T, L + 0.5 * TS)
"""The heater as a controller that samples it meets it."""


def identify(file: ExportedFile, folder: Path, *options: str) -> Result:
    (folder / "data.csv").write_bytes(file.content)
    return CliRunner().invoke(app, ["identify", str(folder / "data.csv"), *file.arguments, *options])


def answer(result: Result) -> dict[str, Any]:
    found: dict[str, Any] = json.loads(result.stdout)
    return found


def command(result: Result) -> list[str]:
    """The words after `loopwright` of the command that the message gives."""
    line = result.stderr.split(": loopwright ")[1].split(" (Kp ")[0].strip()
    return shlex.split(line)


@pytest.mark.parametrize("name", SOME)
def test_a_loop_in_automatic_under_a_load_is_not_taken_for_a_test(name: str, tmp_path: Path) -> None:
    asked = identify(LOADED[name], tmp_path, "--tune", "--json")
    assert asked.exit_code == 2 and asked.stdout == ""
    typed = command(asked)
    assert typed[:2] == ["identify", str(tmp_path / "data.csv")]
    assert {"--kp", "--ti", "--tune", "--json", *LOADED[name].arguments} <= set(typed)
    assert ("--sp" in typed) is (name not in WITH_SP)


@pytest.mark.parametrize("name", QUIET)
def test_one_without_a_load_is_identified_as_it_is(name: str, tmp_path: Path) -> None:
    result = identify(QUIET[name], tmp_path, "--json")
    assert result.exit_code == 0, result.output
    found = answer(result)
    for parameter, true in (("K", K), ("T_s", T), ("L_s", L)):
        error = found["standard_errors"][parameter]
        assert abs(found["model"][parameter] - true) < 3.0 * error < 0.1 * true
    assert "as in automatic" in found["notes"][0]
    assert "the model explains PV to white noise" in found["notes"][0]


@pytest.mark.parametrize("name", WITH_SP)
def test_the_gains_alone_say_that_the_loop_was_in_automatic(name: str, tmp_path: Path) -> None:
    found = answer(identify(QUIET[name], tmp_path, "--kp", str(KP), "--ti", str(TI), "--json", "--tune"))
    assert found["state"] == "proposal" and len(found["changes_used"]) == 4
    gains = found["proposed"]["gains"]
    assert margins(TRUE, Gains(gains["Kp"], gains["Ti"])).Ms == pytest.approx(1.6, abs=0.06)
    assert {each["method"] for each in found["tunings"]["methods"]} > {"simc", "lambda"}


def test_the_command_in_the_message_can_be_copied(tmp_path: Path) -> None:
    typed = command(identify(LOADED["scada"], tmp_path))
    gains = dict(zip(typed[2::2], map(float, typed[3::2]), strict=True))
    assert gains["--kp"] == pytest.approx(KP, rel=0.02) and gains["--ti"] == pytest.approx(TI, rel=0.02)
    copied = CliRunner().invoke(app, [*typed, "--json"])
    # so large a load leaves Ms unknown, and then nothing is proposed
    assert copied.exit_code == 3 and answer(copied)["state"] == "missing"


def test_whose_set_point_rests_tells_nothing(tmp_path: Path) -> None:
    lines = LOADED["scada"].content.decode("utf-16").splitlines(keepends=True)
    rests = ExportedFile("rests", "".join([lines[0], *lines[20:180]]).encode("utf-16"))
    asked = identify(rests, tmp_path)
    assert asked.exit_code == 2
    assert "MV follows PV, as in automatic, and SP rests" in asked.stderr
    assert "take a time in which operators moved SP" in asked.stderr


def test_a_set_point_without_values_is_asked_for(tmp_path: Path) -> None:
    lines = LOADED["scada"].content.decode("utf-16").splitlines(keepends=True)
    lines = [lines[0], *("\t".join([line.split("\t")[0], "Bad", *line.split("\t")[2:]]) for line in lines[1:])]
    without = ExportedFile("without", "".join(lines).encode("utf-16"))
    asked = identify(without, tmp_path, "--kp", str(KP), "--ti", str(TI))
    assert asked.exit_code == 2 and "the column of SP (TIC101.SP) lacks too many values" in asked.stderr
    assert "export SP with it" in asked.stderr


def test_who_says_that_the_loop_was_open_is_not_asked(tmp_path: Path) -> None:
    said = identify(LOADED["plain"], tmp_path, "--open-loop", "--json")
    assert said.exit_code == 0 and answer(said)["explained"] is False
    both = identify(LOADED["scada"], tmp_path, "--open-loop", "--kp", "4")
    assert both.exit_code == 2 and "exclude each other" in both.stderr


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (("--closed-loop",), "SP moves 4 times and MV follows SP and PV by Kp "),
        (("--ti", "100"), "--ti 99."),
        (("--td", "3"), "--td 3 --kp "),
    ],
)
def test_what_is_missing_beside_options_of_a_loop_in_automatic(
    options: tuple[str, ...], said: str, tmp_path: Path
) -> None:
    asked = identify(LOADED["scada"], tmp_path, *options)
    assert asked.exit_code == 2 and said in asked.stderr and asked.stderr.count("--ti") == 1

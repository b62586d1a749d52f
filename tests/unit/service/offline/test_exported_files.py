"""`loopwright identify` of the files that twelve systems write of one test."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from loopwright.service.cli.main import app
from tests.unit.service.offline.exported_files import FILES, SAMPLES, K, L, T


def identified(tmp_path: Path, name: str) -> dict[str, Any]:
    file = tmp_path / f"{name}.csv"
    file.write_bytes(FILES[name].content)
    result = CliRunner().invoke(app, ["identify", str(file), *FILES[name].arguments, "--json"])
    assert result.exit_code == 0, result.output
    found: dict[str, Any] = json.loads(result.stdout)
    return found


@pytest.fixture(scope="module")
def plain(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    return identified(tmp_path_factory.mktemp("plain"), "plain")


def test_the_plain_file_shows_the_heater(plain: dict[str, Any]) -> None:
    for name, true in (("K", K), ("T_s", T), ("L_s", L)):
        assert abs(plain["model"][name] - true) < 3.0 * plain["standard_errors"][name] < 0.1 * true


@pytest.mark.parametrize("name", FILES)
def test_the_files_are_identified_alike(name: str, plain: dict[str, Any], tmp_path: Path) -> None:
    found = identified(tmp_path, name)
    for parameter, value in plain["model"].items():
        tolerance = 3.0 * plain["standard_errors"][parameter] if FILES[name].repaired else 1e-6 * value
        assert found["model"][parameter] == pytest.approx(value, abs=tolerance)
    assert found["record"]["sample_time_s"] == pytest.approx(5.0)
    assert abs(found["record"]["samples"] - SAMPLES) <= FILES[name].repaired


@pytest.mark.parametrize(
    ("name", "shown"),
    [
        ("plain", "300 samples every 5 s, 25 min; MV 32..41, PV 57."),
        ("spreadsheet", "300 samples every 5 s, 25 min; MV (Stellwert (%)) 32..41 %, PV (Istwert (°C)) 57."),
        ("scada", "300 samples every 5 s, 25 min; MV (TIC101.OP) 32..41, PV (TIC101.PV) 57."),
        ("dcs", "300 samples every 5 s, 25 min; MV (CO (%)) 32..41 %, PV 57."),
        ("trend", "MV (5RT101 op) 32..41 %, PV (5RT101 pv) 57."),
        ("historian", "note: The file has its latest sample first; the record begins with the last line."),
        ("logger", "note: 2 lines above the names of the columns were not used."),
        ("logger", "note: 6 samples without a value, at most 2 in a row, were filled: MV and set-point held, PV in a"),
        ("uneven", "note: The samples were made every 5 s from values of PV every"),
    ],
)
def test_what_was_read_is_said_first(name: str, shown: str, tmp_path: Path) -> None:
    file = tmp_path / f"{name}.csv"
    file.write_bytes(FILES[name].content)
    result = CliRunner().invoke(app, ["identify", str(file), *FILES[name].arguments])
    assert result.exit_code == 0, result.output
    before, _, _ = result.stdout.partition("Model K")
    assert shown in " ".join(before.split()).replace("\u202f", " "), before

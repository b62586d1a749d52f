"""What the controller keeps over a restart."""

from __future__ import annotations

from pathlib import Path

import pytest

from controller.__main__ import main
from controller.memory import KeptError, keep, remembered
from controller.pid import Parameters

SETS = [Parameters(2.5, 10.0, 1.0, 0.1, 0.8, 0.0), Parameters(0.7)]


def test_kept_sets_come_back(tmp_path: Path) -> None:
    file = tmp_path / "kept.json"
    assert remembered(file, 2) is None
    keep(file, SETS[::-1])
    keep(file, SETS)
    assert remembered(file, 2) == SETS
    assert [each.name for each in tmp_path.iterdir()] == ["kept.json"]


@pytest.mark.parametrize(
    "text",
    [
        "",
        "{",
        "[]",
        '{"form": "other", "accepted": []}',
        '{"form": "loopwright controller 1", "accepted": [{"Kp": 1.0, "Ki": 2.0}]}',
        '{"form": "loopwright controller 1", "accepted": [{"Kp": NaN}]}',
        '{"form": "loopwright controller 1", "accepted": [{"Kp": "much"}]}',
        '{"form": "loopwright controller 1", "accepted": [{"Kp": 1}, {"Kp": 2}]}',
    ],
)
def test_a_file_that_makes_no_sense_stops_the_start(
    text: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "kept.json"
    file.write_text(text)
    with pytest.raises(KeptError, match="remove it to start with the gains of the options"):
        remembered(file, 1)
    assert main(["--bus", "virtual:x", "--keep", str(file)]) == 2
    assert str(file) in capsys.readouterr().err


def test_a_full_disk_leaves_the_file_of_before(tmp_path: Path) -> None:
    file = tmp_path / "kept.json"
    keep(file, SETS)
    (tmp_path / "kept.json.new").mkdir()
    with pytest.raises(OSError):
        keep(file, SETS[::-1])
    assert remembered(file, 2) == SETS

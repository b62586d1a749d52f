"""docs/offline.md: what it shows of `rehearse` and `tune` is what these commands print.

LOOPWRIGHT_WRITE_GOLDEN=1 python -m pytest tests/unit/service/cli/test_offline_page.py      writes it again
"""

from __future__ import annotations

import json
import os
import re
import shlex
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from loopwright.service.cli.main import app
from tests.e2e.transcript import differences
from tests.unit.service.cli.columns import columns

PAGE = Path(__file__).parents[4] / "docs" / "offline.md"
COLUMNS = {"rehearse": 100, "tune": 80}
_FIGURE = re.compile(r'"(\w+)": (-?[\d.]+(?:e-?\d+)?|"[^"]*"|\[[^\]]*\])')


def block(after: str) -> tuple[int, int]:
    """Where the next block of the page begins and ends."""
    text = PAGE.read_text(encoding="utf-8")
    begin = text.index("\n```", text.index(after)) + 1
    begin = text.index("\n", begin) + 1
    return begin, text.index("```", begin)


def typed(command: str) -> list[str]:
    """The words after `loopwright` of a command that the page shows."""
    text = PAGE.read_text(encoding="utf-8")
    line = next(each for each in text.splitlines() if each.startswith(f"    .venv/bin/loopwright {command} "))
    return shlex.split(line)[1:]


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty folder with the plant file of the page."""
    begin, end = block("`plant.json`, in deviations")
    (tmp_path / "plant.json").write_text(PAGE.read_text(encoding="utf-8")[begin:end])
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.parametrize("command", COLUMNS)
def test_the_page_shows_what_is_printed(command: str, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    columns(monkeypatch, COLUMNS[command])
    result = CliRunner().invoke(app, typed(command))
    assert result.exit_code == 0
    said = "\n".join(line.rstrip() for line in (result.stderr + result.stdout).splitlines()) + "\n"
    begin, end = block(f"loopwright {command} ")
    text = PAGE.read_text(encoding="utf-8")
    if "LOOPWRIGHT_WRITE_GOLDEN" in os.environ:
        PAGE.write_text(text[:begin] + said + text[end:], encoding="utf-8")
    else:
        assert differences(text[begin:end], said, 0.01) == []


def test_the_figures_of_json_are_those_printed(folder: Path) -> None:
    found: dict[str, Any] = json.loads(CliRunner().invoke(app, [*typed("rehearse"), "--json"]).stdout)
    begin, end = block("prints one JSON object and nothing else")
    compared = 0
    outer: dict[str, Any] = {}
    for line in PAGE.read_text(encoding="utf-8")[begin:end].splitlines():
        if opened := re.match(r'  "(\w+)": \{', line):
            outer = found[opened[1]]
            line = line[opened.end() :]
        for name, shown in _FIGURE.findall(line):
            value, true = json.loads(shown), outer.get(name, found.get(name))
            if isinstance(value, int | float | list):
                assert value == pytest.approx(true, rel=1e-2), name
            else:
                assert value == true
            compared += 1
    assert compared > 30

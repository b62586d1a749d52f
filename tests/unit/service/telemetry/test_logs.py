"""The text log: one entry a line, whatever a caller has put into it."""

from __future__ import annotations

import json
import logging
import sys
import unicodedata

import pytest
from hypothesis import given
from hypothesis import strategies as st

from loopwright.service.telemetry.logs import JsonLines, Lines, escaped

ENDS_A_LINE = "\n\r\v\f\x1c\x1d\x1e\x85\u2028\u2029"
HIDDEN = "\x1b\x08\x00\u202e\u2066\u200b\ufeff\ud800"


def entry(message: str, **fields: object) -> logging.LogRecord:
    record = logging.LogRecord("a", logging.INFO, "file", 1, message, None, None)
    record.__dict__.update(fields)
    return record


@pytest.mark.parametrize("field", ["path", "key", "loop", "job"])
@pytest.mark.parametrize("character", [*ENDS_A_LINE, *HIDDEN])
def test_a_field_stays_on_its_line(field: str, character: str) -> None:
    line = Lines().format(entry("request", **{field: f"/x{character}2026-01-01T00:00:00.000Z info forged"}))
    assert len(line.splitlines()) == 1 and character not in line
    assert character.encode("unicode_escape").decode() in line


@given(st.text(), st.text())
def test_no_text_ends_a_line_or_is_unseen(message: str, path: str) -> None:
    line = Lines().format(entry(message.replace("%", ""), path=path))
    assert len(line.splitlines()) == 1
    assert not [c for c in line if unicodedata.category(c) in ("Cc", "Cf", "Cs", "Zl", "Zp")]


def test_a_field_does_not_look_like_another() -> None:
    line = Lines().format(entry("request", path='/x who=admin status="200"', status=404))
    assert line.endswith(r'path="/x who=admin status=\"200\"" status=404')


def test_what_is_printed_anyway_is_left_as_it_is() -> None:
    assert escaped("Wärmetauscher 温度 90 °C") == "Wärmetauscher 温度 90 °C"


def test_the_text_of_an_error_forges_no_entry() -> None:
    record = entry("it failed")
    try:
        raise ValueError("bad name 'x\n2026-01-01T00:00:00.000Z info forged\u2028more'")
    except ValueError:
        record.exc_info = sys.exc_info()
    first, *rest = Lines().format(record).splitlines()
    assert first.endswith("it failed") and any("forged" in line for line in rest)
    assert all(line.startswith("  ") for line in rest)


def test_a_line_of_json_is_one_object_on_one_line() -> None:
    line = JsonLines().format(entry("request", path=f"/x{ENDS_A_LINE}{HIDDEN}"))
    assert len(line.splitlines()) == 1 and line.isascii()
    assert json.loads(line)["path"] == f"/x{ENDS_A_LINE}{HIDDEN}"

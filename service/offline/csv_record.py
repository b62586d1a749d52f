"""Reads a recorded test of a loop from a CSV file: time, MV and PV, optionally the set-point.

    t,u,y,sp          t or time or t_s: s from any origin, or ISO 8601 date and time
    0.0,50,20.1,20    u or mv, y or pv, sp: numbers; other columns are ignored

Columns are separated by comma, semicolon or tab; with the latter two a decimal comma is accepted. Empty lines and lines
that begin with # are skipped. All errors of a file are reported at once, by line.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from loopwright.service.inputs.validation import listed

Reals = NDArray[np.float64]

_NAMES = {"t": ("t", "time", "t_s"), "u": ("u", "mv"), "y": ("y", "pv"), "sp": ("sp",)}
_OPTIONAL = frozenset({"sp"})
_DELIMITERS = ",;\t"
_MAX_PROBLEMS = 20


class RecordError(Exception):
    """The file cannot be used; `problems` has a line for each error (the first 20)."""

    def __init__(self, source: str, problems: Sequence[str]) -> None:
        shown = list(problems[:_MAX_PROBLEMS])
        if len(problems) > _MAX_PROBLEMS:
            shown.append(f"and {len(problems) - _MAX_PROBLEMS} more")
        super().__init__(listed(source, len(problems), shown))
        self.problems = shown


@dataclass(frozen=True, slots=True, eq=False)
class Record:
    """The samples of a recorded test, all of shape (N,) and finite.

    t: time, s, increasing.
    u: MV, MV units.
    y: PV, PV units.
    sp: set-point, PV units; None if the file has none.
    """

    t: Reals
    u: Reals
    y: Reals
    sp: Reals | None = None


def load_record(path: Path) -> Record:
    """Returns the record in a CSV file. Raises RecordError for a file that cannot be read or used."""
    try:
        text = path.read_text(encoding="utf-8-sig")
    except OSError as error:
        raise RecordError(str(path), [f"cannot be read: {error.strerror}"]) from None
    except UnicodeDecodeError as error:
        raise RecordError(str(path), [f"is not text in UTF-8: byte {error.start}"]) from None
    return parse_record(text, str(path))


def parse_record(text: str, source: str) -> Record:
    """Returns the record in the text of a CSV file. Raises RecordError, in which `source` names the file."""
    lines = [(number, line) for number, line in enumerate(text.splitlines(), start=1) if _counts(line)]
    if not lines:
        raise RecordError(source, ["is empty: a line of column names and a line for each sample are needed"])
    number, header = lines[0]
    delimiter = max(_DELIMITERS, key=header.count)
    names = [name.strip().lower() for name in _cells(header, delimiter)]
    places, problems = _places(names, number)
    if problems:
        raise RecordError(source, problems)
    columns: dict[str, list[float]] = {quantity: [] for quantity in places}
    dated = None
    for number, line in lines[1:]:
        cells = _cells(line, delimiter)
        if len(cells) != len(names):
            problems.append(f"line {number}: {len(cells)} values where the first line names {len(names)} columns")
            continue
        if dated is None:
            dated = _is_date(cells[places["t"]])
        for quantity, at in places.items():
            try:
                value = _seconds(cells[at]) if dated and quantity == "t" else _number(cells[at], delimiter)
            except ValueError as error:
                problems.append(f"line {number}: {names[at]} {error}")
                continue
            if quantity == "t" and columns["t"] and not value > columns["t"][-1]:
                problems.append(f"line {number}: {names[at]} does not increase ({cells[at].strip()})")
            columns[quantity].append(value)
    if problems:
        raise RecordError(source, problems)
    if not columns["t"]:
        raise RecordError(source, ["has column names but no samples"])
    arrays = {quantity: np.array(values, dtype=float) for quantity, values in columns.items()}
    # s since 1970 are too large for exact time differences
    t = arrays["t"] - arrays["t"][0] if dated else arrays["t"]
    return Record(t, arrays["u"], arrays["y"], arrays.get("sp"))


def _counts(line: str) -> bool:
    return bool(line.strip()) and not line.lstrip().startswith("#")


def _cells(line: str, delimiter: str) -> list[str]:
    return next(csv.reader(io.StringIO(line), delimiter=delimiter))


def _places(names: Sequence[str], line: int) -> tuple[dict[str, int], list[str]]:
    """Returns the column index of each quantity, and the errors in the line of column names."""
    places, problems = {}, []
    for quantity, accepted in _NAMES.items():
        at = [i for i, name in enumerate(names) if name in accepted]
        if len(at) > 1:
            problems.append(f"line {line}: more than one column for {quantity}: {', '.join(names[i] for i in at)}")
        elif at:
            places[quantity] = at[0]
        elif quantity not in _OPTIONAL:
            there = ", ".join(name or "(none)" for name in names)
            problems.append(f"line {line}: no column {' or '.join(accepted)}; there are: {there}")
    return places, problems


def _number(cell: str, delimiter: str) -> float:
    text = cell.strip()
    if not text:
        raise ValueError("is missing")
    try:
        value = float(text if delimiter == "," else text.replace(",", "."))
    except ValueError:
        raise ValueError(f"is not a number: {text!r}") from None
    if not np.isfinite(value):
        raise ValueError(f"is not finite: {text!r}")
    return value


def _is_date(cell: str) -> bool:
    try:
        datetime.fromisoformat(cell.strip())
    except ValueError:
        return False
    # "20240101" is a number before it is a date
    return "-" in cell.strip()[1:] or ":" in cell


def _seconds(cell: str) -> float:
    try:
        moment = datetime.fromisoformat(cell.strip())
    except ValueError:
        raise ValueError(f"is not a date and time: {cell.strip()!r}") from None
    # a time without a zone is read as UTC: the zone and summer time of this machine must not affect it
    return (moment if moment.tzinfo else moment.replace(tzinfo=UTC)).timestamp()

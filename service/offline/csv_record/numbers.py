"""Numbers as people and historians write them: a decimal comma, a per cent sign, words where there is no value."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence

import numpy as np

from loopwright.tuning.models import Reals

BAD_STATES = frozenset(
    {
        "bad", "bad input", "no data", "nodata", "no value", "i/o timeout", "comm fail", "pt created", "shutdown",
        "intf shut", "scan off", "calc failed", "not connect", "under range", "over range", "out of serv", "configure",
    }
)  # fmt: skip
"""Why a historian had no good value, in small letters."""
MISSING = BAD_STATES | {"", "-", "--", "?", "na", "n/a", "#n/a", "nan", "null", "none", "missing"}
"""What stands in small letters where a historian had no good value."""

MAX_MOMENT = 40
_MOMENT = re.compile(r"\d[./:-]\w+[./:-]\d|\d:\d\d")
"""What shows a cell to be a date or a time of day, and the characters of the longest one."""
MINUS = "\u2212"
"""The minus sign of typesetters, which spreadsheets write as well."""
_THOUSANDS = {".": ",", ",": "."}
"""The sign that separates thousands beside each decimal sign; spaces and apostrophes do as well."""
_WITH_UNIT = re.compile(
    r"^(?P<number>[+-]?[\d., \u00a0]*\d)\s?(?P<unit>[^\W\d_]{1,4}|°\s?[CF]|[^\W\d_]{1,4}/[^\W\d_]{1,3})$"
)
"""A number with its unit in the same cell: 61.2 degC, 4 l/min."""
_GROUPS = {
    decimal: re.compile(rf"(?<=\d)(?<!\d{{4}})[{sign} \u00a0\u202f'\u2019](?=\d{{3}}(?!\d))|(?<=^[+-])\s+")
    for decimal, sign in _THOUSANDS.items()
}


def is_missing(cell: str) -> bool:
    return cell.strip().lower() in MISSING


def is_moment(cell: str) -> bool:
    """Whether a cell looks like a date or a time of day."""
    return len(cell) < MAX_MOMENT and _MOMENT.search(cell) is not None


def number(cell: str, decimal: str) -> float | None:
    """Returns the number in a cell, None where there is none.

    decimal: the decimal sign, "." or ","; the other one separates thousands.
    """
    thousands = _THOUSANDS[decimal]
    text = _GROUPS[decimal].sub("", cell.strip().rstrip("%").strip().replace(MINUS, "-"))
    if not text or thousands in text or "_" in text:
        return None
    try:
        return float(text.replace(",", "."))
    except ValueError:
        return None


def without_unit(cells: Sequence[str]) -> tuple[list[str], str] | None:
    """Returns the cells of a column without the unit that all its numbers have behind them, and the unit; None for any
    other column."""
    first = _WITH_UNIT.match(next((cell.strip() for cell in cells if not is_missing(cell)), ""))
    if first is None:
        return None
    unit, bare = first["unit"], []
    for cell in cells:
        text = cell.strip()
        if is_missing(text):
            bare.append(cell)
        elif (found := _WITH_UNIT.match(text)) and found["unit"] == unit:
            bare.append(found["number"])
        else:
            return None
    return bare, unit


def is_number(cell: str) -> bool:
    """Whether a cell has a number, whichever sign is the decimal one."""
    return any(number(cell, decimal) is not None for decimal in _THOUSANDS)


def numbers(cells: Sequence[str], decimal: str) -> tuple[Reals, list[int]]:
    """Returns the numbers of a column, NaN where the historian had no value, and the places of what is no number.

    decimal: the decimal sign, as in `number`.
    """
    text = "\n".join(cells)
    if "_" not in text:  # Python's own way to write thousands
        plain: Sequence[str] = cells
        if "," in text or decimal == ",":
            plain = text.replace(_THOUSANDS[decimal], "").replace(",", ".").split("\n")
        if (found := _at_once(plain)) is not None:
            return found, []
        plain = ["nan" if is_missing(cell) else each for cell, each in zip(cells, plain, strict=True)]
        if (found := _at_once(plain)) is not None:
            return found, []
    values, wrong = np.full(len(cells), np.nan), []
    for i, cell in enumerate(cells):
        if is_missing(cell):
            continue
        value = number(cell, decimal)
        if value is None or not math.isfinite(value):
            wrong.append(i)
        else:
            values[i] = value
    return values, wrong


def _at_once(cells: Sequence[str]) -> Reals | None:
    """The numbers of a long column in a fraction of the time; None where one is to be looked at by itself."""
    try:
        values = np.array(cells, dtype=float)
    except ValueError:
        return None
    return None if np.any(np.isinf(values)) else values

"""Numbers as people and historians write them: a decimal comma, a per cent sign, words where there is no value."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from loopwright.tuning.models import Reals

MISSING = frozenset(
    {
        "", "-", "--", "?", "na", "n/a", "#n/a", "nan", "null", "none", "missing", "bad", "bad input", "no data",
        "nodata", "no value", "i/o timeout", "comm fail", "pt created", "shutdown", "intf shut", "scan off",
        "calc failed", "not connect", "under range", "over range", "out of serv", "configure",
    }
)  # fmt: skip
"""What stands in small letters where a historian had no good value."""


def is_missing(cell: str) -> bool:
    return cell.strip().lower() in MISSING


def number(cell: str, decimal_comma: bool = True) -> float | None:
    """Returns the number in a cell, None where there is none.

    decimal_comma: whether a comma alone is a decimal comma, which it is not where commas separate the cells.
    """
    text = cell.strip().rstrip("%").replace(" ", "").replace("\u00a0", "").replace("\u202f", "")
    if "," in text and "." in text:  # the last of the two signs is the decimal one
        thousands = "," if text.rindex(".") > text.rindex(",") else "."
        text = text.replace(thousands, "")
        text = text.replace(",", ".")
    elif decimal_comma:
        text = text.replace(",", ".")
    if not text or "_" in text:  # Python's own way to write thousands
        return None
    try:
        return float(text)
    except ValueError:
        return None


def numbers(cells: Sequence[str], decimal_comma: bool) -> tuple[Reals, list[int]]:
    """Returns the numbers of a column, NaN where the historian had no value, and the places of what is no number."""
    try:
        values = np.array(cells, dtype=float)
        if np.all(np.isfinite(values)) and not any("_" in cell for cell in cells):
            return values, []
    except ValueError:
        pass
    values, wrong = np.full(len(cells), np.nan), []
    for i, cell in enumerate(cells):
        if is_missing(cell):
            continue
        value = number(cell, decimal_comma)
        if value is None or not math.isfinite(value):
            wrong.append(i)
        else:
            values[i] = value
    return values, wrong

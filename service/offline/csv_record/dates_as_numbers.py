"""Dates that are written as numbers: 20261125100000, and the days that spreadsheets count."""

from __future__ import annotations

import re
from collections.abc import Sequence
from datetime import UTC, datetime

import numpy as np

from loopwright.service.offline.csv_record.errors import Unusable
from loopwright.service.offline.csv_record.time_units import USUAL_MINUTES
from loopwright.tuning.models import Reals

_COMPACT = re.compile(
    r"^(?P<date>(?:19[7-9]|20\d)\d{5})[ T_-]?"
    r"(?P<clock>\d{6}(?=$|[.,]\d+$|\d{3}$|\d{6}$)|\d{4}$|\d{2}$)[.,]?(?P<fraction>\d*)$"
)
_DAYS = ((20000.0, 80000.0), (715000.0, 765000.0))
"""Days that spreadsheets count from 1900 on, for dates from 1954 to 2119, and MATLAB from the year 0 on."""
_SHORT_STEP = 0.005
"""Largest time between samples, in days, for which numbers of that size are days in any case: seven minutes.

Of a clock in s it would be 200 samples a second."""


def compact_dates(cells: Sequence[str]) -> Reals | None:
    """Returns the times, s since 1970, of dates with nothing between their parts (YYYYMMDDHHMMSS, YYYYMMDDHHMM); None
    where a cell is no such date, or one of another length."""
    first = _COMPACT.match(cells[0].strip())
    if first is None:
        return None
    moments = []
    for cell in cells:
        found = _COMPACT.match(cell.strip())
        if found is None or len(found["clock"]) != len(first["clock"]):
            return None
        try:
            moment = datetime.fromisoformat(f"{found['date']}T{found['clock']}").replace(tzinfo=UTC)
        except ValueError:
            return None
        moments.append(moment.timestamp() + float(f"0.{found['fraction'] or 0}"))
    return np.array(moments)


def are_days(times: Reals, cells: Sequence[str], name: str) -> bool:
    """Whether numbers are days, by their size and by how far they are apart.

    cells: the numbers as they are written. name: the name of their column.
    Raises Unusable where they may be s as well, or are neither.
    """
    steps = np.abs(np.diff(times))
    if not len(steps) or not any(low <= times.min() and times.max() < high for low, high in _DAYS):
        return False
    step = float(np.median(steps))
    if step < _SHORT_STEP or step > 1.0:
        return step < _SHORT_STEP
    last_digit = 10.0 ** -max(len(re.split("[.,]", f"{cell.strip()}.")[1]) for cell in cells)
    rounding = max(min(last_digit, 0.01 * step), 1e-9)  # of full doubles, too
    days = any(abs(step - minutes / 1440.0) <= rounding for minutes in USUAL_MINUTES if minutes >= 10)
    whole_ms = abs(1000.0 * step - round(1000.0 * step)) < 1e-4
    if days == whole_ms:
        raise Unusable(
            f"{name} has numbers from {times.min():.10g} on, {step:.6g} apart: they may be days of a spreadsheet or s; "
            f"put the unit behind the name of the column: '{name} (d)' or '{name} (s)'"
        )
    return days

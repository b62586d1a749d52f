"""Times as control systems, historians and spreadsheets write them, as seconds.

Dates are read day first, month first or year first, whichever all of a column are; where both of the first two are
possible, the one by which the record is shorter. A time without a zone is read as UTC: neither the zone of this machine
nor its summer time must change a record.
"""

from __future__ import annotations

import re
from calendar import month_abbr
from collections.abc import Callable, Sequence
from datetime import UTC, datetime, timedelta
from typing import TypeVar

import numpy as np

from loopwright.service.offline.csv_record.dates_as_numbers import are_days, compact_dates
from loopwright.service.offline.csv_record.errors import Unusable, counted
from loopwright.service.offline.csv_record.numbers import numbers
from loopwright.service.offline.csv_record.time_units import (
    require_known,
    require_possible,
    require_s_likely,
    seconds_in,
)
from loopwright.service.offline.csv_record.words import plain
from loopwright.tuning.models import Reals

_EPOCHS = ((1e18, 1e-9), (1e17, 1e-7), (1e14, 1e-6), (1e11, 1e-3), (1e8, 1.0))
"""Times from so large a number on count from an epoch, in units of so many s: ns, Windows' 100 ns, us, ms, s."""
_SURELY_SINCE_1970 = 6e8
"""Seconds since 1970 of early 1989; before that a number may as well count ms from anywhere."""
_MONTHS = {
    **{name.lower(): i for i, name in enumerate(month_abbr) if name},
    **{"mrz": 3, "mai": 5, "okt": 10, "dez": 12},
    **{"fev": 2, "avr": 4, "juin": 6, "juil": 7, "aou": 8},
    **{"ene": 1, "abr": 4, "ago": 8, "dic": 12},
}
"""The number of a month by the first letters of its name in English, German, French and Spanish, without accents."""
_MOMENT = re.compile(
    r"^(?:(?P<a>\d{1,4})(?P<sign>\.\s?|[/\- ])(?P<b>\d{1,2}|[^\W\d_]{3,10}\.?)[./\- ](?P<c>\d{2,4})(?:[T, ]\s*|$))?"
    r"(?:(?P<hour>\d{1,2}):(?P<minute>\d{2})(?::(?P<second>\d{2})(?:[.,:](?P<fraction>\d{1,9}))?)?"
    r"\s*(?P<half>[AaPp]\.?\s?[Mm]\.?)?)?(?:\s*(?:UTC|GMT|Z))?$"
)
_MINUTES_FIRST = re.compile(r"^m{1,2}(?:in)?:s{1,2}(?:ec)?\b", re.IGNORECASE)
"""The unit of times whose first part is not the hour."""
_DAY = 86400.0

Value = TypeVar("Value")
Parts = tuple[str, str, str, str, float]
"""The three parts of a date, the sign between them, and the seconds since midnight."""


def are_numbers(cells: Sequence[str], form: str | None) -> bool:
    """Whether the times of a column are numbers, which have no sign of a date or a time of day."""
    first = cells[0].strip()
    return form is None and ":" not in first and not _has_date(first)


def seconds(
    cells: Sequence[str], lines: Sequence[int], unit: str, form: str | None, name: str, decimal: str = "."
) -> Reals:
    """Returns the times of a column, s; those with a date, or that count from an epoch, from the first one on.

    unit: the unit of times that are numbers ("" for s).
    form: how times are written, as `datetime.strptime` describes it, or None to find out.
    name: the name of the column, for errors.
    decimal: the decimal sign of times that are numbers.
    Raises Unusable, naming the lines.
    """
    if form is not None:
        moments = _each(cells, lines, name, lambda cell: _by_form(cell, form), f"of the form {form!r}")
        return _from_first(np.array(moments))
    if are_numbers(cells, form):
        return _of_numbers(cells, lines, unit, name, decimal)
    if _MINUTES_FIRST.match(unit) and cells[0].count(":") == 1:
        cells = [f"0:{cell.strip()}" for cell in cells]
    try:
        return _from_first(np.array([_iso(cell) for cell in cells]))
    except ValueError:
        return _written(cells, lines, name)


def _has_date(cell: str) -> bool:
    found = _MOMENT.match(cell)
    return bool(found and found["a"])


def _from_first(times: Reals) -> Reals:
    return np.asarray(times - times[0])  # s since 1970 are too large for exact differences of time


def _by_form(cell: str, form: str) -> float:
    moment = datetime.strptime(cell.strip(), form)
    return (moment if moment.tzinfo else moment.replace(tzinfo=UTC)).timestamp()


def _iso(cell: str) -> float:
    moment = datetime.fromisoformat(cell.strip())
    return (moment if moment.tzinfo else moment.replace(tzinfo=UTC)).timestamp()


def _each(
    cells: Sequence[str], lines: Sequence[int], name: str, read: Callable[[str], Value], what: str
) -> list[Value]:
    """What `read` makes of each cell. Raises Unusable with the lines for which it raises ValueError."""
    found, wrong = [], []
    for i, cell in enumerate(cells):
        try:
            found.append(read(cell))
        except ValueError:
            wrong.append(i)
    if wrong:
        places = [lines[i] for i in wrong]
        one = f"{name} is no time {what}: {cells[wrong[0]].strip()!r}"
        many = f"values of {name} are no times {what}, such as {cells[wrong[0]].strip()!r}"
        raise Unusable(counted(places, one, many))
    return found


def _of_numbers(cells: Sequence[str], lines: Sequence[int], unit: str, name: str, decimal: str) -> Reals:
    if (moments := compact_dates(cells)) is not None:
        return _from_first(moments)
    times, wrong = numbers(cells, decimal)
    wrong = sorted({*wrong, *np.flatnonzero(np.isnan(times)).tolist()})
    if wrong:
        places = [lines[i] for i in wrong]
        given = cells[wrong[0]].strip()
        if not given:
            missing = counted(places, f"{name} is missing", f"values of {name} are missing")
            raise Unusable(f"{missing}; delete such lines, or give --every if the lines come evenly")
        one = f"{name} is neither a number of s nor a date and time: {given!r}; --time-format says how it is written"
        raise Unusable(counted(places, one, f"values of {name} are not numbers as those before, such as {given!r}"))
    if (size_s := seconds_in(unit)) is not None:
        require_possible(float(times[0]) * size_s, unit, name)
        return np.asarray(times * size_s)
    for smallest, size in _EPOCHS:
        if times[0] >= smallest:
            if size == 1.0 and times[0] < _SURELY_SINCE_1970:
                require_s_likely(times, name)
            return _from_first(times) * size
    if are_days(times, cells, name):
        return _from_first(times) * _DAY
    require_known(unit, name)
    require_s_likely(times, name)
    return times


def _parts(cell: str) -> Parts:
    found = _MOMENT.match(cell.strip())
    if not found or not (found["a"] or found["hour"]):
        raise ValueError(cell)
    hour = int(found["hour"] or 0)
    if half := found["half"]:
        if not 1 <= hour <= 12:
            raise ValueError(cell)
        hour = hour % 12 + (12 if half[0] in "Pp" else 0)
    minute, second = int(found["minute"] or 0), int(found["second"] or 0)
    if hour > 24 or minute > 59 or second > 60:
        raise ValueError(cell)
    fraction = float("0." + found["fraction"]) if found["fraction"] else 0.0
    clock = 3600.0 * hour + 60.0 * minute + second + fraction
    return found["a"] or "", found["b"] or "", found["c"] or "", found["sign"] or "", clock


def _written(cells: Sequence[str], lines: Sequence[int], name: str) -> Reals:
    hint = "that is known; --time-format says how it is written, such as '%d.%m.%Y %H:%M:%S'"
    parts = _each(cells, lines, name, _parts, hint)
    clock = np.array([each[4] for each in parts])
    dated = [bool(each[0]) for each in parts]
    if not any(dated):
        return _over_midnight(clock)
    if not all(dated):
        places = [lines[i] for i, there in enumerate(dated) if not there]
        raise Unusable(counted(places, f"{name} has no date", f"values of {name} have no date"))
    dates = {each[:4] for each in parts}
    possible = {order: days for order in ("day", "month", "year") if (days := _days(dates, order)) is not None}
    if not possible:
        raise Unusable(f"the dates of {name} are of no single order; {hint.partition('; ')[2]}")
    found = {order: np.array([days[each[:4]] for each in parts]) * _DAY + clock for order, days in possible.items()}
    # the wrong order of day and month makes months of the days between the first sample and the last
    return _from_first(min(found.values(), key=lambda times: float(np.ptp(times))))


def _days(dates: set[tuple[str, str, str, str]], order: str) -> dict[tuple[str, str, str, str], float] | None:
    """The day number of each date, its first part being the day, the month or the year; None where that cannot be."""
    epoch, found = datetime(1970, 1, 1), {}
    for date in dates:
        first, second, third, sign = date
        year_first = len(first) == 4
        fits = {
            "day": not year_first,
            "month": not year_first and not sign.startswith("."),
            "year": year_first or len(first) == len(third) == 2,
        }
        if not fits[order]:
            return None
        try:
            month = _MONTHS.get(plain(second)[:4]) or _MONTHS.get(plain(second)[:3])
            match order:
                case "year":
                    day = datetime(_year(first), month or int(second), int(third))
                case "day":
                    day = datetime(_year(third), month or int(second), int(first))
                case _:
                    day = datetime(_year(third), int(first), int(second))
        except ValueError:
            return None
        found[date] = (day - epoch) / timedelta(days=1)
    return found


def _year(text: str) -> int:
    return int(text) if len(text) == 4 else 2000 + int(text)


def _over_midnight(clock: Reals) -> Reals:
    """Times of day, s, as times that go on over midnight, forwards or backwards."""
    steps = np.diff(clock, prepend=clock[0])
    return clock + _DAY * np.cumsum((steps < -_DAY / 2).astype(float) - (steps > _DAY / 2).astype(float))

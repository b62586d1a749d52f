"""Which column of a file is the time, MV, PV and the set-point: by the names that control systems give them."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from loopwright.service.inputs.validation import did_you_mean
from loopwright.service.offline.csv_record.errors import Unusable
from loopwright.service.offline.csv_record.time_units import SECONDS, unit_at_end

NAMES = {
    "t": ("t", "time", "timestamp", "time stamp", "t_stamp", "datetime", "date time", "date/time", "date and time"),
    "u": ("u", "mv", "op", "co", "out", "output", "controller output", "manipulated variable"),
    "y": ("y", "pv", "process value", "process variable", "measurement"),
    "sp": ("sp", "sv", "setpoint", "set-point", "set point"),
}
"""The names of each quantity in small letters; a unit may follow (`MV (%)`, `t_s`), a tag precede (`FIC101.OP`)."""
DATE, CLOCK, MILLISECONDS = ("date",), ("time",), ("ms", "msec", "millisecond", "milliseconds")
SHOWN = {"t": "the time", "u": "MV", "y": "PV", "sp": "the set-point"}
_USUAL = {"t": 1, "u": 2, "y": 3, "sp": 4}
"""The number of the column of each quantity in the files that most people make."""
_OPTIONAL = frozenset({"sp"})
_UNIT = re.compile(r"^(?P<name>.*?)\s*[(\[{](?P<unit>[^)\]}]*)[)\]}]\s*$")
_TIME_UNITS = re.compile(rf"^(?P<name>t|time|timestamp)(?:_|\s*[ ,/]\s*)(?P<unit>{'|'.join(SECONDS)})\.?$")
_TAG = re.compile(r"[.:/_\s\\-]+")


@dataclass(frozen=True, slots=True)
class Columns:
    """Where the quantities of a record are.

    at: the column of each quantity, by its short name; the time is absent where the first column is to be looked at.
    names: the names of all columns, as the file has them.
    units: the unit of each quantity where its column's name has one.
    date, milliseconds: the columns that are joined with that of the time, or None.
    """

    at: Mapping[str, int]
    names: Sequence[str]
    units: Mapping[str, str] = field(default_factory=dict)
    date: int | None = None
    milliseconds: int | None = None


def split_unit(cell: str) -> tuple[str, str]:
    """Returns the name of a column in small letters, and its unit ("" where it has none)."""
    text = cell.strip()
    if (found := _UNIT.match(text)) or (found := _TIME_UNITS.match(text.casefold())):
        return found["name"].strip().lower(), found["unit"].strip()
    return text.lower(), ""


def find_columns(header: Sequence[str], chosen: Mapping[str, str], line: int) -> Columns:
    """Returns where the quantities are, given the cells of the line of names.

    chosen: the column that the user names for a quantity, by its name or by its number, which counts from 1.
    Raises Unusable, with all errors at once.
    """
    split = [split_unit(cell) for cell in header]
    names = [name for name, _ in split]
    at: dict[str, int] = {}
    problems: list[str] = []
    date = _only(names, DATE)
    for quantity, accepted in NAMES.items():
        try:
            if quantity in chosen:
                at[quantity] = _chosen(header, names, chosen[quantity], quantity)
            elif quantity == "t" and date is not None and (clock := _only(names, CLOCK)) is not None:
                at["t"] = clock
            elif (place := _named(header, names, accepted, quantity)) is not None:
                at[quantity] = place
            elif quantity == "t" and names and names[0] in ("", *DATE):
                at["t"] = 0
            elif quantity not in _OPTIONAL:
                problems.append(f"line {line}: {_missing(header, accepted, quantity)}")
        except Unusable as error:
            problems.append(f"line {line}: {error}")
    twice = {place for place in at.values() if list(at.values()).count(place) > 1}
    problems += [f"column {header[place]!r} is chosen for more than one quantity" for place in sorted(twice)]
    if problems:
        raise Unusable(*problems)
    units = {quantity: split[place][1] for quantity, place in at.items() if split[place][1]}
    if "t" in chosen and "t" not in units and (unit := unit_at_end(header[at["t"]])):
        units["t"] = unit
    joined = date if "t" in at and at["t"] != date and names[at["t"]] in CLOCK and "t" not in chosen else None
    return Columns(at, header, units, joined, _only(names, MILLISECONDS))


def _only(names: Sequence[str], accepted: Sequence[str]) -> int | None:
    found = [i for i, name in enumerate(names) if name in accepted]
    return found[0] if len(found) == 1 else None


def _named(header: Sequence[str], names: Sequence[str], accepted: Sequence[str], quantity: str) -> int | None:
    """The column with one of the names, else the one whose name ends in one after a tag. Raises Unusable: several."""
    exactly = [i for i, name in enumerate(names) if name in accepted]
    found = exactly or [i for i, name in enumerate(names) if _TAG.split(name)[-1] in accepted]
    if len(found) > 1:
        several = ", ".join(header[i].strip() for i in found)
        raise Unusable(f"more than one column for {SHOWN[quantity]}: {several}. Say which: --{quantity} NAME")
    return found[0] if found else None


def _chosen(header: Sequence[str], names: Sequence[str], wanted: str, quantity: str) -> int:
    given = wanted.strip()
    if given.isdigit() and 1 <= int(given) <= len(header):
        return int(given) - 1
    for matching in (
        [i for i, cell in enumerate(header) if cell.strip() == given],
        [i for i, cell in enumerate(header) if cell.strip().lower() == given.lower()],
        [i for i, name in enumerate(names) if name == given.lower()],
    ):
        if len(matching) == 1:
            return matching[0]
        if matching:
            places = ", ".join(str(i + 1) for i in matching)
            raise Unusable(f"--{quantity}: columns {places} are all named {given!r}; give the number of one of them")
    raise Unusable(f"--{quantity}: no column {given!r}{did_you_mean(given, _there(header))}; {_list(header)}")


def _missing(header: Sequence[str], accepted: Sequence[str], quantity: str) -> str:
    if {"value", "tagname"} <= {name.strip().lower() for name in header} or {"value", "tag"} <= {
        name.strip().lower() for name in header
    }:
        return "a line has one value of one tag; export the tags side by side: a line for each time, a column for each"
    if len(header) == 1:
        return "one column alone; columns are separated by comma, semicolon or tab"
    numbered = all(_is_number(cell) for cell in header)
    if numbered:
        number = f"--{quantity} {_USUAL[quantity]}"
        return f"no column for {SHOWN[quantity]}: the line has no names. Give its number, as {number}"
    known = ", ".join(accepted[:4])
    return f"no column for {SHOWN[quantity]} ({known}, ...); {_list(header)}. Say which: --{quantity} NAME"


def _there(header: Sequence[str]) -> list[str]:
    return [cell.strip() for cell in header if cell.strip()]


def _list(header: Sequence[str]) -> str:
    return f"there are: {', '.join(cell.strip() or '(no name)' for cell in header)}"


def _is_number(cell: str) -> bool:
    try:
        float(cell.replace(",", "."))
    except ValueError:
        return not cell.strip()
    return True

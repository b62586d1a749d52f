"""Which column of a file is the time, MV, PV and the set-point: by the names that control systems give them."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from loopwright.service.inputs.validation import did_you_mean
from loopwright.service.offline.csv_record.errors import Unusable
from loopwright.service.offline.csv_record.numbers import is_moment, is_number
from loopwright.service.offline.csv_record.time_units import SECONDS, unit_at_end
from loopwright.service.offline.csv_record.words import plain

NAMES = {
    "t": (
        "t", "time", "timestamp", "time stamp", "t_stamp", "datetime", "date time", "date/time", "date and time",
        "elapsed", "elapsed time",
        "zeit", "zeitstempel", "zeitpunkt", "uhrzeit", "datum/uhrzeit", "datum uhrzeit", "datum und uhrzeit",
        "datum/zeit", "temps", "heure", "horodatage", "horodate", "date heure", "date/heure", "date et heure",
        "tiempo", "hora", "fecha hora", "fecha/hora", "fecha y hora", "marca de tiempo",
    ),
    "u": (
        "u", "mv", "op", "co", "out", "output", "controller output", "manipulated variable",
        "stellwert", "stellgrosse", "stellgroesse", "stellgrad", "stellsignal", "ausgang", "reglerausgang",
        "commande", "sortie", "signal de commande", "sortie regulateur", "sortie du regulateur",
        "grandeur reglante", "variable manipulee",
        "salida", "salida del controlador", "senal de control", "mando", "variable manipulada",
    ),
    "y": (
        "y", "pv", "process value", "process variable", "measurement", "measured value", "actual value",
        "istwert", "ist", "ist-wert", "messwert", "regelgrosse", "regelgroesse", "prozesswert",
        "mesure", "valeur mesuree", "valeur reelle", "grandeur reglee", "variable de procede",
        "medida", "medicion", "valor medido", "valor real", "valor de proceso", "variable de proceso",
    ),
    "sp": (
        "sp", "sv", "setpoint", "set-point", "set point", "set value",
        "sollwert", "soll", "soll-wert", "fuhrungsgrosse", "fuehrungsgroesse",
        "consigne", "point de consigne", "valeur de consigne",
        "consigna", "punto de consigna", "valor de consigna", "punto de ajuste",
    ),
}  # fmt: skip
"""The names of each quantity, as `plain` makes them; a unit may follow (`MV (%)`, `t_s`), a tag precede (`FIC101.OP`).

In English, German, French and Spanish."""
INPUTS = ("input", "in", "eingang", "entree", "entrada")
OUTPUTS = ("output", "out", "ausgang", "sortie", "salida")
"""Words that are the plant's in one file and the controller's in another: where both are there, neither tells MV."""
DATE, CLOCK = ("date", "datum", "fecha"), ("time", "zeit", "uhrzeit", "heure", "hora", "temps", "tiempo")
MILLISECONDS = ("ms", "msec", "millisecond", "milliseconds", "millisekunden", "millisecondes", "milisegundos")
ONE_VALUE = "a line has one value of one tag"
SHOWN = {"t": "the time", "u": "MV", "y": "PV", "sp": "the set-point"}
_USUAL = {"t": 1, "u": 2, "y": 3, "sp": 4}
"""The number of the column of each quantity in the files that most people make."""
_OPTIONAL = frozenset({"sp"})
_UNIT = re.compile(
    r"^(?P<name>.*?)\s*(?:[(\[{](?P<bracketed>[^)\]}]*)[)\]}]|(?<=[\w\s])(?P<percent>%)|"
    r"\s(?:in|en|/)\s+(?P<said>\S{1,12}))\s*$",
    re.IGNORECASE,
)
_TIME_UNITS = re.compile(
    rf"^(?P<name>{'|'.join(map(re.escape, NAMES['t']))})(?:_|\s*[ ,/]\s*)(?P<unit>{'|'.join(SECONDS)})\.?$"
)
_TAG = re.compile(r"[.:/_\s\\-]+")
_NUMBERED = re.compile(r"^(?P<name>[a-z]{2,})[_ ]?(?P<number>\d+)$")


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
    """Returns the name of a column as `plain` makes it, and its unit ("" where it has none)."""
    text = cell.strip()
    if found := _TIME_UNITS.match(plain(text)):
        return found["name"], found["unit"]
    if found := _UNIT.match(text):
        return plain(found["name"]), (found["bracketed"] or found["percent"] or found["said"] or "").strip()
    return plain(text), ""


def find_columns(header: Sequence[str], chosen: Mapping[str, str], line: int, timed: bool = True) -> Columns:
    """Returns where the quantities are, given the cells of the line of names.

    chosen: the column that the user names for a quantity, by its name or by its number, which counts from 1.
    timed: whether a column of the time is needed; else none is looked for.
    Raises Unusable, with all errors at once.
    """
    split = [split_unit(cell) for cell in header]
    names = [name for name, _ in split]
    at: dict[str, int] = {}
    several: dict[str, list[int]] = {}
    problems: list[str] = []
    date = _only(names, DATE)
    for quantity, accepted in NAMES.items():
        if quantity == "t" and not timed:
            continue
        try:
            if quantity in chosen:
                at[quantity] = _chosen(header, names, chosen[quantity], quantity)
            elif quantity == "t" and date is not None and (clock := _only(names, CLOCK)) is not None:
                at["t"] = clock
            elif found := _named(names, accepted):
                several[quantity] = found
            elif quantity == "t" and names and names[0] in ("", *DATE):
                at["t"] = 0
            elif quantity == "y" and _both_ways(names, several):
                continue  # asked for together with MV
            elif quantity not in _OPTIONAL:
                problems.append(f"line {line}: {_missing(header, accepted, quantity, timed)}")
        except Unusable as error:
            problems.append(f"line {line}: {error}")
    problems += [f"line {line}: {problem}" for problem in _ambiguous(header, names, at, several)]
    at |= {quantity: found[0] for quantity, found in several.items() if len(found) == 1}
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


def _named(names: Sequence[str], accepted: Sequence[str]) -> list[int]:
    """The columns with one of the names, else those whose names end in one after a tag, else those with a number behind
    it."""
    exactly = [i for i, name in enumerate(names) if name in accepted]
    tagged = exactly or [i for i, name in enumerate(names) if _TAG.split(name)[-1] in accepted]
    return tagged or [i for i, name in enumerate(names) if (n := _NUMBERED.match(name)) and n["name"] in accepted]


def _tag(name: str) -> list[str]:
    """What tells a column from that of another loop with the same name."""
    if numbered := _NUMBERED.match(name):
        return [numbered["number"]]
    return _TAG.split(name)[:-1]


def _ambiguous(
    header: Sequence[str], names: Sequence[str], at: Mapping[str, int], several: dict[str, list[int]]
) -> list[str]:
    """What is wrong with columns that names alone do not tell apart.

    at: the columns that the user chose. several: those that may be each of the other quantities; of several loops,
    those of the loop that the user chose are left.
    """
    problems = []
    if _both_ways(names, several):
        # PV of a controller is its input, that of a plant its output
        inputs, outputs = _ending_in(names, INPUTS), _ending_in(names, OUTPUTS)
        del several["u"]
        one, other = (header[each[0]].strip() for each in (inputs, outputs))
        pv = ("", "") if "y" in several or "y" in at else (f' --y "{other}"', f' --y "{one}"')
        problems.append(
            f"{one} and {other} may be those of the plant or of the controller. Say which is MV: "
            f'--u "{one}"{pv[0]} where it is the input of the plant, '
            f'--u "{other}"{pv[1]} where it is the output of the controller'
        )
    here = [at[quantity] for quantity in ("y", "u", "sp") if quantity in at]
    times = list(several.get("t", ()))
    for quantity, found in several.items():
        if len(found) > 1 and here:
            several[quantity] = _beside(names, found, here[0], times) or found
    loops = [quantity for quantity, found in several.items() if len(found) > 1]
    if {"u", "y"} <= set(loops):
        which = _listed(header, several["y"])
        problems.append(
            f"there are several loops side by side: PV is {which}. Say which: --y {_called(header, several['y'][-1])}; "
            "the other columns are then those of the same tag"
        )
        loops = []
    for quantity in loops:
        which = _listed(header, several[quantity])
        how = "NAME" if len({header[i].strip() for i in several[quantity]}) > 1 else "NUMBER"
        problems.append(f"more than one column for {SHOWN[quantity]}: {which}. Say which: --{quantity} {how}")
    return problems


def _ending_in(names: Sequence[str], words: Sequence[str]) -> list[int]:
    return [i for i, name in enumerate(names) if _TAG.split(name)[-1] in words]


def _both_ways(names: Sequence[str], several: Mapping[str, list[int]]) -> bool:
    """Whether MV would be taken from a column of an output although there is one of an input as well."""
    return bool(_ending_in(names, INPUTS) and set(several.get("u", ())) & set(_ending_in(names, OUTPUTS)))


def _beside(names: Sequence[str], found: Sequence[int], place: int, times: Sequence[int]) -> list[int]:
    """The columns that belong to the loop of the column at `place`: of the same tag, else after the same time."""
    tag = _tag(names[place])
    same = [i for i in found if tag and _tag(names[i]) == tag]
    if same or len(times) < 2:
        return same
    block = sum(each <= place for each in times)
    return [i for i in found if sum(each <= i for each in times) == block]


def _called(header: Sequence[str], place: int) -> str:
    """How the user names a column: by its name, else by its number."""
    name = header[place].strip()
    alone = [cell.strip() for cell in header].count(name) == 1
    return (f'"{name}"' if re.search(r"\s", name) else name) if alone else str(place + 1)


def _listed(header: Sequence[str], places: Sequence[int]) -> str:
    return " or ".join(f"{header[i].strip()} (column {i + 1})" for i in places)


def _chosen(header: Sequence[str], names: Sequence[str], wanted: str, quantity: str) -> int:
    given = wanted.strip()
    if given.isdigit() and 1 <= int(given) <= len(header):
        return int(given) - 1
    for matching in (
        [i for i, cell in enumerate(header) if cell.strip() == given],
        [i for i, cell in enumerate(header) if cell.strip().lower() == given.lower()],
        [i for i, name in enumerate(names) if name == plain(given)],
    ):
        if len(matching) == 1:
            return matching[0]
        if matching:
            places = ", ".join(str(i + 1) for i in matching)
            raise Unusable(f"--{quantity}: columns {places} are all named {given!r}; give the number of one of them")
    raise Unusable(f"--{quantity}: no column {given!r}{did_you_mean(given, _there(header))}; {_list(header)}")


def _missing(header: Sequence[str], accepted: Sequence[str], quantity: str, timed: bool) -> str:
    if {"value", "tagname"} <= {name.strip().lower() for name in header} or {"value", "tag"} <= {
        name.strip().lower() for name in header
    }:
        return f"{ONE_VALUE}; export the tags side by side: a line for each time, a column for each"
    if len(header) == 1:
        return "one column alone; columns are separated by comma, semicolon or tab"
    numbered = all(is_number(cell) or is_moment(cell) or not cell.strip() for cell in header)
    if numbered:
        number = f"--{quantity} {_USUAL[quantity] - (not timed)}"
        every = ", or --every 1s where the file has none and its lines come every second" if quantity == "t" else ""
        return f"no column for {SHOWN[quantity]}: the line has no names. Give its number, as {number}{every}"
    known = ", ".join(accepted[:4])
    every = ", or how far its lines are apart: --every 1s" if quantity == "t" else ""
    return f"no column for {SHOWN[quantity]} ({known}, ...); {_list(header)}. Say which: --{quantity} NAME{every}"


def _there(header: Sequence[str]) -> list[str]:
    return [cell.strip() for cell in header if cell.strip()]


def _list(header: Sequence[str]) -> str:
    return f"there are: {', '.join(cell.strip() or '(no name)' for cell in header)}"

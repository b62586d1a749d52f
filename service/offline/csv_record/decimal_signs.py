"""Which of point and comma is the decimal sign and which separates thousands: found for a file, never for a cell alone.

A sign in "35,2", "0,125" or "1.234,5" shows what it is; that in "1,234" does not, and is read by the others.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence

import numpy as np

from loopwright.service.offline.csv_record.errors import Unusable
from loopwright.service.offline.csv_record.numbers import numbers
from loopwright.tuning.models import Reals

_OTHER = {".": ",", ",": "."}
_CALLED = {".": "point", ",": "comma"}
_JUMP = (200.0, 5000.0)
"""A value so many times its neighbour is the same with its thousands taken for decimals."""


def _showing(sign: str) -> re.Pattern[str]:
    """What shows a sign to be the decimal one: other than three digits behind it, or more or less than one to three
    before it, or another sign that must separate thousands."""
    own, other = re.escape(sign), re.escape(_OTHER[sign])
    behind = rf"(?<=\d{own})\d{{0,2}}(?![\d.,])|\d{{4}}|\d{{3}}[eE]"
    before = rf"(?<!\d{own})\d|(?<=\D0{own})\d|(?<=\d{{4}}{own})\d|(?<=[ \u00a0\u202f]\d{{3}}{own})\d"
    return re.compile(rf"{own}(?:{behind}|{before})|{other}\d{{3}}[.,]")


_SHOWING = {sign: _showing(sign) for sign in _OTHER}


def shown_signs(cells: Sequence[str]) -> set[str]:
    """Returns the signs that cells show to be decimal ones."""
    text = "\n".join(["", *cells])
    if "." not in text and "," not in text:
        return set()
    return {sign for sign in _SHOWING if _SHOWING[sign].search(text)}


def decimal_signs(
    columns: Mapping[str, Sequence[str]], names: Mapping[str, str], delimiter: str
) -> tuple[dict[str, str], list[str]]:
    """Returns the decimal sign of each quantity, and notes on those that do not show it themselves.

    columns: the cells of each quantity that has numbers. names: the names of their columns. delimiter: the sign between
    the cells.
    Raises Unusable for columns that show both signs.
    """
    shown = {quantity: shown_signs(cells) for quantity, cells in columns.items()}
    of_file = set().union(*shown.values())
    found: dict[str, str] = {}
    notes: list[str] = []
    problems: list[str] = []
    doubtful: dict[str, tuple[str, str]] = {}
    for quantity, cells in columns.items():
        name = names[quantity]
        there = _first_with_sign(cells)
        signs = shown[quantity] or (of_file if len(of_file) == 1 else set())
        if len(signs) == 1:
            found[quantity] = next(iter(signs))
            thousands = there.get(_OTHER[found[quantity]])
            if thousands is not None and not shown[quantity]:
                what, decimal_sign = _CALLED[_OTHER[found[quantity]]], _CALLED[found[quantity]]
                notes.append(
                    f"The {what} of {name} ({thousands.strip()!r}) was taken to separate thousands, as the decimal "
                    f"sign of other columns is the {decimal_sign}."
                )
        elif len(there) == 2:
            written = " and ".join(repr(cell.strip()) for cell in there.values())
            problems.append(
                f"{name} has numbers with point and with comma: {written}; write one decimal sign throughout"
            )
        elif there:
            (sign, cell), *_ = there.items()
            found[quantity], note = _in_doubt(name, cells, sign, cell.strip(), delimiter)
            notes += [note] if note else []
            doubtful[found[quantity]] = (name, cell.strip())
        else:
            found[quantity] = "."
    if len(doubtful) == 2 and delimiter != ",":
        written = " and ".join(f"{name} has {cell!r}" for name, cell in doubtful.values())
        problems.append(f"{written}: one of the signs separates thousands, and no number shows which; leave it out")
    if problems:
        raise Unusable(*problems)
    return found, notes


def _first_with_sign(cells: Sequence[str]) -> dict[str, str]:
    text = "\n".join(cells)
    return {sign: next(each for each in cells if sign in each) for sign in _OTHER if sign in text}


def _in_doubt(name: str, cells: Sequence[str], sign: str, cell: str, delimiter: str) -> tuple[str, str]:
    """The decimal sign of a column in which three digits follow every sign, and a note on how it was read.

    Beside numbers without a sign one of the readings may jump by a thousand from a sample to the next: the other one
    is taken. Else the sign is the decimal one, which a comma is not where commas separate the cells.
    """
    what = f"The {_CALLED[sign]} of {name} ({cell!r}) was taken "
    signed = np.array([sign in each for each in cells])
    as_decimal, as_thousands = (_jumps(numbers(cells, each)[0], signed) for each in (sign, _OTHER[sign]))
    if as_decimal != as_thousands:
        decimal = sign if as_thousands else _OTHER[sign]
        how = "for the decimal sign" if as_thousands else "to separate thousands"
        return decimal, f"{what}{how}: otherwise values would jump by a thousand from a sample to the next."
    if delimiter != ",":
        return (
            sign,
            f"{what}for the decimal sign, which no number of it shows; if it separates thousands, leave it out.",
        )
    if sign == ",":
        return (
            ".",
            f"{what}to separate thousands, which no number of it shows; if it is the decimal sign, write a point.",
        )
    return sign, ""


def _jumps(values: Reals, signed: np.ndarray) -> bool:
    """Whether a number with a sign and one without, side by side, are a thousand times as large as each other."""
    there = np.isfinite(values) & (values != 0.0)
    sizes, signed = np.abs(values[there]), signed[there]
    between = signed[1:] != signed[:-1]
    ratios = np.maximum(sizes[1:] / sizes[:-1], sizes[:-1] / sizes[1:])[between]
    return bool(np.any((ratios > _JUMP[0]) & (ratios < _JUMP[1])))

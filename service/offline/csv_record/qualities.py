"""Columns of qualities: which values of MV, PV and SP a historian or an OPC server marks as bad."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from loopwright.service.offline.csv_record.columns import split_unit
from loopwright.service.offline.csv_record.errors import number_of
from loopwright.service.offline.csv_record.numbers import BAD_STATES, numbers

_NAME = re.compile(r"^(?:(?P<of>.+)[.:/_\s-]+)?(?:quality|quality ?code|status)$|^(?P<tag>.+)[.:/_\s-]+q$")
"""Names of such columns; Q alone may be a flow of heat."""
_BAD = re.compile(r"^(?:bad|invalid|not good)(?![a-z])")
_GOOD_CODE, _BAD_BELOW, _MAX_CODE = 128, 64, 255
"""Codes of OPC and of PROFIBUS: from 128 on the value is good, from 64 on uncertain, below it is bad."""


def bad_values(
    at: Mapping[str, int], names: Sequence[str], rows: Sequence[Sequence[str]]
) -> tuple[dict[str, NDArray[np.bool_]], list[str]]:
    """Returns for each quantity which of its values are marked as bad, and a note for each column that marks some.

    at: the columns of the quantities. names: the names of all columns. rows: the cells of the samples.
    A column of qualities belongs to the quantity whose name it begins with. One without such a name belongs to the
    quantity in the column before where there are several, and to the whole line where it is the only one.
    """
    measured = {quantity: place for quantity, place in at.items() if quantity != "t"}
    bare = [split_unit(name)[0] for name in names]
    found = {
        i: each["of"] or each["tag"] or ""
        for i, name in enumerate(bare)
        if i not in at.values() and (each := _NAME.match(name))
    }
    alone = list(found.values()).count("") == 1
    bad = {quantity: np.zeros(len(rows), dtype=bool) for quantity in measured}
    notes: list[str] = []
    for column, of in found.items():
        if of:
            belongs = [quantity for quantity, place in measured.items() if bare[place] == of]
        else:
            belongs = [quantity for quantity, place in measured.items() if alone or place == column - 1]
        marked = _marked([row[column].strip() for row in rows])
        for quantity in belongs:
            bad[quantity] |= marked
        if belongs and (count := int(np.count_nonzero(marked))):
            whose = " and ".join(names[measured[quantity]].strip() for quantity in belongs)
            lines = number_of(count, "line marks", "lines mark")
            notes.append(f"{lines} {whose} as bad ({names[column].strip()}): no value was taken from there.")
    return bad, notes


def _marked(cells: Sequence[str]) -> NDArray[np.bool_]:
    """Which cells say that a value is bad: in a word, or by a code where another one of the column is that of good."""
    codes, wrong = numbers(cells, ".")
    if not wrong and _GOOD_CODE <= float(np.max(np.nan_to_num(codes))) <= _MAX_CODE:
        return np.asarray(codes < _BAD_BELOW)
    words = [cell.lower() for cell in cells]
    return np.array([word in BAD_STATES or _BAD.match(word) is not None for word in words])

"""The cells of a file: which sign separates them, where the names of the columns are, and where the samples begin."""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from loopwright.service.offline.csv_record.columns import NAMES, Columns, find_columns
from loopwright.service.offline.csv_record.errors import Unusable, counted
from loopwright.service.offline.csv_record.numbers import is_missing, is_number
from loopwright.service.offline.csv_record.time_units import seconds_in

DELIMITERS = (",", ";", "\t", " ")
MAX_HEADER_LINES = 30
"""Lines among which that of the column names is looked for: reports have a title and tags above it."""
MAX_UNIT_LINES = 3
MAX_UNIT = 12
"""Characters of the longest text that is taken for a unit."""


@dataclass(frozen=True, slots=True)
class Table:
    """The cells of the samples.

    columns: where the quantities are.
    delimiter: the sign between the cells.
    lines: the number of the line of each sample.
    rows: the cells of each sample.
    skipped: the number of lines above the column names that were not used.
    problems: what is wrong with lines that are not among the samples.
    """

    columns: Columns
    delimiter: str
    lines: list[int]
    rows: list[list[str]]
    skipped: int
    problems: tuple[str, ...]


def read_table(text: str, chosen: Mapping[str, str]) -> Table:
    """Returns the cells in the text of a file.

    chosen: the column that the user names for a quantity, by its name or its number.
    Raises Unusable, with all errors at once.
    """
    lines = [(number, line) for number, line in enumerate(text.splitlines(), start=1) if _counts(line)]
    if not lines:
        raise Unusable("is empty: a line of column names and a line for each sample are needed")
    columns, delimiter, at = _header(lines, chosen)
    width = len(columns.names)
    body = lines[at:] if _is_sample(_cells(lines[at][1], delimiter), columns) else lines[at + 1 :]
    wrong: list[int] = []
    kept: list[int] = []
    rows: list[list[str]] = []
    for (line, _), cells in zip(body, _all_cells([text for _, text in body], delimiter), strict=True):
        if (fitted := cells if len(cells) == width else _fitted(cells, width, delimiter)) is None:
            wrong.append(line)
        else:
            kept.append(line)
            rows.append(fitted)
    if wrong and wrong[-1] == body[-1][0] and len(_cells(body[-1][1], delimiter)) == 1:
        wrong.pop()  # "EOF", "120 rows": the end of a report
    short = f"values are missing, or too many: line {lines[at][0]} names {width} columns"
    many = f"lines have too few values or too many for the {width} columns"
    problems = [counted(wrong, short, many)] if wrong else []
    described = 0
    while described < min(MAX_UNIT_LINES, len(rows)) and not _is_sample(rows[described], columns):
        described += 1
    if described < len(rows):  # else nothing is a sample, and the errors of the cells say why
        columns = replace(columns, units=_units(rows[:described], columns))
        kept, rows = kept[described:], rows[described:]
    if not rows:
        raise Unusable(*problems or ["has column names but no samples"])
    return Table(columns, delimiter, kept, rows, at, tuple(problems))


def _counts(line: str) -> bool:
    return bool(line.strip()) and not line.lstrip().startswith("#")


def _header(lines: Sequence[tuple[int, str]], chosen: Mapping[str, str]) -> tuple[Columns, str, int]:
    """The columns, the delimiter and the place of the line of names: the first line that names all that is needed."""
    problems: tuple[str, ...] = ()
    for at, (place, line) in enumerate(lines[:MAX_HEADER_LINES]):
        for delimiter in sorted(DELIMITERS, key=line.count, reverse=True):
            if delimiter not in line:
                continue
            try:
                return find_columns(_cells(line, delimiter), chosen, place), delimiter, at
            except Unusable as error:
                if not problems or len(error.problems) < len(problems):
                    problems = error.problems
    alone = f"line {lines[0][0]}: one column alone; comma, semicolon or tab separate columns"
    raise Unusable(*(dict.fromkeys(problems) or [alone]))


def _cells(line: str, delimiter: str) -> list[str]:
    return _all_cells([line], delimiter)[0]


def _all_cells(lines: Sequence[str], delimiter: str) -> list[list[str]]:
    if delimiter == " ":
        return [line.split() for line in lines]
    return [next(csv.reader([line], delimiter=delimiter, skipinitialspace=True), []) for line in lines]


def _fitted(cells: list[str], width: int, delimiter: str) -> list[str] | None:
    """The cells of a line with delimiters too many or one too few at its end; None where the values do not fit.

    Between spaces no cell is empty: of a value that is missing nothing shows that it was the last one."""
    if len(cells) > width and not any(cell.strip() for cell in cells[width:]):
        return cells[:width]
    return [*cells, ""] if len(cells) == width - 1 and width > 2 and delimiter != " " else None


def _is_sample(cells: Sequence[str], columns: Columns) -> bool:
    """Whether a line has a number for the time, MV or PV, or says that there is none."""
    if len(cells) < max(columns.at.values()) + 1:
        return False
    if is_number(cells[columns.at["t"]]):
        return True
    for quantity in ("u", "y"):
        cell = cells[columns.at[quantity]]
        if cell.strip() and (is_missing(cell) or is_number(cell)):
            return True
    return False


def _units(rows: Sequence[Sequence[str]], columns: Columns) -> dict[str, str]:
    """The units behind the names of the columns, else those in the lines below the names."""
    if not rows:
        return dict(columns.units)
    cells = {quantity: _bare(rows[0][place]) for quantity, place in columns.at.items() if quantity != "t"}
    units = {quantity: cell for quantity, cell in cells.items() if cell and len(cell) <= MAX_UNIT}
    units.update(columns.units)
    if unit := _time_unit([columns.units.get("t", ""), *(_bare(row[columns.at["t"]]) for row in rows)]):
        units["t"] = unit
    return units


def _time_unit(cells: Sequence[str]) -> str:
    """The first known unit of time in cells of which some describe the column, else the first that may claim to be one,
    whatever its length: an unknown unit must not be taken for s."""
    said = [cell for cell in cells if cell and cell.lower() not in NAMES["t"]]
    return next((cell for cell in said if seconds_in(cell) is not None), said[0] if said else "")


def _bare(cell: str) -> str:
    return cell.strip().strip("[](){}")

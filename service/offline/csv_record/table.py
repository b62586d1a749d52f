"""The cells of a file: which sign separates them, where the names of the columns are, and where the samples begin."""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from loopwright.service.offline.csv_record.columns import NAMES, ONE_VALUE, Columns, find_columns
from loopwright.service.offline.csv_record.errors import Unusable, counted
from loopwright.service.offline.csv_record.numbers import is_missing, is_moment, is_number
from loopwright.service.offline.csv_record.time_units import seconds_in
from loopwright.service.offline.csv_record.words import is_on_or_off, plain

DELIMITERS = ("\t", ";", "|", ",", " ")
"""Signs that separate cells; the first one that suits most lines is taken, so that a comma between blanks separates."""
LOOKED_AT = 400
"""Lines among which the samples are looked for: reports have titles, tags and settings above them."""
MANY_SAMPLES = 50
"""Lines with samples that are enough to tell the sign between the cells."""
IN_A_ROW = 5
"""Lines from the first sample on, most of which are samples too."""
MAX_UNIT_LINES = 3
MAX_UNIT = 12
"""Characters of the longest text that is taken for a unit."""
MAX_SHOWN = 50
_COMMENTS = ("#", "%", "//")
_LABELS = frozenset(
    {
        "unit", "units", "einheit", "einheiten", "unite", "unites", "unidad", "unidades", "eu", "uom", "eng units",
        "double", "float", "real", "int", "integer", "number", "datetime", "string",
    }
)  # fmt: skip
"""What stands below the name of the time, before the units or the types of the other columns, as `plain` makes it, and
is no unit."""
_OTHER_TEXTS = (
    ("<?xml", "XML"), ("<", "a page in HTML or XML"), ("{\\rtf", "RTF"), ("{", "JSON"), ("[{", "JSON"),
)  # fmt: skip
"""How texts begin that are in another format."""
NO_TABLE = (
    "is not a table of measurements: {why}. A line for each time is needed, with the time, MV and PV side by side; "
    "export the trend of the loop as CSV"
)


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


def read_table(text: str, chosen: Mapping[str, str], timed: bool = True) -> Table:
    """Returns the cells in the text of a file.

    chosen: the column that the user names for a quantity, by its name or its number. timed: whether a column of the
    time is needed.
    Raises Unusable, with all errors at once.
    """
    every = [(number, line) for number, line in enumerate(text.splitlines(), start=1) if line.strip()]
    lines = [(number, line) for number, line in every if not line.lstrip().startswith(_COMMENTS)]
    if not lines:
        raise Unusable("is empty: a line of column names and a line for each sample are needed")
    if each := _other_text(lines[0][1]):
        raise Unusable(NO_TABLE.format(why=f"it is {each}"))
    columns, delimiter, at, start = _header(lines, every, chosen, timed)
    width = len(columns.names)
    body = lines[max(at, 0) :] if at < 0 or _is_sample(_cells(lines[at][1], delimiter), columns) else lines[at + 1 :]
    named = lines[max(at, 0)][0]
    wrong: list[int] = []
    kept: list[int] = []
    rows: list[list[str]] = []
    for (line, _), cells in zip(body, _all_cells([text for _, text in body], delimiter), strict=True):
        if (fitted := cells if len(cells) == width else _fitted(cells, width, delimiter)) is None:
            wrong.append(line)
        else:
            kept.append(line)
            rows.append(fitted)
    wrong = [line for line in wrong if line >= start]
    if wrong and wrong[-1] == body[-1][0] and len(_cells(body[-1][1], delimiter)) == 1:
        wrong.pop()  # "EOF", "120 rows": the end of a report
    short = f"values are missing, or too many: line {named} names {width} columns"
    many = f"lines have too few values or too many for the {width} columns"
    which = "it" if len(wrong) == 1 else "them"
    problems = [f"{counted(wrong, short, many)}; complete or delete {which}"] if wrong else []
    described, most = 0, max(MAX_UNIT_LINES, sum(line < start for line in kept))
    while described < min(most, len(rows)) and not _is_sample(rows[described], columns):
        described += 1
    if described < len(rows):  # else nothing is a sample, and the errors of the cells say why
        columns = replace(columns, units=_units(rows[:described], columns))
        kept, rows = kept[described:], rows[described:]
    if not rows:
        raise Unusable(*problems or ["has column names but no samples"])
    return Table(columns, delimiter, kept, rows, max(at, 0), tuple(problems))


def _other_text(line: str) -> str:
    """What a text is that begins with this line, where it is another format; "" else."""
    start = line.lstrip("\ufeff \t").casefold()
    for mark, named in (
        ("<?xml", "XML"),
        ("<", "a page in HTML or XML"),
        ("{", "JSON"),
        ("[{", "JSON"),
        ("%pdf", "a PDF"),
    ):
        if start.startswith(mark):
            return named
    return ""


def _header(
    lines: Sequence[tuple[int, str]], every: Sequence[tuple[int, str]], chosen: Mapping[str, str], timed: bool
) -> tuple[Columns, str, int, int]:
    """The columns, the delimiter, the place of the line of names (-1: in a comment), and the line of the first sample.

    The names are in the last line above the samples that names all that is needed; where columns are chosen by their
    numbers, in the first of the lines above the samples that are as wide as they.
    """
    found = _samples(lines)
    if found is None:
        return _named_without_samples(lines, chosen, timed)
    first, delimiter = found
    start = lines[first][0]
    width = len(_cells(lines[first][1], delimiter))
    wide = [at for at in range(first) if len(_cells(lines[at][1], delimiter)) in (width, width - 1)]
    above = wide[::-1] + [at for at in range(first - 1, -1, -1) if at not in wide]
    if all(chosen.get(quantity, "").strip().isdigit() for quantity in (("t", "u", "y") if timed else ("u", "y"))):
        full = [at for at in wide if all(cell.strip() for cell in _cells(lines[at][1], delimiter))]
        above = [*full, *above]
    tried: list[tuple[int, tuple[str, ...]]] = []
    for at in [*above, first]:
        place, line = lines[at]
        for sign in (delimiter, *(each for each in DELIMITERS if each != delimiter and each in line)):
            cells = _cells(line, sign)
            if len(cells) < 2 or (sign != delimiter and len(cells) != width):
                continue
            try:
                columns = find_columns(cells, chosen, place, timed)
                if at == first and all(is_number(cell) for cell in cells if cell.strip()):
                    columns = replace(columns, names=[f"column {i + 1}" for i in range(len(cells))])
                return columns, delimiter, at, start
            except Unusable as error:
                tried.append((at, error.problems))
    for place, line in reversed(every):
        if place < start and (bare := line.lstrip().lstrip("".join(_COMMENTS))) != line.lstrip():
            try:
                columns = find_columns(_cells(bare.strip(), delimiter), chosen, place, timed)
            except Unusable:
                continue
            if len(columns.names) == width:
                return columns, delimiter, first - 1 if first else -1, start
    raise _no_names(lines, tried, wide or [first], delimiter, first)


def _no_names(
    lines: Sequence[tuple[int, str]],
    tried: Sequence[tuple[int, tuple[str, ...]]],
    likely: Sequence[int],
    delimiter: str,
    first: int,
) -> Unusable:
    """What is wrong with the likeliest line of names. tried: the errors of each line that was read as one."""
    one_value = any(ONE_VALUE in problem for _, problems in tried for problem in problems)
    figures = sorted(_figures(_cells(line, delimiter)) for _, line in lines[first : first + MANY_SAMPLES])
    if figures[len(figures) // 2] < 2 and not one_value:
        return Unusable(NO_TABLE.format(why=f"line {lines[first][0]} has no two numbers side by side"))
    of_likely = [problems for at, problems in tried if at in likely] or [problems for _, problems in tried]
    fewest = min(of_likely, key=len)
    return Unusable(*dict.fromkeys(fewest))


def _named_without_samples(
    lines: Sequence[tuple[int, str]], chosen: Mapping[str, str], timed: bool
) -> tuple[Columns, str, int, int]:
    """The columns of a file in which no line has numbers side by side; its names tell what is wrong with it."""
    problems: tuple[str, ...] = ()
    for at, (place, line) in enumerate(lines[:LOOKED_AT]):
        for delimiter in DELIMITERS:
            if delimiter not in line:
                continue
            try:
                return find_columns(_cells(line, delimiter), chosen, place, timed), delimiter, at, place
            except Unusable as error:
                if not problems or len(error.problems) < len(problems):
                    problems = error.problems
    if len(lines) > 1 or not problems:
        place, line = lines[0]
        shown = line.strip() if len(line.strip()) <= MAX_SHOWN else line.strip()[:MAX_SHOWN] + "..."
        raise Unusable(NO_TABLE.format(why=f"line {place} is {shown!r}, and no line has numbers side by side"))
    raise Unusable(*problems)


def _samples(lines: Sequence[tuple[int, str]]) -> tuple[int, str] | None:
    """The place of the first line with samples, and the sign between the cells; None where no line has any."""
    best: tuple[float, int, str] | None = None
    for delimiter in DELIMITERS:
        places: dict[int, list[int]] = {}
        parts: dict[int, float] = {}
        for at, (_, line) in enumerate(lines[:LOOKED_AT]):
            if delimiter in line and (part := _part_of_values(cells := _cells(line, delimiter))):
                places.setdefault(len(cells), []).append(at)
                parts[len(cells)] = parts.get(len(cells), 0.0) + part
                if len(places[len(cells)]) == MANY_SAMPLES:
                    break
        for width, found in places.items():
            if best is None or parts[width] > best[0]:
                best = (parts[width], _first_in_a_row(found, min(len(lines), LOOKED_AT)), delimiter)
    return None if best is None else best[1:]


def _first_in_a_row(places: Sequence[int], end: int) -> int:
    """The first of the places that most of the lines after it are among, unlike a setting above the samples."""
    those = set(places)
    for at in places:
        following = range(at, min(at + IN_A_ROW, end))
        if sum(each in those for each in following) > 0.7 * len(following):
            return at
    return places[0]


def _part_of_values(cells: Sequence[str]) -> float:
    """The part of the cells of a line that are values; 0 for a line without two of them, or with more words."""
    there = [cell for cell in cells if cell.strip()]
    values = sum(is_number(cell) or is_missing(cell) or is_on_or_off(cell) or is_moment(cell) for cell in there)
    return values / len(there) if _figures(cells) >= 1 and values >= 2 and 2 * values >= len(there) else 0.0


def _figures(cells: Sequence[str]) -> int:
    return sum(is_number(cell) or is_on_or_off(cell) for cell in cells)


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
    if "t" in columns.at and is_number(cells[columns.at["t"]]):
        return True
    for quantity in ("u", "y"):
        cell = cells[columns.at[quantity]]
        if cell.strip() and (is_missing(cell) or is_number(cell)):
            return True
    return is_on_or_off(cells[columns.at["u"]])


def _units(rows: Sequence[Sequence[str]], columns: Columns) -> dict[str, str]:
    """The units behind the names of the columns, else those in the lines below the names."""
    if not rows:
        return dict(columns.units)
    cells = {quantity: _bare(rows[0][place]) for quantity, place in columns.at.items() if quantity != "t"}
    units = {quantity: cell for quantity, cell in cells.items() if cell and len(cell) <= MAX_UNIT}
    units.update(columns.units)
    said = [_bare(row[columns.at["t"]]) for row in rows] if "t" in columns.at else []
    if unit := _time_unit([columns.units.get("t", ""), *said]):
        units["t"] = unit
    return units


def _time_unit(cells: Sequence[str]) -> str:
    """The first known unit of time in cells of which some describe the column, else the first that may claim to be one,
    whatever its length: an unknown unit must not be taken for s."""
    no_units = {*NAMES["t"], *_LABELS}
    said = [cell for cell in cells if any(map(str.isalpha, cell)) and plain(cell.rstrip(":")) not in no_units]
    return next((cell for cell in said if seconds_in(cell) is not None), said[0] if said else "")


def _bare(cell: str) -> str:
    return cell.strip().strip("[](){}")

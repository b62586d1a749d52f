"""Reads a recorded test of a loop from a file: time, MV and PV, optionally the set-point.

    Timestamp;MV (%);PV (degC)          the names that control systems, historians and spreadsheets use
    25.11.2026 10:00:00;35,0;61,24      numbers with decimal point or comma, times with or without a date

All errors of a file are reported at once, each kind with its number and its first lines.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from loopwright.service.offline.csv_record.decimal_signs import decimal_signs, shown_signs
from loopwright.service.offline.csv_record.errors import RecordError, Unusable, counted, number_of
from loopwright.service.offline.csv_record.numbers import numbers, without_unit
from loopwright.service.offline.csv_record.qualities import bad_values
from loopwright.service.offline.csv_record.sampling import sampled
from loopwright.service.offline.csv_record.table import Table, read_table
from loopwright.service.offline.csv_record.text import decoded
from loopwright.service.offline.csv_record.time_units import WEEK, seconds_in
from loopwright.service.offline.csv_record.times import are_numbers, seconds
from loopwright.service.offline.csv_record.words import TWO_STATES, plain, switched
from loopwright.tuning.models import Reals


@dataclass(frozen=True, slots=True)
class ReadOptions:
    """How a file is to be read, where that is not to be found out.

    columns: the column of a quantity (t, u, y, sp), by its name or its number from 1 on.
    time_format: how times are written, as `datetime.strptime` describes it.
    resample_s: the sample time that the samples are brought to, s.
    every_s: the time from each line to the next, s, of a file without times.
    time_unit: the unit of times that are numbers, a word of `time_units`.
    hold: whether PV holds its value until the next one where samples are made; None: as the record shows.
    """

    columns: Mapping[str, str] = field(default_factory=dict)
    time_format: str | None = None
    resample_s: float | None = None
    every_s: float | None = None
    time_unit: str | None = None
    hold: bool | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Record:
    """The samples of a recorded test, all of shape (N,), finite, and evenly spaced.

    t: time, s, increasing.
    u: MV, MV units.
    y: PV, PV units.
    sp: set-point, PV units; None if the file has none.
    units: the unit of u, y and sp where the file names it.
    names: the column that u, y and sp were read from; that of sp also where it was left out for want of values.
    notes: what was changed when the file was read, one sentence each.
    u_before: MV before the first sample, where the file shows it, MV units.
    """

    t: Reals
    u: Reals
    y: Reals
    sp: Reals | None = None
    units: Mapping[str, str] = field(default_factory=dict)
    names: Mapping[str, str] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    u_before: float | None = None

    @property
    def without_setpoint(self) -> str:
        """Why there is no set-point, as the end of a sentence."""
        if "sp" not in self.names:
            return "the file has no column of SP"
        return f"the column of SP ({self.names['sp']}) lacks too many values"


def load_record(path: Path, options: ReadOptions = ReadOptions()) -> Record:
    """Returns the record in a file. Raises RecordError for a file that cannot be read or used."""
    try:
        text = decoded(path.read_bytes())
    except OSError as error:
        raise RecordError(str(path), [f"cannot be read: {error.strerror}"]) from None
    except Unusable as error:
        raise RecordError(str(path), error.problems) from None
    return parse_record(text, str(path), options)


def parse_record(text: str, source: str, options: ReadOptions = ReadOptions()) -> Record:
    """Returns the record in the text of a file. Raises RecordError, in which `source` names the file."""
    try:
        return _record(read_table(text, options.columns, options.every_s is None), options)
    except Unusable as error:
        raise RecordError(source, error.problems) from None


def _record(table: Table, options: ReadOptions) -> Record:
    at, names = table.columns.at, table.columns.names
    values: dict[str, Reals] = {}
    problems = list(table.problems)
    called = {quantity: names[place].strip() for quantity, place in at.items()}
    cells = {quantity: [row[place] for row in table.rows] for quantity, place in at.items()}
    units, notes = dict(table.columns.units), _switched(called["u"], cells)
    for quantity in ("u", "y", "sp"):
        if quantity in cells and (parted := without_unit(cells[quantity])):
            cells[quantity], units[quantity] = parted
    if "t" in at:
        cells["t"] = _time_cells(table)
        if (parted := without_unit(cells["t"])) and seconds_in(parted[1]) is not None:
            cells["t"], units["t"] = parted
        called["t"] = called["t"] or "the first column"
    numeric = {each: cells[each] for each in cells if each != "t" or are_numbers(cells["t"], options.time_format)}
    decimal, doubts = decimal_signs(numeric, called, table.delimiter)
    bad, marked = bad_values(at, names, table.rows)
    notes += doubts + marked
    for quantity in ("u", "y", "sp"):
        if quantity in at:
            values[quantity], wrong = numbers(cells[quantity], decimal[quantity])
            problems += _no_numbers(called[quantity], cells[quantity], [table.lines[i] for i in wrong], wrong)
            if options.resample_s is not None and quantity != "y":
                notes += _held(called[quantity], cells[quantity], values[quantity], table.lines)
            values[quantity][bad[quantity]] = np.nan
    try:
        unit = options.time_unit or units.get("t", "")
        t = _times(table, options, cells.get("t", []), unit, called.get("t", ""), decimal.get("t", "."))
    except Unusable as error:
        problems = [*error.problems, *problems]
    if problems:
        raise Unusable(*problems)
    if "t" in numeric and units.get("t") and float(np.ptp(t)) > WEEK:
        notes.append(
            f"The record is {float(np.ptp(t)) / 86400.0:.3g} d long by {called['t']} in {unit}: check the unit; "
            "--time-unit reads another one."
        )
    found = sampled(t, values, table.lines, options.resample_s, options.hold)
    notes += found.notes
    if table.skipped:
        above = "line" if table.skipped == 1 else "lines"
        notes.insert(0, f"{table.skipped} {above} above the names of the columns were not used.")
    columns = found.columns
    used = {quantity: called[quantity] for quantity in values}
    units = {quantity: unit for quantity, unit in units.items() if quantity in values}
    return Record(found.t, columns["u"], columns["y"], columns.get("sp"), units, used, tuple(notes), found.u_before)


def _times(table: Table, options: ReadOptions, cells: list[str], unit: str, name: str, decimal: str) -> Reals:
    """The times of the lines, s."""
    if options.every_s is not None:
        return np.asarray(options.every_s * np.arange(len(table.rows)), dtype=np.float64)
    if options.time_unit is not None and not are_numbers(cells, options.time_format):
        raise Unusable(f"--time-unit is for times that are numbers; {name} has {cells[0].strip()!r}: leave it out")
    t = seconds(cells, table.lines, unit, options.time_format, name, decimal)
    return t + _milliseconds(table)


def _switched(name: str, cells: dict[str, list[str]]) -> list[str]:
    """A note on MV that is written as on and off, whose cells become 1 and 0."""
    found = switched(cells["u"])
    if found is None:
        return []
    cells["u"], said = found
    return [f"{name} was read as a number: {said}."]


def _no_numbers(name: str, cells: list[str], lines: list[int], wrong: list[int]) -> list[str]:
    if not wrong:
        return []
    given = cells[wrong[0]].strip()
    many = f"values of {name} are not numbers, such as {given!r}"
    two_states = plain(given) in TWO_STATES
    hint = "write numbers, such as 1 for open and 0 for closed" if two_states else "leave cells without a value empty"
    return [counted(lines, f"{name} is not a number: {given!r}", many) + f": {hint}"]


def _held(name: str, cells: list[str], values: Reals, lines: Sequence[int]) -> list[str]:
    """A note on the words in place of values of MV or SP, which hold their value meanwhile; empty cells are usual."""
    words = [i for i, cell in enumerate(cells) if cell.strip() and np.isnan(values[i])]
    if not words:
        return []
    given = cells[words[0]].strip()
    return [
        f"{number_of(len(words), 'line has', 'lines have')} no value of {name}, such as {given!r} in line "
        f"{lines[words[0]]}: the value before was held there, whatever it was in truth."
    ]


def _time_cells(table: Table) -> list[str]:
    at, date = table.columns.at["t"], table.columns.date
    if date is None:
        return [row[at] for row in table.rows]
    return [f"{row[date].strip()} {row[at].strip()}" for row in table.rows]


def _milliseconds(table: Table) -> Reals | float:
    """What the column of milliseconds adds to the times, s."""
    columns = table.columns
    if columns.milliseconds is None or columns.milliseconds == columns.at["t"]:
        return 0.0
    cells = [row[columns.milliseconds] for row in table.rows]
    fractions, wrong = numbers(cells, "," if "," in shown_signs(cells) else ".")
    if wrong or not np.all((fractions >= 0.0) & (fractions < 1000.0)):
        return 0.0
    return fractions / 1000.0

"""Shows what was read from a file before anything is computed with it."""

from __future__ import annotations

import numpy as np

from loopwright.service.api.report.numbers import duration
from loopwright.service.cli.terminal import console
from loopwright.service.offline.csv_record.record import Record
from loopwright.tuning.models import Reals

_NAMES = {"u": "MV", "y": "PV", "sp": "SP"}


def read(record: Record) -> None:
    """Shows how many samples the record has, its length, the ranges of its columns, and what was changed."""
    console.print(in_words(record), highlight=False)
    for note in record.notes:
        console.print(f"note: {note}", highlight=False)


def in_words(record: Record) -> str:
    """Returns the record in a line, such as "400 samples every 5 s, 33 min; MV 30..40 %, PV 60..68 degC"."""
    samples = f"{len(record.t)} samples"
    if len(record.t) > 1:
        length = float(record.t[-1] - record.t[0])
        samples += f" every {length / (len(record.t) - 1):.4g} s, {duration(length)}"
    columns = {"u": record.u, "y": record.y, **({} if record.sp is None else {"sp": record.sp})}
    return f"{samples}; " + ", ".join(_range(record, name, values) for name, values in columns.items())


def _range(record: Record, name: str, values: Reals) -> str:
    low, high = float(np.min(values)), float(np.max(values))
    shown = f"{low:.4g}" if low == high else f"{low:.4g}..{high:.4g}"
    column, unit = record.names.get(name, ""), record.units.get(name, "")
    called = _NAMES[name]
    if column.lower() not in ("", name, called.lower()) and not column.lower().startswith(f"{called.lower()} ("):
        called += f" ({column})"
    return f"{called} {shown}" + (f" {unit}" if unit else "")

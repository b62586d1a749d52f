"""What the commands share of the terminal: its two outputs, tables, numbers and times as text."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator
from datetime import datetime
from math import inf

from pydantic import BaseModel
from rich.console import Console
from rich.table import Table

# What users have written is shown as it is: "[V-12]" is no style, and ":smile:" no picture.
console = Console(markup=False, emoji=False)
progress_console = Console(stderr=True, markup=False, emoji=False)


def leaves(value: object, key: str = "") -> Iterator[tuple[str, int | float | str]]:
    if isinstance(value, dict):
        for name, item in value.items():
            yield from leaves(item, name)
    elif isinstance(value, int | float | str) and value != "":
        yield key, value


def number(value: object) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def figure(part: BaseModel | None, name: str) -> str:
    """Returns one figure of a part of a result as text, "-" where there is no such part."""
    return cell(None if part is None else getattr(part, name))


def cell(value: object) -> str:
    """Returns a value as text, "-" for None."""
    return "-" if value is None else number(value)


def ago(at: str, now: datetime) -> str:
    """Returns how long ago something was, in words; the time itself where the clock of this machine is behind it.

    at: the time in the form of ISO 8601. now: the present time.
    """
    passed = (now - datetime.fromisoformat(at)).total_seconds()
    for seconds, unit, largest in ((1.0, "s", 60.0), (60.0, "min", 60.0), (3600.0, "h", 48.0), (86400.0, "days", inf)):
        if passed > -1.0 and passed / seconds < largest:
            return f"{int(max(passed, 0.0) / seconds)} {unit} ago"
    return at


def rows(
    title: str, headings: Iterable[str], lines: Iterable[Iterable[object]], never_cut: Collection[str] = ()
) -> None:
    """Shows a table with a row for each line.

    never_cut: the headings of the columns that stay on one line, however narrow the terminal is.
    """
    table = Table(title=title)
    for heading in headings:
        table.add_column(heading, no_wrap=heading in never_cut)
    for line in lines:
        table.add_row(*map(cell, line))
    console.print(table)

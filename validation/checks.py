"""What is compared: printed numbers in rows and tables, claims in words, and the verdict on each.

A printed number is reproduced, or it has a cause why not. A cause alone is not enough: our number must then agree with
what an independent calculation gave, and must not agree with the print, so that no excuse outlives its reason.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from enum import StrEnum

PRINTED = "printed"


class Verdict(StrEnum):
    """AGREES: with an independent calculation, where the paper prints nothing.  GIVEN: an input, taken from the print.

    LOST: the paper does not say what it would be computed from.
    """

    REPRODUCED = "reproduced"
    AGREES = "agrees"
    EXPLAINED = "explained"
    LOST = "cannot be recomputed"
    GIVEN = "given"
    FAILED = "failed"


@dataclass(frozen=True, slots=True)
class Tolerance:
    """Whichever is more of an absolute one, in the unit of what is compared, and one relative to the reference."""

    reason: str
    absolute: float = 0.0
    relative: float = 0.0

    def holds(self, found: float, reference: float) -> bool:
        # a print cut to 0.29 may be as far off as one unit of its last digit and the rounding of binary numbers
        allowed = max(self.absolute, self.relative * abs(reference)) * (1.0 + 1e-9)
        return math.isfinite(found) and abs(found - reference) <= allowed

    def in_words(self, unit: str) -> str:
        # of a percentage a relative tolerance is in percent as well
        absolute = unit if unit != "%" else "point" if self.absolute == 1.0 else "points"
        parts = [f"{self.absolute:g} {absolute}".rstrip()] if self.absolute else []
        parts += [f"{100.0 * self.relative:g} %"] if self.relative else []
        return " or ".join(parts)


@dataclass(frozen=True, slots=True)
class Column:
    """One quantity of a table.

    decimals: how many the tolerance supports; a print with more is shown as it is.  tolerance: to the print.  own: to
    the independent calculation where the print is not met, by default the same.
    """

    name: str
    decimals: int
    tolerance: Tolerance
    unit: str = ""
    own: Tolerance | None = None

    def show(self, value: float | None) -> str:
        """Rounded."""
        if value is None:
            return "–"
        shown = f"{value:.{self.decimals}f}"
        return shown.removeprefix("-") if float(shown) == 0.0 else shown

    def as_printed(self, value: float | None) -> str:
        """With all its own decimals, at least as many as ours has."""
        own = len(repr(float(value)).partition(".")[2]) if value is not None else 0
        return f"{value:.{own}f}" if own > self.decimals else self.show(value)

    def verdict(self, cell: Cell) -> Verdict:
        if cell.given:
            return Verdict.GIVEN
        if cell.ours is None:
            return Verdict.LOST if cell.cause else Verdict.FAILED
        met = cell.printed is not None and self.tolerance.holds(cell.ours, cell.printed)
        if not cell.cause:
            return Verdict.REPRODUCED if met else Verdict.FAILED
        own = self.own or self.tolerance
        agreed = cell.expected is not None and own.holds(cell.ours, cell.expected)
        return Verdict.EXPLAINED if agreed and not met else Verdict.FAILED


@dataclass(frozen=True, slots=True)
class Cell:
    """printed: None where it is illegible.  ours: None where there is nothing to compute it from.

    cause: the key of the reason why print and ours differ; then `expected` is what an independent calculation gave.
    given: the printed number is an input of the row.
    """

    printed: float | None
    ours: float | None = None
    cause: str = ""
    expected: float | None = None
    given: bool = False


@dataclass(frozen=True, slots=True)
class Row:
    label: str
    cells: tuple[Cell, ...]


@dataclass(frozen=True, slots=True)
class Table:
    """causes: by the keys that cells name.  text: what a reader must know before the rows.

    reference: what stands in the first column of numbers, where it is not the print.
    """

    title: str
    columns: tuple[Column, ...]
    rows: tuple[Row, ...]
    text: str = ""
    causes: dict[str, str] = field(default_factory=dict)
    reference: str = PRINTED

    def verdicts(self, row: Row) -> list[Verdict]:
        found = [column.verdict(cell) for column, cell in zip(self.columns, row.cells, strict=True)]
        if self.reference == PRINTED:
            return found
        return [Verdict.AGREES if each is Verdict.REPRODUCED else each for each in found]


@dataclass(frozen=True, slots=True)
class Claim:
    """A statement of a paper.  found: what we find, with numbers.  holds: whether it is so, computed in this run.

    cause: for a claim that does not hold, why; it fails when it holds after all.
    """

    said: str
    found: str
    holds: bool
    cause: str = ""

    @property
    def verdict(self) -> Verdict:
        if self.holds:
            return Verdict.FAILED if self.cause else Verdict.REPRODUCED
        return Verdict.EXPLAINED if self.cause else Verdict.FAILED


@dataclass(frozen=True, slots=True)
class Figure:
    """A plot of docs/validation/.  name: of its file, without ending."""

    name: str
    caption: str


@dataclass(frozen=True, slots=True)
class Paper:
    title: str
    source: str
    text: str
    tables: tuple[Table, ...]
    claims: tuple[Claim, ...] = ()
    figures: tuple[Figure, ...] = ()

    def counts(self) -> dict[Verdict, int]:
        """Numbers and claims by verdict; inputs are no results and not counted."""
        found: dict[Verdict, int] = {each: 0 for each in Verdict if each is not Verdict.GIVEN}
        for table in self.tables:
            for row in table.rows:
                for verdict in table.verdicts(row):
                    if verdict is not Verdict.GIVEN:
                        found[verdict] += 1
        for claim in self.claims:
            found[claim.verdict] += 1
        return found

    def failures(self) -> list[str]:
        """One line for each number or claim out of its tolerance."""
        lines = []
        for table in self.tables:
            for row in table.rows:
                for column, cell in zip(table.columns, row.cells, strict=True):
                    if column.verdict(cell) is Verdict.FAILED:
                        lines.append(f"{self.title}, {table.title}, {row.label}: {column.name} {_told(cell)}")
        lines += [f"{self.title}: {c.said} {c.found}" for c in self.claims if c.verdict is Verdict.FAILED]
        return lines


def _told(cell: Cell) -> str:
    told = f"printed {cell.printed}, ours {cell.ours}"
    return f"{told}, instead of {cell.expected} (cause {cell.cause})" if cell.cause else told

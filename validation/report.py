"""The validation as a Markdown document. The same results give the same text: no dates, no more digits than count."""

from __future__ import annotations

from collections.abc import Iterable

from validation.checks import PRINTED, Cell, Claim, Column, Paper, Row, Table, Verdict

INTRODUCTION = """\
# Validation against the five papers

Written by `make validate`, which recomputes every printed table and example of the papers that Loopwright's methods
come from, with the same `tuning/` that tunes loops. It fails when a number leaves its tolerance, and a test compares
this text with what the run gives.

A line is a row of the paper's table, its numbers in the order that the line above the table gives, rounded to what the
tolerance supports; the verdict is on the unrounded ones.

- **reproduced**: within the tolerance stated below the table, with its reason.
- **explained (a)**: not within it, for the cause below the table. Our number must then agree with an independent
  calculation (other code, its results are in `tests/data/`), and it fails when the print is met after all.
- **cannot be recomputed (a)**: the paper does not state what the number follows from.
- **agrees**: with an independent calculation, where the paper prints no number.
- *given*: an input that we take from the print.

Dead times are exact, never a Pade approximant; the plots are our simulations.
"""

SUMMED = (Verdict.REPRODUCED, Verdict.AGREES, Verdict.EXPLAINED, Verdict.LOST, Verdict.FAILED)


def document(papers: list[Paper]) -> str:
    lines = [INTRODUCTION, *_summary(papers)]
    for paper in papers:
        lines += _paper(paper)
    return "\n".join(lines).rstrip() + "\n"


def _summary(papers: list[Paper]) -> list[str]:
    lines = [
        "Numbers and claims:",
        "",
        f"| paper | {' | '.join(SUMMED)} |",
        "| --- |" + " ---: |" * len(SUMMED),
    ]
    totals = dict.fromkeys(SUMMED, 0)
    for paper in papers:
        counts = paper.counts()
        for each in SUMMED:
            totals[each] += counts[each]
        anchor = "".join(c for c in paper.title.lower().replace(" ", "-") if c.isalnum() or c == "-")
        lines.append(f"| [{paper.title}](#{anchor}) | {' | '.join(str(counts[each]) for each in SUMMED)} |")
    return [*lines, f"| all | {' | '.join(str(totals[each]) for each in SUMMED)} |", ""]


def _paper(paper: Paper) -> list[str]:
    lines = [f"## {paper.title}", "", f"{paper.source}.", "", paper.text, ""]
    for table in paper.tables:
        lines += _table(table)
    if paper.claims:
        lines += ["### What the paper says", "", "| statement | found | verdict |", "| --- | --- | --- |"]
        lines += [f"| {claim.said} | {claim.found}{_because(claim)} | {_of_claim(claim)} |" for claim in paper.claims]
        lines.append("")
    for figure in paper.figures:
        lines += [f"![{figure.caption}](validation/{figure.name}.png)", "", f"*{figure.caption}*", ""]
    return lines


def _because(claim: Claim) -> str:
    return f" {claim.cause}" if claim.cause else ""


def _of_claim(claim: Claim) -> str:
    words = {Verdict.REPRODUCED: "holds", Verdict.EXPLAINED: "does not hold", Verdict.FAILED: "**failed**"}
    return words[claim.verdict]


def _table(table: Table) -> list[str]:
    names = ", ".join(f"{each.name} ({each.unit})" if each.unit else each.name for each in table.columns)
    lines = [f"### {table.title}", "", *([table.text, ""] if table.text else []), f"Numbers: {names}.", ""]
    lines += [f"| row | {table.reference} | ours | verdict |", "| --- | ---: | ---: | --- |"]
    for row in table.rows:
        pairs = list(zip(table.columns, row.cells, strict=True))
        printed = (_reference(table, column, cell) for column, cell in pairs)
        ours = ("*given*" if cell.given else column.show(cell.ours) for column, cell in pairs)
        lines.append(f"| {row.label} | {_row(printed)} | {_row(ours)} | {_verdict(table, row)} |")
    lines += ["", f"Tolerance: {_tolerances(table)}.", ""]
    lines += [f"- ({key}) {text}" for key, text in sorted(table.causes.items())]
    return [*lines, ""] if table.causes else lines


def _reference(table: Table, column: Column, cell: Cell) -> str:
    return column.as_printed(cell.printed) if table.reference == PRINTED else column.show(cell.printed)


def _row(cells: Iterable[str]) -> str:
    return " · ".join(cells)


def _verdict(table: Table, row: Row) -> str:
    verdicts = table.verdicts(row)
    parts = []
    for verdict in (Verdict.FAILED, Verdict.EXPLAINED, Verdict.LOST):
        named = [(c, cell.cause) for c, cell, v in zip(table.columns, row.cells, verdicts, strict=True) if v is verdict]
        for cause in dict.fromkeys(cause for _, cause in named):
            names = ", ".join(column.name for column, key in named if key == cause)
            what = f"**{verdict}**" if verdict is Verdict.FAILED else str(verdict)
            whole = len(named) == len(row.cells)
            parts.append(f"{'' if whole else f'{names} '}{what}{f' ({cause})' if cause else ''}")
    for verdict in (Verdict.REPRODUCED, Verdict.AGREES):
        if verdict in verdicts:
            parts.append(f"rest {verdict}" if parts else str(verdict))
    return "; ".join(parts)


def _tolerances(table: Table) -> str:
    """Of columns with something to compare, equal ones together."""
    told: dict[str, list[str]] = {}
    for i, column in enumerate(table.columns):
        cells = [row.cells[i] for row in table.rows]
        if all(cell.given or cell.ours is None for cell in cells):
            continue
        told.setdefault(_told(column, any(cell.cause and cell.ours is not None for cell in cells)), []).append(
            column.name
        )
    return "; ".join(f"{', '.join(names)} {what}" for what, names in told.items()) or "none, nothing is compared"


def _told(column: Column, explained: bool) -> str:
    words = f"{column.tolerance.in_words(column.unit)} ({column.tolerance.reason})"
    if explained and column.own:
        words += f", to the independent calculation {column.own.in_words(column.unit)} ({column.own.reason})"
    return words

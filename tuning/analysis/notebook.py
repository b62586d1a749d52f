"""How results show themselves in a notebook: a table, and their picture where matplotlib is installed."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from html import escape
from io import StringIO
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def as_html(title: str, rows: Sequence[Sequence[str]], notes: Sequence[str], draw: Callable[[], Figure] | None) -> str:
    """Returns a result as HTML.

    rows: the cells of a table; the first row has the headings.
    draw: makes the picture; None where there is none.
    """
    head, *body = ("".join(f"<{kind}>{escape(cell)}</{kind}>" for cell in row) for kind, row in _kinds(rows))
    table = f"<table><thead><tr>{head}</tr></thead><tbody>{''.join(f'<tr>{row}</tr>' for row in body)}</tbody></table>"
    said = "".join(f"<p>{escape(note)}</p>" for note in notes)
    return f"<p><b>{escape(title)}</b></p>{table}{said}{'' if draw is None else _svg(draw)}"


def _kinds(rows: Sequence[Sequence[str]]) -> list[tuple[str, Sequence[str]]]:
    return [("td" if i else "th", row) for i, row in enumerate(rows)]


def _svg(draw: Callable[[], Figure]) -> str:
    try:
        figure = draw()
    except ModuleNotFoundError:
        return ""
    drawn = StringIO()
    figure.savefig(drawn, format="svg")
    return drawn.getvalue().partition("<svg")[1] + drawn.getvalue().partition("<svg")[2]

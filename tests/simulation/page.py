"""docs/simulation.md: what was simulated, and how it ended."""

from __future__ import annotations

import platform
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from tests.simulation.history import Ending
from tests.simulation.kinds import KINDS
from tests.simulation.report import table

PAGE = "docs/simulation.md"
MIN_SEEDS = 20_000
_FIRST, _LAST = "<!-- written by make simulate WRITE=1 -->", "<!-- end -->"


def page(endings: Sequence[Ending], seeds: int, took_s: float) -> None:
    """Writes the part of the page that the numbers make; the rest is written by hand."""
    path = Path(__file__).parents[2] / PAGE
    text = path.read_text(encoding="utf-8")
    before, rest = text.split(_FIRST)
    after = rest.split(_LAST)[1]
    path.write_text(f"{before}{_FIRST}\n{_numbers(endings, seeds, took_s)}\n{_LAST}{after}", encoding="utf-8")


def _numbers(endings: Sequence[Ending], seeds: int, took_s: float) -> str:
    bad = sum(bool(ending.bad) for ending in endings)
    exhaustive = len(endings) - seeds
    hours = sum(ending.simulated_s for ending in endings) / 3600.0
    steps = sum(ending.steps for ending in endings)
    reasons = Counter(f"{state}, {reason}" if reason else state for each in endings for state, reason in each.jobs)
    lines = [
        f"{seeds:,} seeds and {exhaustive:,} kills at each call of one job: {hours:.0f} h of bus time, {steps:,} calls "
        f"that could have been a service's last, in {took_s / 60.0:.0f} min on {_machine()}. **{bad} bad**.",
        "",
        *_by_kind(table(endings)),
        "",
        _ends(reasons),
    ]
    return "\n".join(lines)


def _by_kind(rows: list[list[str]]) -> list[str]:
    """Of the table of kinds and ends: how many histories of each kind, and how many of them ended badly."""
    histories, bad = rows[0].index("histories"), rows[0].index("bad")
    shown = [["kind", "histories", "bad"]]
    for name, *counts in rows[1:]:
        words = f"`{name}`: {KINDS[name].words}" if name in KINDS else name
        shown.append([words, counts[histories - 1], counts[bad - 1]])
    return _markdown(shown)


def _ends(reasons: Counter[str]) -> str:
    """The 30 most frequent, in one line."""
    ends = ", ".join(f"{name.replace(', ', ' ')} {count:,}" for name, count in reasons.most_common(30))
    return f"How the jobs ended, the most frequent first: {ends}."


def _markdown(rows: list[list[str]]) -> list[str]:
    head, *rest = rows
    rule = ["---", *("---:" for _ in head[1:])]
    return [f"| {' | '.join(row)} |" for row in [[each.replace("_", " ") for each in head], rule, *rest]]


def _machine() -> str:
    import os

    return f"{os.cpu_count()} cores, Python {platform.python_version()}"

"""Shows a batch on a terminal."""

from __future__ import annotations

import time
from collections.abc import Iterable, Mapping
from datetime import datetime

from loopwright.service.cli.answers import BatchShown, BatchSummaryShown
from loopwright.service.cli.client import Client, parsed
from loopwright.service.cli.terminal import ago, console, rows

POLL_S = 1.0
_OVER = ("done", "stopped", "aborted")


def follow(client: Client, url: str, quiet: bool = False) -> object:
    """Shows how many loops are in which state until the retune is over; returns the JSON of the retune."""
    shown: dict[str, int] | None = None
    while True:
        answer = client.awaited(url)
        found = parsed(BatchShown, answer)
        if found.counts != shown and not quiet:
            shown = found.counts
            console.print(f"  {counted(shown)}", highlight=False)
        if found.state in _OVER:
            return answer
        time.sleep(POLL_S)


def counted(counts: Mapping[str, int]) -> str:
    """Returns how many loops are in which state, in words."""
    return ", ".join(f"{count} {state}" for state, count in counts.items())


def summaries(found: Iterable[BatchSummaryShown], now: datetime) -> None:
    """Shows a table with a batch on each row. now: the present time."""
    lines = ((x.id, x.state, counted(x.counts), x.by, ago(x.created_at, now)) for x in found)
    rows("batches", ("id", "state", "loops", "by", "created"), lines, never_cut=("id", "created"))


def report(found: BatchShown) -> None:
    """Shows each loop with the state of its job."""
    loops = ((each.loop, each.state, each.job, each.reason) for each in found.loops)
    rows(f"batch {found.id}: {found.state}", ("loop", "state", "job", "reason"), loops, never_cut=("job",))
    if found.detail:
        console.print(found.detail, highlight=False)

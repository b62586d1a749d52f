"""A retune of many loops on a terminal."""

from __future__ import annotations

import time
from typing import Any

from loopwright.service.cli.client import Client
from loopwright.service.cli.job_tables import console, rows

LOOK_S = 1.0
_OVER = ("done", "stopped", "aborted")


def follow(client: Client, url: str, quiet: bool = False) -> dict[str, Any]:
    """Tells how many loops are in which state until it is over; returns it."""
    told: dict[str, int] | None = None
    while True:
        found: dict[str, Any] = client.get(url)
        if found["counts"] != told and not quiet:
            told = found["counts"]
            console.print("  " + ", ".join(f"{count} {state}" for state, count in told.items()), highlight=False)
        if found["state"] in _OVER:
            return found
        time.sleep(LOOK_S)


def report(found: dict[str, Any]) -> None:
    """Each loop with what has become of it."""
    loops = ((each["loop"], each["state"], each["job"], each["reason"]) for each in found["loops"])
    rows(f"retune {found['id']}: {found['state']}", ("loop", "state", "job", "reason"), loops)
    if found["detail"]:
        console.print(found["detail"], highlight=False)

"""`loopwright loop TAG --follow`: a loop as it is heard, refreshed in a terminal, else a line a second."""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import datetime

from rich.console import Console, Group
from rich.live import Live
from rich.table import Table
from rich.text import Text

from loopwright.service.api.report.words import stage_name
from loopwright.service.cli.client import Client, parsed
from loopwright.service.live.messages import LiveJob, LiveJobs, LiveLoopRow, Loops


@dataclass(frozen=True)
class SeenLoop:
    """A loop as it was heard last, and the job that has it. at_s: wall time of the service, s since 1970 UTC."""

    at_s: float
    row: LiveLoopRow
    job: LiveJob | None


def presents(client: Client, tag: str) -> Iterator[SeenLoop | str]:
    """Yields the loop about once a second, for ever; a text where the service is not reached. Raises ApiError where it
    refuses."""
    jobs: list[LiveJob] = []
    for name, data in client.live(tag):
        match name:
            case "lost":
                yield str(data)
            case "jobs":
                jobs = parsed(LiveJobs, data).jobs
            case "loops":
                seen = parsed(Loops, data)
                for row in seen.loops:
                    if row.tag == tag:
                        job = next((each for each in jobs if each.url == row.job), None)
                        yield SeenLoop(seen.now_s, row, job)


def follow(client: Client, tag: str, unit: str, console: Console, as_json: bool) -> None:
    """Shows a loop until Ctrl-C, or until nobody reads any more. as_json: as an object a line."""
    try:
        if as_json:
            for seen in presents(client, tag):
                if isinstance(seen, SeenLoop):
                    print(json.dumps(seen.row.model_dump(mode="json")), flush=True)
        elif console.is_terminal:
            with Live(console=console, auto_refresh=False) as screen:
                for seen in presents(client, tag):
                    screen.update(Text(seen) if isinstance(seen, str) else _shown(seen, unit), refresh=True)
        else:
            for seen in presents(client, tag):
                print(seen if isinstance(seen, str) else line(seen, unit), flush=True)
    except KeyboardInterrupt:
        return
    except BrokenPipeError:  # else Python says so once more as it ends
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def line(seen: SeenLoop, unit: str) -> str:
    """Returns a loop as one line."""
    row = seen.row
    values = f"SP {_number(row.sp)} {unit}, PV {_number(row.pv)} {unit}, MV {_number(row.mv)} %, {row.mode or 'mode ?'}"
    if row.no_data is not None:
        values = f"no data: {row.no_data}"
    return ", ".join([f"{_time(seen)}  {values}", *_job_words(seen)])


def _shown(seen: SeenLoop, unit: str) -> Group:
    row = seen.row
    table = Table("SP", "PV", "MV", "mode", "", title=f"{row.tag} at {_time(seen)} (Ctrl-C ends)", min_width=70)
    values = (f"{_number(row.sp)} {unit}", f"{_number(row.pv)} {unit}", f"{_number(row.mv)} %", row.mode or "?")
    table.add_row(*values, "\n".join(_job_words(seen)) or "no test")
    return Group(table, *([Text(f"no data: {row.no_data}")] if row.no_data else []))


def _job_words(seen: SeenLoop) -> list[str]:
    """Returns what the loop is doing for a job, if anything."""
    job = seen.job
    if job is None:
        words = ["under test by another tuner"] if seen.row.under_test else []
        return words + (["gains on trial"] if seen.row.on_trial else [])
    stage = stage_name(job.stage) or job.state
    words = [f"job {job.id}: {stage}"]
    if job.progress is not None:
        words[0] += f" {job.progress:.0%}"
    if job.remaining_plant_time_s is not None:
        words.append(f"about {job.remaining_plant_time_s:.0f} s of plant time left")
    return words + (["being stopped"] if job.stopping else [])


def _time(seen: SeenLoop) -> str:
    return datetime.fromtimestamp(seen.at_s).strftime("%H:%M:%S")


def _number(value: float | None) -> str:
    return "?" if value is None else f"{value:.2f}"

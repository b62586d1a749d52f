"""What follows the demo's table: the loop stays in operation, its page is named, and the plant runs in real time."""

from __future__ import annotations

import os
import shlex
import shutil
import sys
from collections.abc import Sequence
from pathlib import Path

from loopwright.protocol.profile import CONTROLLER_NODE, PLANT_NODE
from loopwright.protocol.tuner import Tuner
from loopwright.service.api.job_views import JobView
from loopwright.service.cli.client import DEFAULT_URL
from loopwright.service.states.job_state import JobState

FULL_SPEED = 0.0
REAL_TIME = 1.0
"""Paces of the plant. In real time a test of model 14 by fast takes 22 s, which a person can watch."""


def set_pace(bus: str, pace: float) -> None:
    """Writes the pace of the demo's plant (2010h), as a factor of real time; 0 is as fast as the answers come.

    Raises TunerError, and OSError where there is no bus.
    """
    tuner = Tuner(bus, CONTROLLER_NODE, PLANT_NODE)
    try:
        tuner.write("plant_pace", pace)
    finally:
        tuner.close()


def latest_proposal(jobs: Sequence[JobView]) -> JobView | None:
    """Returns the last job that ended as a proposal: the loop's page shows it with its decision."""
    return next((job for job in reversed(jobs) if job.state is JobState.PROPOSED), None)


def page_line(url: str, tag: str, reached: str) -> str:
    """Returns the line that names the page of a loop, and where a browser has to be to reach it."""
    return f"page             {url}/ui/loops/{tag} ({reached})"


def accept_line(command: Sequence[str], proposal: JobView) -> str:
    """Returns the line with the command that accepts a proposal."""
    return f"accept           {shlex.join(command)} (the gains that {proposal.method} proposes)"


def accept_command(url: str, job_id: str) -> list[str]:
    """Returns the command that accepts a proposal, with this program as it was called."""
    called = sys.argv[0]
    name = Path(called).name
    found = shutil.which(name)
    if found and Path(called).exists() and os.path.samefile(found, called):
        called = name
    return [called, "job", job_id, "--accept", *([] if url == DEFAULT_URL else ["--url", url])]

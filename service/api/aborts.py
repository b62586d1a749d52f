"""Aborts as they come in: a test is asked to stop before the request waits for anything."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from loopwright.service.api.job_views import Decision
from loopwright.service.jobs.manager import Jobs


@contextmanager
def stopping(jobs: Jobs, path: str) -> Iterator[None]:
    """Asks the jobs of the path of an abort that run here to stop; the abort is answered meanwhile. Who has stopped
    them is stored however it is answered."""
    _, what, name, _ = path.split("/")
    if what == "jobs":
        stopped, by = [name] if jobs.tell_to_stop(name) else [], Decision().by
    else:
        stopped, by = jobs.tell_all_of(name), f"retune {name}"
    try:
        yield
    finally:
        for job_id in stopped:
            jobs.record_stop(job_id, by)

"""Aborts as they come in: a test hears of one before the request waits for anything."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from loopwright.service.api.job_views import Decision
from loopwright.service.jobs.manager import Jobs


class Aborts:
    """Tells the jobs that run here of an abort."""

    def __init__(self, jobs: Jobs) -> None:
        self._jobs = jobs

    @contextmanager
    def told(self, path: str) -> Iterator[None]:
        """Tells the jobs of the path of an abort, which is answered meanwhile. Who has stopped them is stored however
        it is answered."""
        _, what, name, _ = path.split("/")
        if what == "jobs":
            told, by = [name] if self._jobs.tell_to_stop(name) else [], Decision().by
        else:
            told, by = self._jobs.tell_all_of(name), f"retune {name}"
        try:
            yield
        finally:
            for job_id in told:
                self._jobs.record_stop(job_id, by)

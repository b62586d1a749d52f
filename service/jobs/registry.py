"""The jobs that run in this service, and whether it is to end: state shared by manager, worker and loop directory."""

from __future__ import annotations

import threading

from loopwright.service.jobs.active_job import Running
from loopwright.service.store.jobs import Job


class Registry:
    """Holds the running jobs by id, and whether the service is to end.

    stopping: set once, when the service is to end.
    why_stopping: the reason, in the words of the readiness check.
    """

    def __init__(self) -> None:
        self.stopping = False
        self.why_stopping = "the service is shutting down"
        self.running: dict[str, Running] = {}
        # By id: jobs that could not be stored or queued, as the caller was told, and whose end is not stored yet.
        self.unqueued: dict[str, Job] = {}
        # By id: jobs that an operator has told to stop, where it is neither stored nor in the journal who that was.
        self.unrecorded: set[str] = set()
        # Guards the registry of running jobs and `stopping`.
        self.lock = threading.Lock()

    def enter(self, running: Running) -> bool:
        """Adds a job that begins. Returns False where it must not begin: it runs already, was given up, or the service
        is to end."""
        with self.lock:
            if self.stopping or running.job_id in self.running or running.job_id in self.unqueued:
                return False
            self.running[running.job_id] = running
            return True

    def leave(self, running: Running) -> None:
        """Removes a job whose loop is released and whose end is stored."""
        with self.lock:
            self.running.pop(running.job_id, None)
        running.over.set()

    def under_test(self) -> dict[str, str]:
        """Returns the tags of the loops that a job works on, by job."""
        return {job_id: running.tag for job_id, running in self.running.copy().items()}

"""The interface of the durable engine, which starts jobs, and starts them again after a crash."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from typing import Protocol

WORKFLOW_VERSION = "2"
"""Version of the jobs' procedure. It is raised when jobs of the previous version cannot be finished by this one; such
jobs end as interrupted."""


class Engine(Protocol):
    """Runs the jobs of this host's queues as capacity permits, and again after a crash."""

    def launch(self, run: Callable[[str], None], queues: Mapping[str, int]) -> None:
        """Starts calling `run` with the ids of jobs, in threads.

        queues: how many jobs of each queue run at once.
        Where `run` raises FolderInUse, the job belongs to another host, and is left alone.
        """
        ...

    def enqueue(self, job_id: str, queue: str) -> None:
        """Queues a job, here or on the host that has the queue. The same job is run only once."""
        ...

    def known(self, job_ids: Collection[str]) -> set[str]:
        """Returns those of the jobs that the engine is running, or will run on a queue of this host."""
        ...

    def over(self, limit: int) -> list[str]:
        """Returns jobs of this host that have ended and are still recorded, oldest first, up to `limit`."""
        ...

    def forget(self, job_ids: Collection[str]) -> None:
        """Deletes the records of jobs that are not running."""
        ...

    def alive(self) -> bool:
        """Returns whether the engine would start a job."""
        ...

    def close(self) -> None:
        """Starts no more jobs; running jobs are not ended."""
        ...

"""The durable engine behind an interface of ours: it starts jobs, and once more after a crash."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from typing import Protocol

WORKFLOW_VERSION = "2"
"""Raised when a job begun by the code before can no longer be finished by this one; such jobs end as interrupted."""


class Engine(Protocol):
    """Runs a job of each of this host's queues when there is room, and once more after a crash."""

    def launch(self, run: Callable[[str], None], queues: Mapping[str, int]) -> None:
        """From now on calls `run` with the ids of jobs, in threads, so many of each queue at once. Where it raises
        FolderInUse, the job is another host's, and left alone."""
        ...

    def enqueue(self, job_id: str, queue: str) -> None:
        """Has the job run, here or on the host that has the queue. The same job twice is one run."""
        ...

    def known(self, job_ids: Collection[str]) -> set[str]:
        """Those of the jobs that it is running, or will run on a queue of this host."""
        ...

    def over(self, limit: int) -> list[str]:
        """Jobs of this host that it has run to their end and still remembers, the oldest first, so many of them."""
        ...

    def forget(self, job_ids: Collection[str]) -> None:
        """Drops what it knows of jobs that are not running."""
        ...

    def alive(self) -> bool:
        """True while it would start a job."""
        ...

    def close(self) -> None:
        """Starts no more jobs; those that run are left to who runs them."""
        ...

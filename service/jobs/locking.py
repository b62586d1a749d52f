"""Locks on loops, set by operators: no test starts on a locked loop, and no decision writes to it."""

from __future__ import annotations

from loopwright.service.errors import Conflict
from loopwright.service.job_states import JobState
from loopwright.service.jobs.decisions import Decisions
from loopwright.service.jobs.loop_directory import LoopDirectory
from loopwright.service.store import loop_locks
from loopwright.service.store.jobs import Job
from loopwright.service.store.store import Store
from loopwright.service.store.tables import LoopLockRow


class Locking:
    """Locks and unlocks loops of any host.

    decisions: decisions that may be writing to a loop of this host.
    """

    def __init__(self, store: Store, directory: LoopDirectory, decisions: Decisions) -> None:
        self.store = store
        self._directory = directory
        self._decisions = decisions

    def lock(self, tag: str, reason: str, by: str) -> tuple[LoopLockRow, Job | None]:
        """Locks a loop: from now on no test starts on it, on any host, and no decision writes to it. Returns the lock,
        and the job whose test was running already and continues. Raises UnknownLoop, LockedOtherwise."""
        self._directory.owner(tag)
        with self.store.writing() as session:
            row = loop_locks.lock(session, tag, reason, by)
        if not self._decisions.wait_for_writes(tag):
            raise Conflict(
                f"loop {tag} is locked now, but a decision that began before is still writing to its controller; "
                "look again in a moment"
            )
        active = self.store.active(tag)
        return row, active if active is not None and active.state == JobState.RUNNING else None

    def unlock(self, tag: str, by: str) -> LoopLockRow | None:
        """Unlocks a loop. Returns the lock that was removed, or None where there was none. Raises UnknownLoop."""
        self._directory.owner(tag)
        with self.store.writing() as session:
            return loop_locks.unlock(session, tag, by)

    def locks(self) -> dict[str, LoopLockRow]:
        """Returns the locks of every host, by loop."""
        with self.store.reading() as session:
            return loop_locks.every(session)

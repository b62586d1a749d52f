"""Locks on loops, set by operators: no test starts on a locked loop, and no decision writes to it."""

from __future__ import annotations

from loopwright.service.errors import Conflict, GatewayLost, NotKnown
from loopwright.service.jobs.decisions import WRITES_S, Decisions
from loopwright.service.jobs.forwarded_decisions import ForwardedDecisions
from loopwright.service.jobs.loop_directory import LoopDirectory
from loopwright.service.states.job_state import JobState
from loopwright.service.store import gateways, loop_locks
from loopwright.service.store.decision_requests import What
from loopwright.service.store.jobs import Job
from loopwright.service.store.store import Store
from loopwright.service.store.tables import LoopLockRow


class Locking:
    """Locks and unlocks loops of any host.

    decisions: decisions that may be writing to a loop of this host.
    """

    def __init__(
        self, store: Store, directory: LoopDirectory, decisions: Decisions, forwarded_decisions: ForwardedDecisions
    ) -> None:
        self.store = store
        self._directory = directory
        self._decisions = decisions
        self._forwarded_decisions = forwarded_decisions

    def lock(self, tag: str, reason: str, by: str) -> tuple[LoopLockRow, Job | None]:
        """Locks a loop: from now on no test starts on it, on any host, and no decision writes to it. Returns the lock,
        and the job whose test was running already and continues. Raises UnknownLoop, LockedOtherwise; Conflict where
        the loop is locked, and a decision that began before may still be writing."""
        _, host = self._directory.owner(tag)
        with self.store.writing() as session:
            row = loop_locks.lock(session, tag, reason, by)
        if host == self.store.host:
            self.wait_for_writes(tag)
        else:
            self._wait_for(host, tag, by)
        active = self.store.active(tag)
        return row, active if active is not None and active.state == JobState.RUNNING else None

    def wait_for_writes(self, tag: str) -> None:
        """Waits until no decision writes to a locked loop of this host. Raises Conflict."""
        if not self._decisions.wait_for_writes(tag):
            raise Conflict(f"{_locked(tag)} is still writing to its controller; look again in a moment")

    def _wait_for(self, host: str, tag: str, by: str) -> None:
        """Waits until the host of a locked loop says that no decision writes to it. Raises Conflict."""
        try:
            if self._forwarded_decisions.ask(host, What.WRITES_OVER, tag, None, by):
                return
            why = f"gateway {host} does not say that none is"
        except GatewayLost as lost:
            age_s = gateways.age_s(self.store, host)
            if age_s is None or age_s > max(gateways.LOST_S, WRITES_S):  # what it began before is over
                return
            why = lost.detail
        except NotKnown as unknown:
            why = str(unknown)
        raise Conflict(f"{_locked(tag)} may still be writing to its controller: {why}")

    def unlock(self, tag: str, by: str) -> LoopLockRow | None:
        """Unlocks a loop. Returns the lock that was removed, or None where there was none. Raises UnknownLoop."""
        self._directory.owner(tag)
        with self.store.writing() as session:
            return loop_locks.unlock(session, tag, by)

    def locks(self) -> dict[str, LoopLockRow]:
        """Returns the locks of every host, by loop."""
        with self.store.reading() as session:
            return loop_locks.every(session)


def _locked(tag: str) -> str:
    return f"loop {tag} is locked now, but a decision that began before"

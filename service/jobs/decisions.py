"""The decision about a proposal: accept, decline or roll back, with the writes to the controller that this takes."""

from __future__ import annotations

import threading
from collections.abc import Callable

from loopwright.service.errors import Conflict, Locked
from loopwright.service.jobs.forwarded_decisions import ForwardedDecisions
from loopwright.service.jobs.loop_directory import LoopDirectory
from loopwright.service.jobs.machine import Machine
from loopwright.service.loops.gain_change import ForeignGains, replace_accepted
from loopwright.service.observing.accepted_operation import watched
from loopwright.service.observing.kept_knowledge import KeptKnowledge
from loopwright.service.states.job_state import JobState
from loopwright.service.states.loop_state import LoopState, gains_of, same_gains, state_json
from loopwright.service.store import loop_locks, watches
from loopwright.service.store.decision_requests import What
from loopwright.service.store.jobs import Job
from loopwright.service.store.store import Store, WithJob
from loopwright.tuning.gains import Gains
from loopwright.tuning.plan import Mode
from loopwright.tuning.reasons import Ended, Reason

WRITES_S = 10.0
"""Wall time for which a lock waits for a decision that writes to the loop, s: each of its few answers comes within a
second or two."""
_WHAT = {JobState.ACCEPTED: What.ACCEPT, JobState.ROLLED_BACK: What.ROLLBACK}


class Decisions:
    """Decides the jobs of the loops of this host, and passes on the decisions about those of other hosts."""

    def __init__(
        self,
        store: Store,
        directory: LoopDirectory,
        machine: Machine,
        knowledge: KeptKnowledge,
        forwarded_decisions: ForwardedDecisions,
    ) -> None:
        self.store = store
        self._knowledge = knowledge
        self._forwarded_decisions = forwarded_decisions
        self._directory = directory
        self._machine = machine
        # By loop: an event that is set when a decision that writes to its controller has ended.
        self._writes: dict[str, threading.Event] = {}

    def accept(self, job_id: str, by: str, auto_rollback: bool = True) -> Job:
        """Makes the proposed gains the accepted ones of the controller, and reads them back. Returns the job. The loop
        is watched from then on.

        auto_rollback: whether the watch puts the previous gains back where something goes wrong.
        After an error the decision can be repeated, which completes it, or be rolled back. A job of another host whose
        gateway has not answered yet is returned as it is, not accepted.
        Raises IllegalMove, Busy, Conflict, and Failed or Refused as the loop does; of another host's also GatewayLost,
        NotKnown.
        """
        return self._decide(job_id, JobState.ACCEPTED, by, auto_rollback=auto_rollback)

    def rollback(self, job_id: str, by: str) -> Job:
        """Declines a proposal (the loop has its previous gains already), or takes back an accepted or begun change.
        Gains that were changed by others since then stay: a proposal is declined, but an accepted change is not taken
        back (Conflict)."""
        return self._decide(job_id, JobState.ROLLED_BACK, by)

    def roll_back_accepted(self, job_id: str, by: str) -> Job:
        """Takes an accepted change back, without a person, where the controller still has the accepted gains in
        automatic. The watch that has found trouble ends with it, in one transaction.

        Raises as `rollback` does, Conflict also where the loop is not as it was accepted.
        """
        accepted = new_gains(self.store.get(job_id))

        def objection(state: LoopState) -> str | None:
            if state.mode is not Mode.AUTOMATIC:
                return f"the loop is in {state.mode.name.lower()}"
            if state.on_trial:
                return "another tuner has gains on trial"
            return None if same_gains(state.gains, accepted) else f"the controller holds {state.gains}: set by others"

        return self._decide(job_id, JobState.ROLLED_BACK, by, objection, rolled_back=watches.put_back)

    def _decide(
        self,
        job_id: str,
        wanted: JobState,
        by: str,
        objection: Callable[[LoopState], str | None] = lambda state: None,
        auto_rollback: bool = True,
        rolled_back: WithJob = watches.rolled_back,
    ) -> Job:
        row = self.store.get(job_id)
        with self._directory.alone_with(row.loop):
            row = self.store.get(job_id)
            now = row.state
            self.store.check_move(job_id, wanted)
            if (busy := self.store.why_busy(row.loop)) is not None:
                raise busy
            if wanted is JobState.ROLLED_BACK and (declined := self.store.decline(job_id, by)) is not None:
                return declined
            with self.store.reading() as session:
                loop_locks.check(session, row.loop)
            config, host = self._directory.owner(row.loop)
            if host != self.store.host:  # only the service there can write to it
                asked = auto_rollback if wanted is JobState.ACCEPTED else None
                self._forwarded_decisions.ask(host, _WHAT[wanted], row.loop, job_id, by, asked)
                return self.store.get(job_id)
            old, new = gains_of(row.previous_gains), new_gains(row)
            before, after = (old, new) if wanted is JobState.ACCEPTED else (new, old)
            begun = self.store.decision_begun(job_id)
            over = self._machine.event()

            def begin() -> None:
                self._writes[row.loop] = over  # a lock request that finds a decision begun waits for its end
                self.store.begin_decision(job_id, wanted, by)

            try:
                loop = self._directory.open_loop(config)
                try:
                    state = replace_accepted(loop, before, after, begun, begin, objection)
                finally:
                    loop.close()
            except ForeignGains as foreign:
                # After an interrupted acceptance an operator set other gains: nothing is left to take back.
                if not (begun and now is JobState.PROPOSED and wanted is JobState.ROLLED_BACK):
                    raise
                detail = f"declined; the controller holds {foreign.state.gains}: set by others, left as they are"
                return self.store.move(job_id, wanted, by=by, restored=state_json(foreign.state), detail=detail)
            except Locked:  # before anything was written
                raise
            except Ended as ended:
                self.store.decision_failed(job_id, wanted, by, f"{ended.reason.value}: {ended.detail}")
                if ended.reason is Reason.GAINS_CHANGED:
                    raise Conflict(ended.detail) from ended
                raise
            finally:
                self._writes.pop(row.loop, None)
                over.set()
            also = rolled_back if wanted is JobState.ROLLED_BACK else watched(by, auto_rollback, config)
            decided = self.store.move(job_id, wanted, by=by, also=also, restored=state_json(state))
            if wanted is JobState.ACCEPTED:
                self._knowledge.accepted(decided)
            return decided

    def wait_for_writes(self, tag: str) -> bool:
        """Waits until a decision that writes to the loop has ended; returns False where it has not in WRITES_S."""
        writes = self._writes.get(tag)
        return writes is None or writes.wait(WRITES_S)


def new_gains(row: Job) -> Gains:
    """Raises Conflict for a job without new gains."""
    if row.result is None or row.result.new_gains is None:
        raise Conflict(f"job {row.id} has no new gains, so that none can be written; retune the loop")
    return row.result.new_gains.gains()

"""What is said to a request that comes too late: what is there, since when, by whom, and what to do next. Pure."""

from __future__ import annotations

from dataclasses import dataclass

from loopwright.service.states.job_state import ACTIVE, IllegalMove, JobState
from loopwright.service.store.tables import JobRow

_GO_BACK = "To go back to the previous gains, roll it back"
_NO_GAINS = {
    JobState.NO_GAIN: "it proposes no gains, because the loop is already tuned as well as asked. For a proposal all "
    "the same, retune the loop with propose_anyway",
    JobState.REHEARSED: "it was a rehearsal, whose gains are never written to the loop. For gains that can be, retune "
    "the loop without dry_run",
}


@dataclass(frozen=True)
class Decided:
    """Who has decided a job last, and when: UTC, ISO 8601."""

    by: str
    at: str


def busy(job: JobRow) -> str:
    """Returns why a loop takes no other job: this one has it."""
    if job.stop_reason is not None:
        return f"loop {job.loop} is busy with {_who(job)}, which is being stopped: ask again in a moment"
    return f"loop {job.loop} is busy with {_who(job)}, {_how_far(job)}: wait for its end, or abort it, then ask again"


def too_late(job: JobRow, now: JobState, wanted: JobState, decided: Decided | None) -> IllegalMove:
    """Returns the error of a request for a move that is not possible any more, or not yet.

    now: the state of the job as it is shown.  decided: None: nobody has.
    """
    by = "" if decided is None else f" by {decided.by} at {decided.at}"
    if now in ACTIVE:
        text = f"{_who(job)} has been {_how_far(job)}: there are no gains to decide about yet. "
        text += "Wait for its end, or abort it"
    elif wanted is JobState.ABORTED:
        text = f"job {job.id} {_ended(job, now, by)}: nothing runs that could be stopped. {_instead_of_abort(now)}"
    elif now is JobState.ACCEPTED:
        text = f"job {job.id} was accepted{by}: its gains are written already. {_GO_BACK}"
    elif now is JobState.ROLLED_BACK:
        text = f"job {job.id} was rolled back{by}: its gains can be written no more. For new ones, retune the loop"
    elif now is JobState.PROPOSED:
        text = f"job {job.id} has proposed gains since {job.ended_at}: accept them, or roll it back"
    else:
        nothing = _NO_GAINS.get(now, "it proposes no gains. The job says why, and what to do before the next retune")
        text = f"job {job.id} {_ended(job, now, by)}: {nothing}"
    return IllegalMove(now, wanted, text)


def _who(job: JobRow) -> str:
    return f"job {job.id} of {job.by}"


def _how_far(job: JobRow) -> str:
    if job.state == JobState.QUEUED:
        return f"waiting for its turn since {job.created_at}"
    stage = "" if job.stage is None else f" (stage {job.stage})"
    return f"under way since {job.started_at or job.created_at}{stage}"


def _ended(job: JobRow, now: JobState, by: str) -> str:
    if now in (JobState.ACCEPTED, JobState.ROLLED_BACK):
        return f"was {str(now).replace('_', ' ')}{by}"
    ended = f"ended at {job.ended_at} as {str(now).replace('_', ' ')}"
    return ended if job.reason is None else f"{ended} ({str(job.reason).replace('_', ' ')})"


def _instead_of_abort(now: JobState) -> str:
    if now is JobState.PROPOSED:
        return "Accept its proposal, or roll it back"
    return _GO_BACK if now is JobState.ACCEPTED else "The loop is not under test by this job"

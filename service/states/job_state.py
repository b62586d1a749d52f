"""The life of a job as a table of moves. Everything about which state may follow which is here."""

from __future__ import annotations

from enum import StrEnum

from loopwright.tuning.reasons import Aborted, Ended, NoGain, Refused


class JobState(StrEnum):
    """The value is what the API shows and the database holds."""

    QUEUED = "queued"
    RUNNING = "running"
    PROPOSED = "proposed"
    NO_GAIN = "no_gain"
    REHEARSED = "rehearsed"
    ACCEPTED = "accepted"
    ROLLED_BACK = "rolled_back"
    REFUSED = "refused"
    ABORTED = "aborted"
    FAILED = "failed"
    INTERRUPTED = "interrupted"


_S = JobState
MOVES: dict[JobState, frozenset[JobState]] = {
    # A queued job may end at once: the loop cannot be read, or the service stops before its thread runs.
    _S.QUEUED: frozenset({_S.RUNNING, _S.REFUSED, _S.ABORTED, _S.FAILED, _S.INTERRUPTED}),
    # A dry run that came to gains is rehearsed: there is no loop that they could be put into.
    _S.RUNNING: frozenset({_S.PROPOSED, _S.NO_GAIN, _S.REHEARSED, _S.REFUSED, _S.ABORTED, _S.FAILED, _S.INTERRUPTED}),
    _S.PROPOSED: frozenset({_S.ACCEPTED, _S.ROLLED_BACK}),
    # An accepted change can still be taken back as long as nothing else changed the gains since.
    _S.ACCEPTED: frozenset({_S.ROLLED_BACK}),
    _S.NO_GAIN: frozenset(),
    _S.REHEARSED: frozenset(),
    _S.ROLLED_BACK: frozenset(),
    _S.REFUSED: frozenset(),
    _S.ABORTED: frozenset(),
    _S.FAILED: frozenset(),
    _S.INTERRUPTED: frozenset(),
}
ACTIVE = frozenset({_S.QUEUED, _S.RUNNING})
GOOD = frozenset({_S.PROPOSED, _S.NO_GAIN, _S.REHEARSED})
"""How a job ends that came to an answer."""


class IllegalMove(Exception):
    """A move that the table does not have. detail: what is there instead, and what to do next."""

    def __init__(self, now: JobState, wanted: JobState, detail: str = "") -> None:
        super().__init__(detail or f"a job that is {now.value} cannot become {wanted.value}: look at the job again")
        self.now = now
        self.wanted = wanted


def state_after(ended: Ended) -> JobState:
    """The state of a job whose plan ended early."""
    if isinstance(ended, NoGain):
        return JobState.NO_GAIN
    if isinstance(ended, Refused):
        return JobState.REFUSED
    return JobState.ABORTED if isinstance(ended, Aborted) else JobState.FAILED

"""Decisions about loops of another gateway, at the gateway that was asked: stored, and the answer waited for."""

from __future__ import annotations

from sqlalchemy.exc import SQLAlchemyError

from loopwright.service.errors import Conflict, GatewayLost, Locked, NotKnown, Stopping
from loopwright.service.jobs.journal import temporary
from loopwright.service.jobs.machine import Machine
from loopwright.service.states.job_state import IllegalMove, JobState
from loopwright.service.store import decision_requests, gateways
from loopwright.service.store.decision_requests import (
    OPEN,
    AnswerKind,
    DecisionRequest,
    RequestAnswer,
    RequestState,
    What,
)
from loopwright.service.store.store import Busy, Store
from loopwright.tuning.reasons import Ended, Reason

PATIENCE_S = 5.0
"""Wall time for which the answer of another gateway is waited for, s."""
_LOOK_S = 0.1


class ForwardedDecisions:
    """Passes decisions on to the gateway that has the loop."""

    def __init__(self, store: Store, machine: Machine) -> None:
        self._store = store
        self._machine = machine

    def ask(
        self,
        host: str,
        what: What,
        loop: str,
        job_id: str | None,
        by: str,
        auto_rollback: bool | None = None,
    ) -> bool:
        """Has the gateway `host` carry out a decision of the present caller. Returns whether it has; False: it has not
        answered in PATIENCE_S, and may still do so, if it begins within EXPIRES_S of the request.

        Raises what the decision raised there; GatewayLost: it was not begun, and will not be; NotKnown.
        """
        text = f"the decision about loop {loop}, which gateway {host} has to carry out"
        age_s = gateways.age_s(self._store, host)
        if age_s is None or age_s > gateways.LOST_S:
            raise GatewayLost(f"{gateways.silent(host, age_s)}; nothing was written to loop {loop}")
        try:
            number = decision_requests.ask(self._store, host, what, loop, job_id, by, auto_rollback)
        except SQLAlchemyError as error:
            raise _not_known(text, error) from error
        found = self._answered(number, host, text)
        if found is None:
            return False
        if found.state is RequestState.WITHDRAWN:
            age_s = gateways.age_s(self._store, host)
            raise GatewayLost(f"{gateways.silent(host, age_s)}; the request was withdrawn, nothing was written")
        if found.state is RequestState.EXPIRED:
            within_s = decision_requests.EXPIRES_S
            raise GatewayLost(f"gateway {host} did not begin {text} within {within_s:.0f} s; nothing was written")
        if found.state is RequestState.CUT_OFF:
            raise NotKnown(f"{text}, was cut off there; {CUT_OFF}")
        raise_of(found.answer or RequestAnswer(), loop, host)
        return True

    def _answered(self, number: int, host: str, text: str) -> DecisionRequest | None:
        """Returns the request at its end; None where it has none in PATIENCE_S. One that a gateway which has fallen
        silent has not begun by then is withdrawn."""
        give_up = self._machine.monotonic() + PATIENCE_S
        while True:
            late = self._machine.monotonic() >= give_up
            try:
                found = decision_requests.get(self._store, number)
                if late and found.state is RequestState.WAITING:
                    age_s = gateways.age_s(self._store, host)
                    if age_s is None or age_s > gateways.NO_DATA_S:
                        decision_requests.withdraw(self._store, number)
                        found = decision_requests.get(self._store, number)
            except SQLAlchemyError as error:
                if late or not temporary(error):
                    raise _not_known(text, error) from error
            else:
                if found.state not in OPEN:
                    return found
                if late:
                    return None
            self._machine.sleep(_LOOK_S)


CUT_OFF = (
    "whether the gains were written is not known: read the loop; the decision can be repeated, which completes it, or "
    "the change be rolled back"
)
"""What is to be done about a decision that was cut off."""


def answer_to(error: Exception) -> RequestAnswer:
    """Returns what a gateway answers to a decision that ended with this error."""
    detail = str(error)
    if isinstance(error, IllegalMove):
        return RequestAnswer(
            kind=AnswerKind.ILLEGAL_MOVE, detail=detail, now=error.now.value, wanted=error.wanted.value
        )
    if isinstance(error, Busy):
        return RequestAnswer(kind=AnswerKind.BUSY, detail=detail, job=error.job_id)
    if isinstance(error, Locked):
        return RequestAnswer(kind=AnswerKind.LOCKED, detail=error.detail)
    if isinstance(error, Ended):
        return RequestAnswer(kind=AnswerKind.ENDED, detail=error.detail, reason=error.reason.value)
    if isinstance(error, Conflict):
        return RequestAnswer(kind=AnswerKind.CONFLICT, detail=detail)
    if isinstance(error, Stopping):
        return RequestAnswer(kind=AnswerKind.STOPPING, detail=detail)
    if isinstance(error, SQLAlchemyError | NotKnown):
        return RequestAnswer(kind=AnswerKind.DATABASE, detail=type(error).__name__)
    return RequestAnswer(kind=AnswerKind.DEFECT, detail=f"{type(error).__name__}: {error}")


def raise_of(answer: RequestAnswer, loop: str, host: str) -> None:
    """Raises what the answer of a gateway says; returns where the decision was carried out."""
    match answer.kind:
        case AnswerKind.DONE:
            return
        case AnswerKind.ILLEGAL_MOVE:
            raise IllegalMove(JobState(answer.now or ""), JobState(answer.wanted or ""), answer.detail)
        case AnswerKind.BUSY:
            raise Busy(loop, answer.job or "", answer.detail)
        case AnswerKind.LOCKED:
            raise Locked(answer.detail)
        case AnswerKind.CONFLICT:
            raise Conflict(answer.detail)
        case AnswerKind.STOPPING:
            raise Stopping(f"gateway {host}: {answer.detail}")
        case AnswerKind.DATABASE:
            raise NotKnown(f"the database was away while gateway {host} decided about loop {loop}; {CUT_OFF}")
        case AnswerKind.ENDED:
            reason = next((each for each in Reason if each == answer.reason), Reason.INTERNAL)
            raise Ended(reason, answer.detail)
        case AnswerKind.DEFECT:
            raise Ended(Reason.INTERNAL, f"gateway {host}: {answer.detail}")


def _not_known(text: str, error: SQLAlchemyError) -> Exception:
    if not temporary(error):
        return error
    within_s = decision_requests.EXPIRES_S
    return NotKnown(
        f"the database does not answer: whether {text}, was or will be carried out is not known; {within_s:.0f} s "
        "after this request it is not begun any more. Look at the job when the database is back"
    )

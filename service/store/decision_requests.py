"""Decisions asked at one gateway about a loop that another one has: stored by the one, carried out by the other.

    waiting ──▶ under_way ──▶ done, refused
       │            └───────▶ cut_off      its gateway ended, or lost the database, in the middle
       ├──▶ expired                        it was not begun in EXPIRES_S
       └──▶ withdrawn                      its gateway does not answer, as who asked was told

Each arrow is one UPDATE that names the state it leaves, hence a request is begun once, and never after it was withdrawn
or has expired. The clock is the database's. Only on PostgreSQL: a data folder without a server has one gateway.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from enum import StrEnum

from pydantic import BaseModel
from sqlalchemy import Float, delete, func, literal_column, select, update
from sqlalchemy.orm import Session

from loopwright.service.jsonable import JsonObject, json_object
from loopwright.service.security.keys import Scope
from loopwright.service.security.principal import Principal, current
from loopwright.service.store import idempotency_effects
from loopwright.service.store.gateways import NOW_S
from loopwright.service.store.idempotency_effects import Claim
from loopwright.service.store.store import Store
from loopwright.service.store.tables import DecisionRequestRow as Row

EXPIRES_S = 10.0
"""Wall time after which a request that was not begun is not begun any more, s."""
_KEPT_S = 7 * 86_400.0


class What(StrEnum):
    """What is asked of the gateway of a loop."""

    ACCEPT = "accept"
    ROLLBACK = "rollback"
    WRITES_OVER = "writes_over"
    """To answer when no decision writes to the loop any more, which is locked."""


class RequestState(StrEnum):
    """How far a request has come."""

    WAITING = "waiting"
    UNDER_WAY = "under_way"
    DONE = "done"
    REFUSED = "refused"
    EXPIRED = "expired"
    WITHDRAWN = "withdrawn"
    CUT_OFF = "cut_off"


OPEN = (RequestState.WAITING, RequestState.UNDER_WAY)


class AnswerKind(StrEnum):
    """How the gateway of a loop has answered: done, or one of the errors that a decision ends with."""

    DONE = "done"
    ILLEGAL_MOVE = "illegal_move"
    CONFLICT = "conflict"
    BUSY = "busy"
    LOCKED = "locked"
    STOPPING = "stopping"
    DATABASE = "database"
    ENDED = "ended"
    DEFECT = "defect"


class RequestAnswer(BaseModel):
    """What the gateway of a loop answers to a request.

    now, wanted: states of the job, of an illegal move.  job: the id of the job that has the loop.
    """

    kind: AnswerKind = AnswerKind.DONE
    detail: str = ""
    reason: str | None = None
    now: str | None = None
    wanted: str | None = None
    job: str | None = None


@dataclass(frozen=True)
class DecisionRequest:
    """A request as it is.

    job_id: None for one that is about a loop alone.  by: who, as given in the request.  asked_s: when, seconds since
    1970 UTC.  asked_at: at which gateway.  host: the gateway that carries it out.
    auto_rollback: of an acceptance, whether the previous gains are put back where something goes wrong.
    """

    number: int
    what: What
    loop: str
    job_id: str | None
    by: str
    asked_s: float
    asked_at: str
    host: str
    state: RequestState
    answer: RequestAnswer | None
    who: JsonObject
    claim: Claim | None
    auto_rollback: bool | None

    @classmethod
    def of(cls, row: Row, now_s: float) -> DecisionRequest:
        """now_s: by the clock of the database; a request that waits after its time has expired."""
        state = RequestState(row.state)
        late = state is RequestState.WAITING and row.expires_s <= now_s
        claim = None
        if row.claim_principal is not None and row.claim_key is not None and row.claim_token is not None:
            claim = Claim(row.claim_principal, row.claim_key, row.claim_token)
        return cls(
            number=row.number,
            what=What(row.what),
            loop=row.loop,
            job_id=row.job_id,
            by=row.by,
            asked_s=row.asked_s,
            asked_at=row.asked_at,
            host=row.host,
            state=RequestState.EXPIRED if late else state,
            answer=None if row.answer is None else RequestAnswer.model_validate(row.answer),
            who=row.who,
            claim=claim,
            auto_rollback=row.auto_rollback,
        )

    @property
    def principal(self) -> Principal:
        """Returns who has asked."""
        key_id, address = self.who.get("key_id"), self.who.get("address")
        return Principal(
            str(self.who["name"]),
            Scope(str(self.who["scope"])),
            None if key_id is None else str(key_id),
            None if address is None else str(address),
            gateway=self.asked_at,
        )


_NOW_S = literal_column(NOW_S, Float)


def ask(
    store: Store,
    host: str,
    what: What,
    loop: str,
    job_id: str | None,
    by: str,
    auto_rollback: bool | None = None,
) -> int:
    """Stores a request of the present caller for the gateway `host`; returns its number. One that came with the same
    Idempotency-Key and is still open is taken over. Raises SQLAlchemyError, FolderInUse."""
    who, claim = current.get(), idempotency_effects.current.get()
    with store.writing() as session:
        session.execute(delete(Row).where(Row.asked_s < _NOW_S - _KEPT_S))
        if claim is not None:
            is_open = (Row.state == RequestState.UNDER_WAY.value) | (
                (Row.state == RequestState.WAITING.value) & (Row.expires_s > _NOW_S)
            )
            same = (Row.claim_principal == claim.principal, Row.claim_key == claim.key, Row.what == what.value)
            wanted = select(Row).where(*same, Row.loop == loop, Row.job_id == job_id, is_open).with_for_update()
            open_row = session.scalars(wanted).first()
            if open_row is not None:
                open_row.claim_token = claim.token
                return open_row.number
        now_s = _now_s(session)
        row = Row(
            host=host, asked_at=store.host, asked_s=now_s, expires_s=now_s + EXPIRES_S, what=what.value, loop=loop,
            job_id=job_id, by=by, state=RequestState.WAITING.value, auto_rollback=auto_rollback,
            who=json_object(
                {"name": who.name, "scope": who.scope.value, "key_id": who.key_id, "address": who.address}
            ),
            claim_principal=claim.principal if claim else None,
            claim_key=claim.key if claim else None,
            claim_token=claim.token if claim else None,
        )  # fmt: skip
        session.add(row)
        session.flush()
        return row.number


def get(store: Store, number: int) -> DecisionRequest:
    """Returns a request as it is now. Raises SQLAlchemyError."""
    with store.reading() as session:
        return DecisionRequest.of(session.get_one(Row, number), _now_s(session))


def withdraw(store: Store, number: int) -> bool:
    """Takes a request back; False: it was begun already. Raises SQLAlchemyError, FolderInUse."""
    with store.writing() as session:
        return _move(session, number, RequestState.WAITING, RequestState.WITHDRAWN)


def open_here(store: Store) -> dict[int, RequestState]:
    """Returns the states of the open requests for this gateway, by number. Raises SQLAlchemyError."""
    wanted = select(Row.number, Row.state).where(Row.host == store.host, Row.state.in_([each.value for each in OPEN]))
    with store.reading() as session:
        return {row.number: RequestState(row.state) for row in session.execute(wanted)}


def take(store: Store, at_most: int) -> list[DecisionRequest]:
    """Begins the oldest requests for this gateway, and ends those that have expired. Raises SQLAlchemyError,
    FolderInUse."""
    waiting = (Row.host == store.host, Row.state == RequestState.WAITING.value)
    with store.writing() as session:
        late = Row.expires_s <= _NOW_S
        session.execute(update(Row).where(*waiting, late).values(state=RequestState.EXPIRED.value))
        wanted = select(Row).where(*waiting).order_by(Row.number).limit(at_most).with_for_update(skip_locked=True)
        rows = session.scalars(wanted).all()
        for row in rows:
            row.state = RequestState.UNDER_WAY.value
        now_s = _now_s(session)
        return [DecisionRequest.of(row, now_s) for row in rows]


def end(store: Store, number: int, answer: RequestAnswer) -> None:
    """Stores the answer to a request that this gateway has carried out. Raises SQLAlchemyError, FolderInUse."""
    state = RequestState.DONE if answer.kind is AnswerKind.DONE else RequestState.REFUSED
    with store.writing() as session:
        _move(session, number, RequestState.UNDER_WAY, state, answer)


def cut_off(store: Store, under_way: Collection[int]) -> list[DecisionRequest]:
    """Ends the requests that this gateway has begun and is not at work on; returns them. Raises SQLAlchemyError,
    FolderInUse.

    under_way: numbers of those that it is at work on.
    """
    left = (Row.host == store.host, Row.state == RequestState.UNDER_WAY.value, Row.number.not_in(list(under_way)))
    with store.writing() as session:
        rows = session.scalars(select(Row).where(*left).with_for_update()).all()
        for row in rows:
            row.state = RequestState.CUT_OFF.value
        now_s = _now_s(session)
        return [DecisionRequest.of(row, now_s) for row in rows]


def latest(store: Store, job_ids: Collection[str]) -> dict[str, DecisionRequest]:
    """Returns the latest request about each of these jobs, by job. Raises SQLAlchemyError."""
    if not store.shared or not job_ids:
        return {}
    last = select(func.max(Row.number)).where(Row.job_id.in_(job_ids)).group_by(Row.job_id)
    with store.reading() as session:
        rows = session.scalars(select(Row).where(Row.number.in_(last))).all()
        now_s = _now_s(session) if rows else 0.0
    return {row.job_id: DecisionRequest.of(row, now_s) for row in rows if row.job_id is not None}


def _move(
    session: Session, number: int, now: RequestState, wanted: RequestState, answer: RequestAnswer | None = None
) -> bool:
    values = {"state": wanted.value} | ({} if answer is None else {"answer": answer.model_dump(mode="json")})
    mine = (Row.number == number, Row.state == now.value)
    return session.scalar(update(Row).where(*mine).values(values).returning(Row.number)) is not None


def _now_s(session: Session) -> float:
    return float(session.scalar(select(_NOW_S)) or 0.0)

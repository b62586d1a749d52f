"""What is to be delivered to webhooks: written with the move of a job, so that no end of the process loses it."""

from __future__ import annotations

import secrets
from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum

from sqlalchemy import and_, delete, func, or_, select, update
from sqlalchemy.orm import Session

from loopwright.service.store.clock import now
from loopwright.service.store.store import Store
from loopwright.service.store.tables import WebhookDeliveryRow as Row


class DeliveryState(StrEnum):
    WAITING = "waiting"
    DELIVERED = "delivered"
    GIVEN_UP = "given_up"


@dataclass(frozen=True, slots=True)
class Delivery:
    """One message to one webhook. id: the same at each attempt.  attempts: made so far.  due_s: s since 1970 UTC."""

    id: str
    hook: str
    job_id: str
    body: str
    at: str
    state: DeliveryState
    attempts: int
    due_s: float
    error: str | None
    number: int = 0


def add(session: Session, host: str, hook: str, job_id: str, body: str, due_s: float) -> None:
    """Adds a message within the transaction in which it came about. due_s: now, s since 1970 UTC."""
    session.add(
        Row(
            id=f"msg_{secrets.token_urlsafe(18)}", host=host, hook=hook, job_id=job_id, body=body, at=now(),
            state=DeliveryState.WAITING.value, attempts=0, due_s=due_s,
        )
    )  # fmt: skip


def next_due(store: Store, hook: str, now_s: float, delays_s: Sequence[float]) -> Delivery | None:
    """Returns what is to be delivered to a webhook next; None: nothing is due. Raises SQLAlchemyError.

    delays_s: from a failed attempt to the next one, s. What is due later than that waits for a clock that was set back
    since, and is due now.
    """
    waits = (Row.host == store.host, Row.state == DeliveryState.WAITING.value, Row.hook == hook)
    longest_s = enumerate((0.0, *delays_s))
    set_back = (and_(Row.attempts == attempts, Row.due_s > now_s + delay_s) for attempts, delay_s in longest_s)
    due = or_(Row.due_s <= now_s, *set_back)
    wanted = select(Row).where(*waits, due).order_by(Row.due_s, Row.number).limit(1)
    with store.reading() as session:
        row = session.scalars(wanted).one_or_none()
        return None if row is None else _delivery(row)


def waiting(store: Store, hook: str) -> int:
    """Returns how many messages wait for a webhook. Raises SQLAlchemyError."""
    mine = (Row.host == store.host, Row.state == DeliveryState.WAITING.value, Row.hook == hook)
    with store.reading() as session:
        return session.scalar(select(func.count()).select_from(Row).where(*mine)) or 0


def note(store: Store, delivery: Delivery, state: DeliveryState, due_s: float, error: str | None) -> None:
    """Notes how an attempt ended. due_s: when the next one is made, or now. Raises SQLAlchemyError, FolderInUse."""
    with store.writing() as session:
        session.execute(
            update(Row)
            .where(Row.id == delivery.id)
            .values(state=state.value, attempts=delivery.attempts + 1, due_s=due_s, error=error)
        )


def give_up_others(store: Store, hooks: list[str], now_s: float) -> int:
    """Gives up what waits for webhooks that are not configured any more. Returns how many messages."""
    gone = (Row.host == store.host, Row.state == DeliveryState.WAITING.value, Row.hook.not_in(hooks))
    values = {"state": DeliveryState.GIVEN_UP.value, "due_s": now_s, "error": "the webhook is not configured any more"}
    with store.writing() as session:
        return session.execute(update(Row).where(*gone).values(values)).rowcount  # type: ignore[attr-defined,no-any-return]


def delete_over(store: Store, before_s: float) -> None:
    """Deletes what ended before this time, s since 1970 UTC. Raises SQLAlchemyError, FolderInUse."""
    over = (Row.host == store.host, Row.state != DeliveryState.WAITING.value, Row.due_s < before_s)
    with store.writing() as session:
        session.execute(delete(Row).where(*over))


def latest(store: Store, limit: int, before: int | None = None) -> list[Delivery]:
    """Returns the latest messages of every gateway, the latest first. Raises SQLAlchemyError.

    before: only those with a smaller number.
    """
    wanted = select(Row).order_by(Row.number.desc()).limit(limit)
    if before is not None:
        wanted = wanted.where(Row.number < before)
    with store.reading() as session:
        return [_delivery(row) for row in session.scalars(wanted)]


def _delivery(row: Row) -> Delivery:
    return Delivery(
        row.id,
        row.hook,
        row.job_id,
        row.body,
        row.at,
        DeliveryState(row.state),
        row.attempts,
        row.due_s,
        row.error,
        row.number,
    )

"""The webhooks of this gateway: a message is stored with the move of its job, and delivered by a thread of the webhook.

No job waits for a webhook: its thread writes one row more, and a webhook that hangs holds its own thread alone.
A message is delivered at least once: a process that ends between the answer and its note delivers it again, with the
same id.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from sqlalchemy.orm import Session

from loopwright.service.inputs.webhooks import WebhookConfig, read_secret
from loopwright.service.jobs.repeated import Repeated
from loopwright.service.live.webhooks.connection import NotDelivered, post
from loopwright.service.live.webhooks.messages import event_of_move, headers, message_of
from loopwright.service.store import webhook_deliveries
from loopwright.service.store.jobs import Job
from loopwright.service.store.store import Store
from loopwright.service.store.webhook_deliveries import Delivery, DeliveryState
from loopwright.service.telemetry.metrics import WEBHOOK_ATTEMPTS, WEBHOOKS_WAITING

log = logging.getLogger(__name__)

LOOK_S = 1.0
"""Wall time between two looks for messages, s."""
DELAYS_S = (5.0, 30.0, 120.0, 600.0, 1800.0, 7200.0, 21_600.0, 50_000.0)
"""Wall time from a failed attempt to the next one, s; after the last of them, a day, the message is given up."""
KEPT_S = 30 * 86_400.0
"""Wall time for which what is over is kept, s."""
_STOP_S = 1.0
_GONE = 410
"""The status by which a receiver says that it wants nothing of the kind any more."""


@dataclass(frozen=True)
class DeliveryTimes:
    """The wall clock, s since 1970 UTC, and the delays between attempts, s."""

    now_s: Callable[[], float] = time.time
    delays_s: Sequence[float] = DELAYS_S
    look_s: float = LOOK_S


class Webhooks:
    """Stores messages as jobs move, and delivers them.

    folder: that of loops.yaml, from which the files with the secrets are named.
    own_url: where browsers reach this service, if known.
    Raises BadSecret.
    """

    def __init__(
        self,
        configs: Sequence[WebhookConfig],
        folder: Path,
        store: Store,
        own_url: str | None = None,
        clock: DeliveryTimes | None = None,
    ) -> None:
        self.configs = configs
        self._store, self._own_url, self._clock = store, own_url, clock or DeliveryTimes()
        self._senders = [Sender(each, read_secret(each, folder), store, self._clock) for each in configs]
        if configs:
            store.on_move = self._note

    def start(self) -> None:
        """Begins to deliver, also what an earlier process has left."""
        left = webhook_deliveries.give_up_others(
            self._store, [each.name for each in self.configs], self._clock.now_s()
        )
        if left:
            log.warning("%d messages of webhooks that are not configured any more are given up", left)
        for sender in self._senders:
            sender.start()

    def close(self) -> None:
        """Begins no other attempt, and waits a moment for those under way: one that hangs ends with the process. What
        is not delivered waits for the next start."""
        for sender in self._senders:
            sender.request_stop()
        give_up = time.monotonic() + _STOP_S
        for sender in self._senders:
            sender.join(max(0.0, give_up - time.monotonic()))

    def _note(self, session: Session, job: Job) -> None:
        """Adds the messages about a job that has just moved. The move does not depend on them."""
        try:
            event = event_of_move(job)
            wanted = [each for each in self.configs if event in each.events]
            body = "" if event is None else message_of(job, event, self._own_url).model_dump_json()
        except Exception:
            log.exception("no webhook hears of job %s, by a defect", job.id)
            return
        for each in wanted:
            webhook_deliveries.add(session, self._store.host, each.name, job.id, body, self._clock.now_s())


class Sender:
    """Delivers the messages of one webhook, in a thread of its own."""

    def __init__(self, config: WebhookConfig, secret: bytes, store: Store, clock: DeliveryTimes) -> None:
        self._config, self._secret, self._store, self._clock = config, secret, store, clock
        self._forgotten_s = 0.0
        name = f"webhook {config.name}"
        self._repeated = Repeated(self.turn, clock.look_s, name, f"{name} cannot deliver")
        self._waiting = WEBHOOKS_WAITING.labels(config.name)
        self._count: Mapping[str, Callable[[], None]] = {
            outcome: partial(WEBHOOK_ATTEMPTS.labels(config.name, outcome).inc)
            for outcome in ("delivered", "failed", "given_up")
        }

    def start(self) -> None:
        self._repeated.start()

    def request_stop(self) -> None:
        self._repeated.request_stop()

    def join(self, timeout_s: float) -> None:
        self._repeated.join(timeout_s)

    def turn(self) -> None:
        """Delivers what is due. Raises SQLAlchemyError, FolderInUse."""
        while not self._repeated.closed:
            due = webhook_deliveries.next_due(self._store, self._config.name, self._clock.now_s())
            if due is None:
                break
            self._deliver(due)
        if self._repeated.closed:
            return
        self._waiting.set(webhook_deliveries.waiting(self._store, self._config.name))
        if self._clock.now_s() - self._forgotten_s > 3600.0:
            webhook_deliveries.delete_over(self._store, self._clock.now_s() - KEPT_S)
            self._forgotten_s = self._clock.now_s()

    def _deliver(self, message: Delivery) -> None:
        config = self._config
        sent = headers(message.id, self._clock.now_s(), message.body, self._secret)
        try:
            status = post(config.url, sent, message.body.encode(), config.allow_private)
            why = None if 200 <= status < 300 else _words(status)
        except NotDelivered as error:
            status, why = 0, str(error)
        if self._repeated.closed:
            return  # the store may be closed: the message is delivered again after the next start
        now_s = self._clock.now_s()
        if why is None:
            self._count["delivered"]()
            webhook_deliveries.note(self._store, message, DeliveryState.DELIVERED, now_s, None)
            return
        delays = self._clock.delays_s
        if message.attempts < len(delays) and status != _GONE:
            self._count["failed"]()
            due_s = now_s + delays[message.attempts]
            webhook_deliveries.note(self._store, message, DeliveryState.WAITING, due_s, why)
            log.warning(
                "webhook %s: message %s about job %s was not delivered, it is tried again in %.0f s: %s",
                config.name, message.id, message.job_id, due_s - now_s, why,
            )  # fmt: skip
            return
        self._count["given_up"]()
        webhook_deliveries.note(self._store, message, DeliveryState.GIVEN_UP, now_s, why)
        log.error(
            "webhook %s: message %s about job %s is given up after %d attempts: %s",
            config.name, message.id, message.job_id, message.attempts + 1, why,
        )  # fmt: skip


def _words(status: int) -> str:
    """Returns what is wrong with an answer that is no success."""
    if 300 <= status < 400:
        return f"it answered {status}: redirects are not followed, enter the address to which it leads"
    return f"it answered {status}"

"""Delivers the messages of one webhook."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Mapping
from datetime import UTC, datetime, timedelta
from functools import partial

from loopwright.service.inputs.webhooks import WebhookConfig
from loopwright.service.jobs.repeated import Repeated
from loopwright.service.live.webhooks.connection import NotDelivered, post
from loopwright.service.live.webhooks.messages import headers
from loopwright.service.live.webhooks.times import DeliveryTimes
from loopwright.service.store import webhook_deliveries
from loopwright.service.store.clock_watch import ClockWatch, longest_stop
from loopwright.service.store.hosts import Ages
from loopwright.service.store.store import Store
from loopwright.service.store.webhook_deliveries import Delivery, DeliveryState
from loopwright.service.telemetry.metrics import WEBHOOK_ATTEMPTS, WEBHOOKS_WAITING

log = logging.getLogger(__name__)

KEPT_DAYS = 30.0
"""Wall time for which what is over is kept at least."""
_FORGETS_S = 3600.0
_GONE = 410
"""The status by which a receiver says that it wants nothing of the kind any more."""


class Sender:
    """Delivers the messages of one webhook, in a thread of its own. Raises SQLAlchemyError."""

    def __init__(self, config: WebhookConfig, secret: bytes, store: Store, clock: DeliveryTimes) -> None:
        self._config, self._secret, self._store, self._clock = config, secret, store, clock
        self._forgotten_s = -math.inf
        self._ages = Ages(store, longest_stop(KEPT_DAYS), ClockWatch(self._now, clock.passed_s))
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
            now_s, delays_s = self._clock.now_s(), self._clock.delays_s
            due = webhook_deliveries.next_due(self._store, self._config.name, now_s, delays_s)
            if due is None:
                break
            self._deliver(due)
        if self._repeated.closed:
            return
        self._waiting.set(webhook_deliveries.waiting(self._store, self._config.name))
        passed_s = self._clock.passed_s()
        if passed_s - self._forgotten_s > _FORGETS_S:
            old = self._ages.before(self._now(), timedelta(days=KEPT_DAYS))
            if old is not None:
                webhook_deliveries.delete_over(self._store, old.timestamp())
            self._forgotten_s = passed_s

    def _now(self) -> datetime:
        return datetime.fromtimestamp(self._clock.now_s(), UTC)

    def _deliver(self, message: Delivery) -> None:
        config = self._config
        sent = headers(message.id, self._clock.now_s(), message.body, self._secret)
        try:
            status = post(config.url, sent, message.body.encode())
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

"""The webhooks of this gateway: a message is stored with the move of its job, and delivered by a thread of the webhook.

No job waits for a webhook: its thread writes one row more, and a webhook that hangs holds its own thread alone.
A message is delivered at least once: a process that ends between the answer and its note delivers it again, with the
same id. What sends is imported where there is a webhook.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from sqlalchemy.orm import Session

from loopwright.service.inputs.webhooks import WebhookConfig, read_secret
from loopwright.service.live.webhooks.messages import event_of_move, message_of
from loopwright.service.live.webhooks.times import DeliveryTimes
from loopwright.service.store import webhook_deliveries
from loopwright.service.store.jobs import Job
from loopwright.service.store.store import Store

if TYPE_CHECKING:
    from loopwright.service.live.webhooks.sender import Sender

log = logging.getLogger(__name__)

_STOP_S = 1.0
"""Wall time for which attempts under way are waited for at the end of the service, s."""


class Webhooks:
    """Stores messages as jobs move, and delivers them.

    folder: that of loops.yaml, from which the files with the secrets are named.
    own_url: where browsers reach this service, if known.
    Raises BadSecret, SQLAlchemyError.
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
        self._senders: list[Sender] = []
        if configs:
            from loopwright.service.live.webhooks.sender import Sender

            self._senders = [Sender(each, read_secret(each, folder), store, self._clock) for each in configs]
            store.on_move = self._note

    def start(self) -> None:
        """Begins to deliver, also what an earlier process has left."""
        left = webhook_deliveries.give_up_others(self._store, [each.name for each in self.configs], self._clock.now_s())
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

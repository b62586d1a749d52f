"""Decisions that were asked at another gateway, at the gateway that has the loop: begun once, carried out, answered."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Mapping

from sqlalchemy.exc import SQLAlchemyError

from loopwright.service.jobs.database_retries import DatabaseRetries
from loopwright.service.jobs.forwarded_decisions import CUT_OFF, answer_to
from loopwright.service.jobs.machine import Machine
from loopwright.service.jobs.registry import Registry
from loopwright.service.security.principal import current
from loopwright.service.store import decision_requests, idempotency_effects
from loopwright.service.store.database import urgent
from loopwright.service.store.decision_requests import DecisionRequest, RequestAnswer, RequestState, What
from loopwright.service.store.lock import FolderInUse
from loopwright.service.store.store import Store
from loopwright.service.telemetry.logs import about

log = logging.getLogger(__name__)

LOOK_S = 0.2
"""Wall time between two looks for requests, s."""
AT_ONCE = 4
"""Requests that one gateway carries out at the same time: a silent node keeps each of them for seconds."""
_STOP_S = 12.0
"""Wall time for which the end of what is under way is waited for, s: a decision takes up to 10 s."""

Carry = Callable[[DecisionRequest], object]
"""Carries a request out. Raises as the decision does."""


class RequestedDecisions:
    """Carries out what other gateways ask of this one.

    how: what to do, by what is asked.
    registry: whether this gateway is to end; it begins nothing more then.
    """

    def __init__(self, store: Store, machine: Machine, registry: Registry, how: Mapping[What, Carry]) -> None:
        self._store, self._registry, self._how = store, registry, how
        self._machine = machine
        self._lasting = DatabaseRetries(machine, registry)
        self._at_work: dict[int, threading.Thread] = {}
        self._over = machine.event()
        self._thread = machine.thread(self._run, "requests of other gateways")

    def start(self) -> None:
        self._thread.start()

    def close(self) -> None:
        """Begins nothing more, and waits for what is under way."""
        self._over.set()
        if self._thread.ident is None:
            return
        give_up = self._machine.monotonic() + _STOP_S
        self._thread.join(_STOP_S)
        for number, thread in list(self._at_work.items()):
            thread.join(max(0.0, give_up - self._machine.monotonic()))
            if thread.is_alive():
                log.error("decision request %d has not ended in %.0f s; the next start says so", number, _STOP_S)

    def look(self) -> None:
        """Begins what others have asked for. Raises SQLAlchemyError, FolderInUse."""
        found = decision_requests.open_here(self._store)
        begun = {number for number, state in found.items() if state is RequestState.UNDER_WAY}
        if begun - self._at_work.keys():  # by a process before this one, or in a transaction whose end is not known
            for left in decision_requests.cut_off(self._store, self._at_work.keys()):
                log.error("%s of job %s, asked at %s, was cut off: %s", left.what, left.job_id, left.asked_at, CUT_OFF)
        free = AT_ONCE - len(self._at_work)
        if len(begun) == len(found) or free <= 0 or self._registry.stopping:
            return
        for request in decision_requests.take(self._store, free):
            thread = threading.Thread(
                target=self._carry, args=(request,), name=f"decision request {request.number}", daemon=True
            )
            self._at_work[request.number] = thread
            thread.start()

    def _carry(self, request: DecisionRequest) -> None:
        current.set(request.principal)
        idempotency_effects.current.set(request.claim)
        urgent.set(True)
        with about(job=request.job_id or "", loop=request.loop):
            try:
                self._how[request.what](request)
                answer = RequestAnswer()
            except Exception as error:
                answer = answer_to(error)
                log.info("%s, asked at gateway %s by %s: %s", request.what, request.asked_at, request.by, error)
            try:
                self._lasting(lambda: decision_requests.end(self._store, request.number, answer))
            except Exception:
                log.exception("the answer to decision request %d could not be written", request.number)
        self._at_work.pop(request.number, None)

    def _run(self) -> None:
        while not self._over.wait(LOOK_S):
            try:
                self.look()
            except FolderInUse as error:
                log.error("another service answers the other gateways: %s", error)
                return
            except SQLAlchemyError as error:
                log.warning("requests of other gateways wait for the database: %s", error)
            except Exception:
                log.exception("defect while looking for requests of other gateways")

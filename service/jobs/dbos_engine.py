"""DBOS as the engine: each job is one workflow, whose id and only argument are the job's id.

The workflow has no steps: an interrupted one is started again, and the results of its stages are in the service's own
tables. A process has only one DBOS.
"""

from __future__ import annotations

import logging
import os
from collections.abc import Callable, Collection, Mapping
from datetime import UTC, datetime
from pathlib import Path

from dbos import DBOS, DBOSConfig, SetWorkflowID
from sqlalchemy import Engine as Database

from loopwright.service.jobs.engine import WORKFLOW_VERSION
from loopwright.service.store.damage import Damage
from loopwright.service.store.database import ENGINE_FILE, checkpoint, close_database, sqlite
from loopwright.service.store.lock import FolderInUse

log = logging.getLogger(__name__)

POLL_S = 0.5
"""Wall time between two queries of each queue, s."""
_ALIVE = ("PENDING", "ENQUEUED", "DELAYED")
_OVER = ("SUCCESS", "ERROR", "CANCELLED", "MAX_RECOVERY_ATTEMPTS_EXCEEDED")

_run: Callable[[str], None] | None = None


class _Left(BaseException):
    """Ends a workflow that another host has taken over. After a result, or an Exception, DBOS would wait in this thread
    until the other host has recorded its result, and so would the end of the process."""


@DBOS.workflow(name="job", max_recovery_attempts=None)
def _job(job_id: str) -> None:
    if _run is not None:
        try:
            _run(job_id)
        except FolderInUse as error:
            raise _Left from error


def without_traceback(record: logging.LogRecord) -> bool:
    """Keeps the words and the error of a message that has a traceback in its text: a database may be away."""
    said, found, rest = record.getMessage().partition("Traceback (most recent call last):")
    if found:
        error = next((line for line in reversed(rest.splitlines()) if line[:1].isalpha()), "")
        record.msg, record.args = said + error, None
    return True


def of_a_closed_engine(record: logging.LogRecord) -> bool:
    """Says in one line that a job outlasted the engine, which DBOS logs as an exception of its own: the job is in the
    service's tables, and the next start ends its workflow."""
    if record.exc_info and _run is None:
        record.levelno, record.levelname = logging.INFO, "INFO"
        record.msg = "a job outlasted the engine, the next start goes on with it (%s)"
        record.args = (record.exc_info[1],)
        record.exc_info = record.exc_text = None
    return True


class DurableEngine:
    """The engine on DBOS.

    database: the PostgreSQL engine shared with the other hosts, or None for a file in the folder.
    poll_s: wall time between two queries of each queue, s.
    """

    def __init__(self, folder: Path, database: Database | None, host: str, poll_s: float = POLL_S) -> None:
        self._host = host
        self._poll_s = poll_s
        self._damage = Damage(folder / ENGINE_FILE if database is None else None)
        if self._damage.look() is not None:
            _set_aside(folder)
            self._damage = Damage(folder / ENGINE_FILE)
        self._own = sqlite(folder / ENGINE_FILE) if database is None else None
        if self._own is not None:
            self._damage.watch(self._own)
        self.database = self._own if database is None else database
        self._queues: frozenset[str] = frozenset()
        self._launched = False

    def launch(self, run: Callable[[str], None], queues: Mapping[str, int]) -> None:
        global _run
        _run = run
        # Set here, so that no environment variable makes DBOS send data anywhere.
        for name in ("DBOS__CLOUD", "DBOS__APPVERSION", "DBOS__VMID"):
            os.environ.pop(name, None)
        config: DBOSConfig = {
            "name": "loopwright",
            "system_database_engine": self.database,
            "application_version": WORKFLOW_VERSION,
            "executor_id": self._host,
            "log_level": "WARNING",
            "enable_otlp": False,
            "use_listen_notify": False,
            "notification_listener_polling_interval_sec": self._poll_s,
        }
        DBOS(config=config)
        logging.getLogger("dbos").setLevel(logging.WARNING)
        for each in (without_traceback, of_a_closed_engine):
            logging.getLogger("dbos").addFilter(each)
        DBOS.listen_queues(list(queues))
        DBOS.launch()
        for name, at_once in queues.items():
            DBOS.register_queue(
                name, worker_concurrency=at_once, polling_interval_sec=self._poll_s, on_conflict="always_update"
            )
        self._queues = frozenset(queues)
        self._launched = True

    def enqueue(self, job_id: str, queue: str) -> None:
        with SetWorkflowID(job_id):
            DBOS.enqueue_workflow(queue, _job, job_id)

    def known(self, job_ids: Collection[str]) -> set[str]:
        if not job_ids:
            return set()
        workflows = DBOS.list_workflows(
            workflow_ids=list(job_ids), status=list(_ALIVE), load_input=False, load_output=False
        )
        return {one.workflow_id for one in workflows if one.queue_name in self._queues}

    def over(self, limit: int) -> list[str]:
        # A file belongs to one host, even if the host had another name before.
        host = None if self._own is not None else self._host
        workflows = DBOS.list_workflows(
            status=list(_OVER), executor_id=host, limit=limit, load_input=False, load_output=False
        )
        return [one.workflow_id for one in workflows]

    def forget(self, job_ids: Collection[str]) -> None:
        if job_ids:
            DBOS.delete_workflows(list(job_ids))

    def alive(self) -> bool:
        return self._launched and self._damage.words is None

    def close(self) -> None:
        global _run
        _run = None  # a job that the engine begins from now on is left to the next start
        if self._launched:
            self._launched = False
            DBOS.destroy()
            if self._own is not None:
                checkpoint(self._own)
        self._damage.close()
        if self._own is not None:
            close_database(self._own)


def _set_aside(folder: Path) -> None:
    """Moves a damaged file away. The start finds unfinished jobs in the service's own tables, and creates the file
    anew."""
    aside = folder / f"damaged-{datetime.now(UTC):%Y%m%dT%H%M%S.%fZ}"
    aside.mkdir(mode=0o700)
    for path in folder.glob(f"{ENGINE_FILE}*"):
        path.rename(aside / path.name)
    log.warning("%s was damaged and is made anew: nothing is lost; the old one is in %s", folder / ENGINE_FILE, aside)

"""The store: short transactions on one SQLite file (WAL), called from job threads and from the API alike."""

from __future__ import annotations

import fcntl
import math
import secrets
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any

from alembic import command
from alembic.config import Config
from sqlalchemy import Engine, create_engine, event, func, select
from sqlalchemy.exc import IntegrityError
from sqlalchemy.orm import Session, sessionmaker

from service.security import audit
from service.states import ACTIVE, JobState, check
from service.store import chunks
from service.store.clock import now
from service.store.tables import ChunkRow, EventRow, JobRow
from tuning.plan import Sample
from tuning.reasons import Reason

DATABASE_FILE = "loopwright.sqlite"
LOCK_FILE = "lock"
DECISIONS = {JobState.ACCEPTED: "accept", JobState.ROLLED_BACK: "rollback"}
"""What the audit log calls the moves that somebody decides."""
_ACTIVE = [state.value for state in ACTIVE]


class Busy(Exception):
    """The loop already has an active job."""

    def __init__(self, loop: str, job_id: str) -> None:
        super().__init__(f"loop {loop} is busy with job {job_id}")
        self.loop = loop
        self.job_id = job_id


class NoSuchJob(Exception):
    """No job of that id."""

    def __init__(self, job_id: str) -> None:
        super().__init__(f"there is no job {job_id}")
        self.job_id = job_id


class FolderInUse(Exception):
    """Another service works in this data folder: two of them would interrupt each other's jobs."""


class Store:
    """Opens (and if needed creates or migrates) `loopwright.sqlite` in the data folder."""

    def __init__(self, folder: Path) -> None:
        self._folder_lock = lock_folder(folder)
        # One writer at a time inside the process: "read the last seq, write the next" must not interleave.
        self._write_lock = threading.Lock()
        self.engine = open_database(folder)
        self._session = sessionmaker(self.engine, expire_on_commit=False)

    def close(self) -> None:
        self.engine.dispose()
        self._folder_lock.close()

    @contextmanager
    def _writing(self) -> Iterator[Session]:
        with self._write_lock, self._session.begin() as session:
            yield session

    # jobs
    def create(self, loop: str, request: dict[str, Any], requested_by: str, dry_run: bool) -> JobRow:
        """A new queued job. Raises Busy when the loop has an active one."""
        row = JobRow(
            id=secrets.token_hex(6),
            loop=loop,
            state=JobState.QUEUED.value,
            dry_run=dry_run,
            request=clean(request),
            requested_by=requested_by,
            created_at=now(),
        )
        try:
            with self._writing() as session:
                session.add(row)
                session.flush()
                _append(session, row.id, "state", {"state": row.state, "by": requested_by}, 0.0)
                audit.record(session, "retune", row.id, after=row.request, loop=loop, said_by=requested_by)
        except IntegrityError as error:
            active = self.active(loop)
            if active is None:
                raise
            raise Busy(loop, active.id) from error
        return row

    def move(self, job_id: str, wanted: JobState, by: str = "service", **columns: Any) -> JobRow:
        """Moves the job as the table allows and sets the columns, in one transaction with its event."""
        with self._writing() as session:
            row = _find(session, job_id)
            previous = JobState(row.state)
            check(previous, wanted)
            row.state = wanted.value
            _set(row, columns)
            if wanted is JobState.RUNNING:
                row.started_at = now()
            elif previous in ACTIVE:
                row.ended_at = now()
            told = {"state": wanted.value, "from": previous.value, "by": by}
            told |= {key: columns[key] for key in ("reason", "detail") if columns.get(key)}
            _append(session, job_id, "state", told, row.plant_time_s)
            if wanted in (JobState.ACCEPTED, JobState.ROLLED_BACK):
                _audit_decision(session, row, previous, wanted, by)
            return row

    def update(self, job_id: str, **columns: Any) -> None:
        with self._writing() as session:
            _set(_find(session, job_id), columns)

    def get(self, job_id: str) -> JobRow:
        with self._session() as session:
            return _find(session, job_id)

    def active(self, loop: str) -> JobRow | None:
        """The job that has the loop, if any."""
        wanted = select(JobRow).where(JobRow.loop == loop, JobRow.state.in_(_ACTIVE), JobRow.dry_run.is_(False))
        with self._session() as session:
            return session.scalars(wanted).one_or_none()

    def unfinished(self) -> list[JobRow]:
        """Every job in an active state, dry runs included."""
        with self._session() as session:
            return list(session.scalars(select(JobRow).where(JobRow.state.in_(_ACTIVE)).order_by(JobRow.number)))

    def recent(self, loop: str | None = None, state: JobState | None = None, limit: int = 50) -> Sequence[JobRow]:
        """The latest jobs first."""
        wanted = select(JobRow).order_by(JobRow.number.desc()).limit(limit)
        if loop is not None:
            wanted = wanted.where(JobRow.loop == loop)
        if state is not None:
            wanted = wanted.where(JobRow.state == state.value)
        with self._session() as session:
            return session.scalars(wanted).all()

    # events
    def append(self, job_id: str, kind: str, data: dict[str, Any], plant_time_s: float) -> None:
        with self._writing() as session:
            _append(session, job_id, kind, data, plant_time_s)

    def abort_requested(self, job_id: str, by: str, plant_time_s: float) -> None:
        """Writes down who wants the job to end."""
        with self._writing() as session:
            row = _find(session, job_id)
            _append(session, job_id, "abort_requested", {"by": by}, plant_time_s)
            audit.record(session, "abort", job_id, before={"state": row.state}, loop=row.loop, said_by=by)

    def decision_failed(self, job_id: str, wanted: JobState, by: str, detail: str) -> None:
        """A decision that reached for the controller and ended in an error: its gains may have been written."""
        with self._writing() as session:
            row = _find(session, job_id)
            what = f"{DECISIONS[wanted]}_failed"
            audit.record(
                session, what, job_id, before={"state": row.state}, after={"error": detail}, loop=row.loop, said_by=by
            )

    def events(self, job_id: str, after: int = 0) -> Sequence[EventRow]:
        wanted = select(EventRow).where(EventRow.job_id == job_id, EventRow.seq > after).order_by(EventRow.seq)
        with self._session() as session:
            return session.scalars(wanted).all()

    def restored(self, source: str) -> int:
        """Ends what was active when a back-up was made: its experiment is long over. Returns how many jobs."""
        active = self.unfinished()
        for row in active:
            detail = f"was {row.state} when the back-up was made that has now been restored"
            self.move(row.id, JobState.INTERRUPTED, reason=Reason.SERVICE_STOPPED.value, detail=detail)
        with self._writing() as session:
            audit.record(session, "restore", source, after={"interrupted": [row.id for row in active]})
        return len(active)

    # samples
    def add_samples(self, job_id: str, stage: str, samples: Sequence[Sample]) -> None:
        with self._writing() as session:
            seq = session.scalar(select(func.max(ChunkRow.seq)).where(ChunkRow.job_id == job_id)) or 0
            block = chunks.pack(samples)
            session.add(
                ChunkRow(
                    job_id=job_id, seq=seq + 1, stage=stage, first_t_s=samples[0].t, count=len(samples), data=block
                )
            )

    def samples(self, job_id: str, stage: str | None = None) -> list[tuple[str, list[Sample]]]:
        """The blocks in order, each with the stage it belongs to."""
        wanted = select(ChunkRow).where(ChunkRow.job_id == job_id).order_by(ChunkRow.seq)
        if stage is not None:
            wanted = wanted.where(ChunkRow.stage == stage)
        with self._session() as session:
            rows = session.scalars(wanted).all()
        return [(row.stage, chunks.unpack(row.data, row.count, row.first_t_s)) for row in rows]


def lock_folder(folder: Path) -> IO[str]:
    """Makes the data folder if need be, and takes it until the answer is closed. Raises FolderInUse."""
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    held = open(folder / LOCK_FILE, "w")  # noqa: SIM115 - the caller closes it
    try:
        fcntl.flock(held, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        held.close()
        raise FolderInUse(f"another service works in the data folder {folder}") from error
    return held


def open_database(folder: Path) -> Engine:
    """The database of a data folder, at the present revision. Takes no lock: a running service may have it open."""
    engine = create_engine(f"sqlite:///{folder / DATABASE_FILE}", connect_args={"timeout": 5.0})
    event.listen(engine, "connect", _pragmas)
    config = Config()
    config.set_main_option("script_location", "service.store:migrations")
    with engine.begin() as connection:
        config.attributes["connection"] = connection
        command.upgrade(config, "head")
    return engine


def clean(value: Any) -> Any:
    """The same JSON value with NaN and infinities as null, which JSON has no words for."""
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, dict):
        return {str(key): clean(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [clean(item) for item in value]
    return value


def _pragmas(connection: Any, _record: object) -> None:
    cursor = connection.cursor()
    # WAL: readers (the API) never wait for a job's writes. NORMAL: a power cut may lose the last moments, no more.
    for pragma in ("journal_mode=WAL", "synchronous=NORMAL", "foreign_keys=ON"):
        cursor.execute(f"PRAGMA {pragma}")
    cursor.close()


def _find(session: Session, job_id: str) -> JobRow:
    row = session.scalars(select(JobRow).where(JobRow.id == job_id)).one_or_none()
    if row is None:
        raise NoSuchJob(job_id)
    return row


def _set(row: JobRow, columns: dict[str, Any]) -> None:
    for name, value in columns.items():
        setattr(row, name, clean(value))


def _audit_decision(session: Session, row: JobRow, previous: JobState, wanted: JobState, by: str) -> None:
    old, new = row.old_gains, (row.result or {}).get("gains")
    had, has = (new, old) if previous is JobState.ACCEPTED else (old, new if wanted is JobState.ACCEPTED else old)
    audit.record(
        session,
        DECISIONS[wanted],
        row.id,
        before={"state": previous.value, "gains": had},
        after={"state": wanted.value, "gains": has},
        loop=row.loop,
        said_by=by,
    )


def _append(session: Session, job_id: str, kind: str, data: dict[str, Any], plant_time_s: float) -> None:
    seq = session.scalar(select(func.max(EventRow.seq)).where(EventRow.job_id == job_id)) or 0
    session.add(EventRow(job_id=job_id, seq=seq + 1, at=now(), plant_time_s=plant_time_s, kind=kind, data=clean(data)))

"""The store: short transactions on SQLite or PostgreSQL, called from the journal, the jobs and the API alike."""

from __future__ import annotations

import secrets
import threading
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Unpack

from sqlalchemy import ColumnElement, delete, func, select, update
from sqlalchemy.exc import IntegrityError, SQLAlchemyError, TimeoutError
from sqlalchemy.orm import Session

from loopwright.service.jsonable import json_object
from loopwright.service.states.job_state import ACTIVE, JobState
from loopwright.service.store import (
    audit,
    batches,
    idempotency_effects,
    illegal_moves,
    job_rows,
    loop_locks,
    sample_blocks,
)
from loopwright.service.store.clock import now
from loopwright.service.store.damage import Damage
from loopwright.service.store.database import (
    FILE,
    RESERVE,
    WAIT_S,
    BadDatabase,
    checkpoint,
    close_database,
    migrate,
    open_database,
    postgresql,
    sessions,
)
from loopwright.service.store.events import events
from loopwright.service.store.jobs import Job, JobColumns, JobEvent
from loopwright.service.store.lock import FolderLock, HostLock, ourselves
from loopwright.service.store.tables import BatchRow, ChunkRow, EventRow, HostRow, JobRow, LoopRow
from loopwright.tuning.plan import Sample
from loopwright.tuning.reasons import Reason

WithJob = Callable[[Session, JobRow], None]
"""A piece of the transaction that makes or moves a job."""
OnMove = Callable[[Session, Job], None]
"""A piece of the transaction in which a job has moved."""
LOCAL = "local"
_BLOCKS_AT_ONCE = 16
_JOBS_AT_ONCE = 100
_ACTIVE = [state.value for state in ACTIVE]


class Busy(Exception):
    """The loop already has an active job. detail: whose, since when, and what to do next."""

    def __init__(self, loop: str, job_id: str, detail: str = "") -> None:
        super().__init__(detail or f"loop {loop} is busy with job {job_id}: wait for its end, or abort it")
        self.loop = loop
        self.job_id = job_id


class ForeignLoop(Exception):
    """A loop of that tag belongs to another host."""


class Store:
    """Opens (and if needed creates or migrates) `loopwright.sqlite` in the data folder, or a PostgreSQL database.

    host: the name under which this service owns its loops and jobs. A data folder without a PostgreSQL database has
    one host, whatever it was called before. Raises FolderInUse, BadDatabase.
    """

    def __init__(self, folder: Path, database: str | None = None, host: str = LOCAL) -> None:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        self.host = host
        self.on_move: OnMove | None = None
        """Called in the transaction in which a job has moved; what it raises ends the transaction."""
        self.folder = folder
        self.folder_lock = FolderLock(folder)
        self.host_lock: HostLock | None = None
        self._damage = Damage(folder / FILE if database is None else None)
        try:
            if (damaged := self._damage.look()) is not None:
                raise BadDatabase(damaged)
            name = f"loopwright {host}, {ourselves()}"
            self.engine = open_database(folder, database, name)
            self._reserve = open_database(folder, database, name, RESERVE)
            for engine in (self.engine, self._reserve):
                self._damage.watch(engine)
            self.shared = self.engine.dialect.name != "sqlite"
            # One writer at a time inside the process: SQLite has one anyway, and does not queue them fairly.
            self._write_lock = None if self.shared else threading.Lock()
            self._session = sessions(self.engine, self._reserve)
            if database is not None:
                self.host_lock = HostLock(postgresql(database, name, pool=None), host, folder)
                self.host_lock.refuse()
            migrate(self.engine)
            if self.host_lock is not None:
                self.host_lock.take()
            else:
                self._adopt()
        except BaseException as error:
            self._let_go()
            if isinstance(error, SQLAlchemyError) and self.damaged is not None:
                raise BadDatabase(self.damaged) from error
            raise

    def _adopt(self) -> None:
        """The one host of a data folder has everything in it."""
        with self.writing() as session:
            for table in (JobRow, LoopRow, BatchRow, HostRow):
                session.execute(update(table).where(table.host != self.host).values(host=self.host))

    def close(self) -> None:
        checkpoint(self.engine)
        self._let_go()

    def _let_go(self) -> None:
        self._damage.close()
        if self.host_lock is not None:
            self.host_lock.close()
        for engine in ("engine", "_reserve"):
            if hasattr(self, engine):
                close_database(getattr(self, engine))
        self.folder_lock.close()

    def check_lock(self) -> None:
        """Takes the lock on our host name again after the database was away. Raises FolderInUse when another service
        has the name."""
        if self.host_lock is not None:
            self.host_lock.check()

    @contextmanager
    def writing(self) -> Iterator[Session]:
        """A transaction. Raises FolderInUse when another service has our name: what was ours is that one's."""
        if self._write_lock is not None and not self._write_lock.acquire(timeout=WAIT_S):
            raise TimeoutError("another writer of this process waits for the database")
        try:
            with self._session.begin() as session:
                if self.host_lock is not None:
                    self.host_lock.check_claim(session)
                yield session
        finally:
            if self._write_lock is not None:
                self._write_lock.release()

    @contextmanager
    def reading(self) -> Iterator[Session]:
        with self._session() as session:
            yield session

    @property
    def damaged(self) -> str | None:
        """What is wrong with the file, and what to do; None: nothing is known to be."""
        return self._damage.words

    def ping(self) -> None:
        """Raises BadDatabase where the file is damaged, SQLAlchemyError unless the database takes and keeps something:
        one that only answers is of no use to a job."""
        if self.damaged is not None:
            raise BadDatabase(self.damaged)
        with self.writing() as session:
            of_host(session, self.host).written_at = now()

    # loops
    def own_loops(self, loops: Mapping[str, Mapping[str, object]]) -> None:
        """These are the loops of this host from now on, by tag.

        A loop of a host that is not running is taken over with its active job, and monitored here if it was there:
        its bus has moved. Raises ForeignLoop when the other host is running.
        """
        others_of = select(LoopRow).where(LoopRow.tag.in_(loops), LoopRow.host != self.host)
        if self.host_lock is not None:
            with self._session() as session:
                names = {row.host for row in session.scalars(others_of)}
            self.host_lock.wait_for(names)
        with self.writing() as session:
            foreign = session.scalars(others_of).all()
            free = {host: HostLock.free(session, host) for host in {row.host for row in foreign}}
            taken = [row for row in foreign if not free[row.host]]
            if taken:
                others = ", ".join(f"{row.tag} of {row.host}" for row in taken)
                raise ForeignLoop(f"loops of other hosts: {others}; take them out of one of the two configurations")
            moved = [row.tag for row in foreign]
            session.execute(
                update(JobRow)
                .where(JobRow.loop.in_(moved), JobRow.state.in_(_ACTIVE) | JobRow.restore_unconfirmed.is_(True))
                .values(host=self.host)
            )
            session.execute(delete(LoopRow).where((LoopRow.host == self.host) | LoopRow.tag.in_(moved)))
            session.add_all(LoopRow(tag=tag, host=self.host, config=config) for tag, config in loops.items())

    def foreign_loops(self) -> Sequence[LoopRow]:
        """The loops of the other hosts."""
        if not self.shared:
            return []
        with self._session() as session:
            wanted = select(LoopRow).where(LoopRow.host != self.host).order_by(LoopRow.host, LoopRow.tag)
            return session.scalars(wanted).all()

    def foreign_loop(self, tag: str) -> LoopRow | None:
        if not self.shared:
            return None
        with self._session() as session:
            return session.scalars(select(LoopRow).where(LoopRow.tag == tag, LoopRow.host != self.host)).one_or_none()

    # jobs
    def create(
        self,
        loop: str,
        request: Mapping[str, object],
        by: str,
        dry_run: bool,
        host: str | None = None,
        version: str = "0",
        also: WithJob | None = None,
    ) -> Job:
        """A new queued job, on this host unless on another. Raises Busy when the loop has an active one, and Locked,
        NotAcknowledged."""
        row = JobRow(
            id=secrets.token_hex(6),
            loop=loop,
            state=JobState.QUEUED,
            dry_run=dry_run,
            request=json_object(request),
            by=by,
            created_at=now(),
            host=host or self.host,
            version=version,
        )
        try:
            with self.writing() as session:
                job_rows.may_begin(session, row)
                session.add(row)
                session.flush()
                job_rows.append(session, row.id, "state", {"state": row.state, "by": by}, 0.0)
                idempotency_effects.made(session, f"/jobs/{row.id}")
                audit.record(session, "retune", row.id, after=row.request, loop=loop, by=by)
                if also is not None:
                    also(session, row)
                return Job.from_row(row)
        except IntegrityError as error:
            busy = self.why_busy(loop)
            if busy is None:
                raise
            raise busy from error

    def move(
        self,
        job_id: str,
        wanted: JobState,
        by: str = "service",
        also: WithJob | None = None,
        **columns: Unpack[JobColumns],
    ) -> Job:
        """Moves the job as the table allows and sets the columns, in one transaction with its event and with what is
        to be stored also. Raises IllegalMove, and Locked where its test is to begin."""
        with self.writing() as session:
            row = job_rows.move(session, job_rows.find(session, job_id, lock=True), wanted, by, columns)
            if also is not None:
                also(session, row)
            return self._moved(session, row)

    def decline(self, job_id: str, by: str) -> Job | None:
        """Rolls back a proposal of which nothing was written to the controller; None when it is no such one."""
        with self.writing() as session:
            row = job_rows.find(session, job_id, lock=True)
            if row.state != JobState.PROPOSED or job_rows.last_begun(session, job_id) is not None:
                return None
            return self._moved(session, job_rows.move(session, row, JobState.ROLLED_BACK, by, {}))

    def _moved(self, session: Session, row: JobRow) -> Job:
        job = Job.from_row(row)
        if self.on_move is not None:
            self.on_move(session, job)
        return job

    def decision_begun(self, job_id: str) -> bool:
        """Whether any decision on the job may have written to the controller."""
        with self._session() as session:
            return job_rows.last_begun(session, job_id) is not None

    def begin_decision(self, job_id: str, wanted: JobState, by: str) -> None:
        """Notes that the controller is about to be written to. Raises IllegalMove when another was faster, Locked."""
        with self.writing() as session:
            row = job_rows.find(session, job_id, lock=True)
            job_rows.check(session, row, wanted)
            loop_locks.check(session, row.loop)
            details = {"decision": job_rows.DECISIONS[wanted], "by": by}
            job_rows.append(session, job_id, job_rows.BEGUN, details, row.plant_time_s)

    def doubt_proposals(self, why: str) -> None:
        """Notes of the proposals of every host that a decision may have been made about them which is not in this
        database: a rollback then reads the controller, and puts the previous gains back where it holds the new ones."""
        with self.writing() as session:
            job_rows.doubt_proposals(session, why)

    def resumed(self, job_id: str, details: Mapping[str, object], **columns: Unpack[JobColumns]) -> None:
        """Notes that an active job has begun another attempt. Raises IllegalMove when it is over, Locked."""
        with self.writing() as session:
            row = job_rows.find(session, job_id, lock=True)
            if row.state not in ACTIVE:
                raise illegal_moves.too_late(row, row.state, JobState.RUNNING, job_rows.decided(session, row))
            job_rows.may_begin(session, row)
            job_rows.set_columns(row, columns)
            job_rows.append(session, job_id, "resumed", details, row.plant_time_s)

    def note(self, job_id: str, **columns: Unpack[JobColumns]) -> None:
        """Sets columns of an active job."""
        with self.writing() as session:
            job_rows.set_columns(job_rows.find(session, job_id, lock=True), columns)

    def note_session(self, job_id: str, number: int) -> None:
        """The session that is about to be opened for the job; 0: it was refused, and there is none."""
        self.note(job_id, session=number or None)

    def get(self, job_id: str) -> Job:
        with self._session() as session:
            return Job.from_row(job_rows.find(session, job_id))

    def retune_of(self, job_id: str) -> str | None:
        """Id of the batch that has begun the job; None: there is none."""
        with self._session() as session:
            return batches.of_job(session, job_id)

    def active(self, loop: str) -> Job | None:
        """The job that has the loop, if any."""
        wanted = select(JobRow).where(JobRow.loop == loop, JobRow.state.in_(_ACTIVE), JobRow.dry_run.is_(False))
        with self._session() as session:
            row = session.scalars(wanted).one_or_none()
        return None if row is None else Job.from_row(row)

    def why_busy(self, loop: str) -> Busy | None:
        """The error for who asks for the loop; None: no job has it."""
        wanted = select(JobRow).where(JobRow.loop == loop, JobRow.state.in_(_ACTIVE), JobRow.dry_run.is_(False))
        with self._session() as session:
            row = session.scalars(wanted).one_or_none()
            return None if row is None else Busy(loop, row.id, illegal_moves.busy(row))

    def check_move(self, job_id: str, wanted: JobState) -> None:
        """Raises IllegalMove, with words for who asks for it, unless the job may become so."""
        with self._session() as session:
            job_rows.check(session, job_rows.find(session, job_id), wanted)

    def busy(self) -> dict[str, str]:
        """The active job by loop, of every host."""
        wanted = select(JobRow.loop, JobRow.id).where(JobRow.state.in_(_ACTIVE), JobRow.dry_run.is_(False))
        with self._session() as session:
            return {row.loop: row.id for row in session.execute(wanted)}

    def unfinished(self) -> list[Job]:
        """Every job of this host in an active state, dry runs included."""
        mine = (JobRow.host == self.host, JobRow.state.in_(_ACTIVE))
        with self._session() as session:
            return list(map(Job.from_row, session.scalars(select(JobRow).where(*mine).order_by(JobRow.number))))

    def active_among(self, job_ids: Collection[str]) -> set[str]:
        """Those of the jobs that are in an active state."""
        with self._session() as session:
            return set(session.scalars(select(JobRow.id).where(JobRow.id.in_(job_ids), JobRow.state.in_(_ACTIVE))))

    def stop_requests(self) -> dict[str, Reason]:
        """The reason by job, for the active jobs of this host that somebody wants to stop."""
        mine = (JobRow.host == self.host, JobRow.state.in_(_ACTIVE), JobRow.stop_reason.is_not(None))
        with self._session() as session:
            rows = session.execute(select(JobRow.id, JobRow.stop_reason).where(*mine))
            return {row.id: Reason(row.stop_reason) for row in rows}

    def request_stop(self, job_id: str, reason: Reason, by: str, heard: bool = False) -> Job:
        """Notes that the job is to stop, once. Raises IllegalMove when it is over.

        heard: the job knows of this request already, and may have ended for it by now.
        """
        with self.writing() as session:
            return Job.from_row(job_rows.note_stop(session, job_id, reason, by, heard))

    def decision_failed(self, job_id: str, wanted: JobState, by: str, detail: str) -> None:
        """A decision that reached for the controller and ended in an error: its gains may have been written."""
        with self.writing() as session:
            row = job_rows.find(session, job_id)
            what = f"{job_rows.DECISIONS[wanted]}_failed"
            audit.record(
                session, what, job_id, before={"state": row.state}, after={"error": detail}, loop=row.loop, by=by
            )

    def last_models(self, loop: str | None = None) -> dict[str, Job]:
        """The latest job by loop, of every host or of one loop, that has found a model on the live loop."""
        ended = (JobState.PROPOSED.value, JobState.ACCEPTED.value, JobState.ROLLED_BACK.value)
        last = select(func.max(JobRow.number)).where(JobRow.dry_run.is_(False), JobRow.state.in_(ended))
        if loop is not None:
            last = last.where(JobRow.loop == loop)
        with self._session() as session:
            return {
                row.loop: Job.from_row(row)
                for row in session.scalars(select(JobRow).where(JobRow.number.in_(last.group_by(JobRow.loop))))
            }

    def recent(
        self,
        loop: str | None = None,
        state: JobState | None = None,
        limit: int = 50,
        before: int | None = None,
        id_begins: str | None = None,
    ) -> Sequence[Job]:
        """The latest jobs first; before: only those with a smaller number; id_begins: how their ids begin."""
        wanted = select(JobRow).order_by(JobRow.number.desc()).limit(limit)
        if before is not None:
            wanted = wanted.where(JobRow.number < before)
        if loop is not None:
            wanted = wanted.where(JobRow.loop == loop)
        if state is not None:
            wanted = wanted.where(is_shown_as(state))
        if id_begins is not None:
            wanted = wanted.where(JobRow.id.startswith(id_begins, autoescape=True))
        with self._session() as session:
            return [Job.from_row(row) for row in session.scalars(wanted)]

    def tests_of(self, loop: str, limit: int) -> Sequence[Job]:
        """The latest jobs of the loop first; no dry runs, which have found nothing."""
        mine = (JobRow.loop == loop, JobRow.dry_run.is_(False))
        with self._session() as session:
            latest = session.scalars(select(JobRow).where(*mine).order_by(JobRow.number.desc()).limit(limit))
            return [Job.from_row(row) for row in latest]

    # events
    def append(self, job_id: str, kind: str, data: Mapping[str, object], plant_time_s: float) -> None:
        with self.writing() as session:
            job_rows.find(session, job_id, lock=True)
            job_rows.append(session, job_id, kind, data, plant_time_s)

    def events(self, job_id: str, after: int = 0, limit: int | None = None) -> Sequence[JobEvent]:
        """In order; after: only those with a larger number."""
        with self._session() as session:
            return events(session, EventRow.job_id == job_id, EventRow.seq > after, limit=limit)

    def events_by_job(self, job_ids: Sequence[str], limit: int) -> dict[str, list[JobEvent]]:
        """The first events of each of these jobs, in order: a query for a hundred jobs, not for each."""
        found: dict[str, list[JobEvent]] = {job_id: [] for job_id in job_ids}
        with self._session() as session:
            for begin in range(0, len(job_ids), _JOBS_AT_ONCE):
                some = job_ids[begin : begin + _JOBS_AT_ONCE]
                for event in events(session, EventRow.job_id.in_(some), EventRow.seq <= limit):
                    found[event.job_id].append(event)
        return found

    def restored(self, source: str) -> int:
        """Ends what was active when a back-up was made: its experiment is long over. What was a proposal then may have
        been accepted since. Returns how many jobs were active."""
        active = self.unfinished()
        for row in active:
            detail = f"was {row.state} when the back-up was made that has now been restored"
            self.move(row.id, JobState.INTERRUPTED, reason=Reason.SERVICE_STOPPED.value, detail=detail)
        with self.writing() as session:
            job_rows.doubt_proposals(session, f"the back-up {source} was restored")
            for retune in batches.unfinished(session, self.host):
                detail = f"was {retune.state} when the back-up was made that has now been restored"
                batches.stop(session, retune.id, batches.StopReason.SERVICE_STOPPED, detail)
                batches.end(session, retune.id)
            audit.record(session, "restore", source, after={"interrupted": [row.id for row in active]})
        return len(active)

    # samples
    def last_sample_s(self, job_id: str) -> float:
        """Time of the last sample kept of a job, s; 0 when there is none."""
        last = select(ChunkRow).where(ChunkRow.job_id == job_id).order_by(ChunkRow.seq.desc()).limit(1)
        with self._session() as session:
            row = session.scalars(last).one_or_none()
        return 0.0 if row is None else sample_blocks.unpack(_block(row))[-1].t

    def last_block(self, job_id: str) -> int:
        """Number of the last block of samples that is kept of a job as yet; 0: there is none."""
        with self._session() as session:
            return session.scalar(select(func.max(ChunkRow.seq)).where(ChunkRow.job_id == job_id)) or 0

    def blocks(self, job_id: str, stage: str | None = None, last: int | None = None) -> Iterator[sample_blocks.Block]:
        """The blocks of samples in order, up to number `last`: a few at a time, each time in a short transaction of its
        own, so that a slow reader holds neither a connection nor the memory."""
        wanted = select(ChunkRow).where(ChunkRow.job_id == job_id).order_by(ChunkRow.seq).limit(_BLOCKS_AT_ONCE)
        if stage is not None:
            wanted = wanted.where(ChunkRow.stage == stage)
        if last is not None:
            wanted = wanted.where(ChunkRow.seq <= last)
        after = 0
        while True:
            with self._session() as session:
                rows = session.scalars(wanted.where(ChunkRow.seq > after)).all()
            yield from map(_block, rows)
            if len(rows) < _BLOCKS_AT_ONCE:
                return
            after = rows[-1].seq

    def samples(self, job_id: str, stage: str | None = None) -> list[tuple[str, list[Sample]]]:
        """The blocks in order, each with the stage it belongs to: all of them in memory."""
        return [(block.stage, sample_blocks.unpack(block)) for block in self.blocks(job_id, stage)]


def _block(row: ChunkRow) -> sample_blocks.Block:
    return sample_blocks.Block(row.stage, row.first_t_s, row.count, row.data)


def is_shown_as(state: JobState) -> ColumnElement[bool]:
    """As `service.states.job_state.shown` has it."""
    stored = JobRow.state == state.value
    if state is JobState.PROPOSED:
        return stored & JobRow.dry_run.is_(False)
    if state is JobState.REHEARSED:
        return stored | ((JobRow.state == JobState.PROPOSED.value) & JobRow.dry_run.is_(True))
    return stored


def of_host(session: Session, host: str) -> HostRow:
    """What the host keeps of itself; a row is made if there is none."""
    row = session.get(HostRow, host)
    if row is None:
        row = HostRow(host=host)
        session.add(row)
    return row

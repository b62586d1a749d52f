"""The tables. Times are UTC as ISO 8601 text; JSON columns hold plain objects without NaN."""

from __future__ import annotations

from enum import StrEnum

from sqlalchemy import (
    JSON,
    BigInteger,
    Dialect,
    Double,
    ForeignKey,
    Index,
    LargeBinary,
    String,
    Text,
    TypeDecorator,
    text,
)
from sqlalchemy.orm import DeclarativeBase, Mapped, mapped_column

from loopwright.service.jsonable import JsonObject
from loopwright.service.results import RESULT, FastResult, Finding, FiveStageResult
from loopwright.service.states.acceptance_watch import AcceptanceWatch
from loopwright.service.states.job_state import JobState
from loopwright.tuning.reasons import Reason


class EnumColumn(TypeDecorator[StrEnum | str]):
    """A closed list as text. The database does not check it: a version that adds a word needs no migration. A word that
    is not in the list comes as it is, so that the row with it can be named (`service.store.jobs`)."""

    impl = String
    cache_ok = True

    def __init__(self, kind: type[StrEnum]) -> None:
        super().__init__()
        self.kind = kind

    def process_bind_param(self, value: str | None, dialect: Dialect) -> str | None:
        return None if value is None else self.kind(value).value

    def process_result_value(self, value: str | None, dialect: Dialect) -> StrEnum | str | None:
        return self.kind(value) if value in set(self.kind) else value


class ResultColumn(TypeDecorator[FastResult | FiveStageResult]):
    """The result of a job, as JSON."""

    impl = JSON
    cache_ok = True

    def process_bind_param(self, value: FastResult | FiveStageResult | None, dialect: Dialect) -> JsonObject | None:
        return None if value is None else value.model_dump(mode="json")

    def process_result_value(self, value: JsonObject | None, dialect: Dialect) -> FastResult | FiveStageResult | None:
        return None if value is None else RESULT.validate_python(value)


class FindingColumn(TypeDecorator[Finding]):
    """What a test or normal operation has shown of a loop, as JSON."""

    impl = JSON
    cache_ok = True

    def process_bind_param(self, value: Finding | None, dialect: Dialect) -> JsonObject | None:
        return None if value is None else value.model_dump(mode="json")

    def process_result_value(self, value: JsonObject | None, dialect: Dialect) -> Finding | None:
        return None if value is None else Finding.model_validate(value)


class WatchColumn(TypeDecorator[AcceptanceWatch]):
    """The watch of a loop after gains were accepted, as JSON."""

    impl = JSON
    cache_ok = True

    def process_bind_param(self, value: AcceptanceWatch | None, dialect: Dialect) -> JsonObject | None:
        return None if value is None else value.model_dump(mode="json")

    def process_result_value(self, value: JsonObject | None, dialect: Dialect) -> AcceptanceWatch | None:
        return None if value is None else AcceptanceWatch.model_validate(value)


class Base(DeclarativeBase):
    type_annotation_map = {JsonObject: JSON, dict[str, float]: JSON, dict[str, str]: JSON}


class JobRow(Base):
    __tablename__ = "jobs"
    # The database itself, not only the service, keeps a loop from being tuned by two jobs at once.
    # A dry run does not touch the loop and does not count.
    __table_args__ = (
        Index(
            "one_active_job_per_loop",
            "loop",
            unique=True,
            sqlite_where=text("state IN ('queued', 'running') AND dry_run = 0"),
            postgresql_where=text("state IN ('queued', 'running') AND NOT dry_run"),
        ),
        Index("jobs_by_loop", "loop", "number"),
        Index("jobs_by_host", "host", "state"),
        Index("jobs_by_reason", "reason"),
        Index("jobs_restore_unconfirmed", "restore_unconfirmed"),
        Index("jobs_false_pv", "false_pv"),
    )

    number: Mapped[int] = mapped_column(primary_key=True, autoincrement=True)
    id: Mapped[str] = mapped_column(unique=True)
    loop: Mapped[str]
    state: Mapped[JobState] = mapped_column(EnumColumn(JobState))
    dry_run: Mapped[bool]
    request: Mapped[JsonObject]
    by: Mapped[str]
    created_at: Mapped[str]
    started_at: Mapped[str | None]
    ended_at: Mapped[str | None]
    stage: Mapped[str | None]
    plant_time_s: Mapped[float] = mapped_column(default=0.0)
    stage_times_s: Mapped[dict[str, float] | None]
    reason: Mapped[Reason | None] = mapped_column(EnumColumn(Reason))
    detail: Mapped[str | None]
    previous_gains: Mapped[JsonObject | None]
    restored: Mapped[JsonObject | None]
    result: Mapped[FastResult | FiveStageResult | None] = mapped_column(ResultColumn)
    # The host that runs it, the version of the workflow it was started under, how often it was started.
    host: Mapped[str] = mapped_column(server_default="local")
    version: Mapped[str] = mapped_column(server_default="0")
    attempt: Mapped[int] = mapped_column(server_default="0", default=0)
    # The loop as the first attempt found it, before anything was touched: what every attempt has to bring back.
    found: Mapped[JsonObject | None]
    # The number of the session that was opened last, written down before it was: a later process can close it.
    session: Mapped[int | None] = mapped_column(BigInteger)
    # The loop was not read back as home: it is looked at until it is, or a person says otherwise.
    restore_unconfirmed: Mapped[bool] = mapped_column(server_default=text("false"), default=False)
    # The test has found PV to be false: no other begins on the loop until its alarm is acknowledged.
    false_pv: Mapped[bool] = mapped_column(server_default=text("false"), default=False)
    # Why the job is to stop, once somebody wants it to: any host may write it, the job's own host acts.
    stop_reason: Mapped[Reason | None] = mapped_column(EnumColumn(Reason))


class LoopRow(Base):
    """A loop of some host, as that host's configuration has it."""

    __tablename__ = "loops"

    tag: Mapped[str] = mapped_column(primary_key=True)
    host: Mapped[str]
    config: Mapped[JsonObject]


class LoopLockRow(Base):
    """A loop that somebody has locked. Apart from the loops, which each host writes anew at its start."""

    __tablename__ = "loop_locks"

    loop: Mapped[str] = mapped_column(primary_key=True)
    reason: Mapped[str]
    by: Mapped[str]
    since: Mapped[str]


class HostRow(Base):
    """What a host keeps of itself."""

    __tablename__ = "hosts"

    host: Mapped[str] = mapped_column(primary_key=True)
    # Which service has the name, on a shared database; no claim: it was given back at a clean stop.
    claim: Mapped[str | None]
    claimed_by: Mapped[str | None]
    # The wall clock as it was last looked at, and the time before which nothing counts as having ended.
    seen_at: Mapped[str | None]
    ages_from: Mapped[str | None]
    # When somebody last asked whether the database takes anything.
    written_at: Mapped[str | None]


class GatewayRow(Base):
    """What a gateway says of itself to those that share its database, once a second: see service.live.snapshot.

    at_s: when, seconds since 1970 UTC by the clock of the database.
    present: what `GET /live` shows of its loops, buses and jobs, as JSON.
    settings: what its controllers were read as, as JSON; written when it has changed.
    """

    __tablename__ = "gateways"

    name: Mapped[str] = mapped_column(primary_key=True)
    at_s: Mapped[float] = mapped_column(Double)
    url: Mapped[str | None]
    version: Mapped[str]
    present: Mapped[str] = mapped_column(Text)
    settings: Mapped[str] = mapped_column(Text)


class DecisionRequestRow(Base):
    """What was asked at one gateway and another one has to carry out: see service.store.decision_requests.

    host: the gateway that carries it out.  asked_at: the gateway at which it was asked.
    asked_s, expires_s: seconds since 1970 UTC by the clock of the database; it is not begun after the second.
    who: the caller.  claim_...: the Idempotency-Key that the caller gave.
    auto_rollback: of an acceptance, whether the previous gains are put back where something goes wrong; null: of
    another request.
    """

    __tablename__ = "decision_requests"
    __table_args__ = (
        Index("decision_requests_by_host", "host", "state"),
        Index("decision_requests_by_job", "job_id", "number"),
    )

    number: Mapped[int] = mapped_column(primary_key=True, autoincrement=True)
    host: Mapped[str]
    asked_at: Mapped[str]
    asked_s: Mapped[float] = mapped_column(Double)
    expires_s: Mapped[float] = mapped_column(Double)
    what: Mapped[str]
    loop: Mapped[str]
    job_id: Mapped[str | None] = mapped_column(ForeignKey("jobs.id"))
    by: Mapped[str]
    who: Mapped[JsonObject]
    claim_principal: Mapped[str | None]
    claim_key: Mapped[str | None]
    claim_token: Mapped[str | None]
    state: Mapped[str]
    answer: Mapped[JsonObject | None]
    auto_rollback: Mapped[bool | None]


class EventRow(Base):
    """One thing that happened in a job; seq counts from 1 within the job and is the id of the server-sent event."""

    __tablename__ = "events"

    job_id: Mapped[str] = mapped_column(ForeignKey("jobs.id"), primary_key=True)
    seq: Mapped[int] = mapped_column(primary_key=True)
    at: Mapped[str]
    plant_time_s: Mapped[float]
    kind: Mapped[str]
    data: Mapped[JsonObject]


class ChunkRow(Base):
    """A block of samples of one stage, see service.store.sample_blocks for the layout of `data`."""

    __tablename__ = "sample_chunks"

    job_id: Mapped[str] = mapped_column(ForeignKey("jobs.id"), primary_key=True)
    seq: Mapped[int] = mapped_column(primary_key=True)
    stage: Mapped[str]
    first_t_s: Mapped[float]
    count: Mapped[int]
    data: Mapped[bytes] = mapped_column(LargeBinary)


class HistoryRow(Base):
    """A block of the history of a loop: bins of the samples that were heard, see service.listening.bins for the layout
    of `data`. Times are seconds since 1970 UTC: they are compared, and 8 bytes."""

    __tablename__ = "history_blocks"
    __table_args__ = (Index("history_blocks_by_age", "host", "last_s"),)

    loop: Mapped[str] = mapped_column(primary_key=True)
    first_s: Mapped[float] = mapped_column(Double, primary_key=True)
    last_s: Mapped[float] = mapped_column(Double)
    after_s: Mapped[float | None] = mapped_column(Double)
    host: Mapped[str]
    count: Mapped[int]
    data: Mapped[bytes] = mapped_column(LargeBinary)


class KnowledgeRow(Base):
    """What a test or normal operation has shown of a loop. superseded: why it is no longer true; null: it is."""

    __tablename__ = "loop_knowledge"
    __table_args__ = (Index("loop_knowledge_by_loop", "loop", "number"),)

    number: Mapped[int] = mapped_column(primary_key=True, autoincrement=True)
    loop: Mapped[str]
    at: Mapped[str]
    finding: Mapped[Finding] = mapped_column(FindingColumn)
    superseded: Mapped[str | None]


class JobKnowledgeRow(Base):
    """What was known of a loop from operation as a job began, see service.observing.packed_plant for the layout of
    `data`; null: deleted with the samples. outdated_at: when the job has shown another plant; null: it has not."""

    __tablename__ = "job_knowledge"
    __table_args__ = (Index("job_knowledge_by_loop", "loop", "outdated_at"),)

    job_id: Mapped[str] = mapped_column(ForeignKey("jobs.id"), primary_key=True)
    loop: Mapped[str]
    data: Mapped[bytes | None] = mapped_column(LargeBinary)
    outdated_at: Mapped[str | None]


class JobFiguresRow(Base):
    """What was computed of a job after its end: see service.jobs.job_figures. version: of the computation.
    record: packed; null: there is none, or it was deleted with the samples.  designs: null: there are none."""

    __tablename__ = "job_figures"

    job_id: Mapped[str] = mapped_column(ForeignKey("jobs.id"), primary_key=True)
    version: Mapped[int]
    record: Mapped[bytes | None] = mapped_column(LargeBinary)
    designs: Mapped[bytes | None] = mapped_column(LargeBinary)


class WatchRow(Base):
    """The watch of a loop after the gains of a job were accepted. open: whether it goes on.  alarm: whether one
    is to be made of what it has found."""

    __tablename__ = "watches"
    __table_args__ = (Index("watches_by_loop", "loop", "open"), Index("watches_with_alarm", "alarm"))

    job_id: Mapped[str] = mapped_column(ForeignKey("jobs.id"), primary_key=True)
    loop: Mapped[str]
    open: Mapped[bool]
    alarm: Mapped[bool]
    watch: Mapped[AcceptanceWatch] = mapped_column(WatchColumn)


class AlarmAcknowledgementRow(Base):
    """An alarm that somebody has acknowledged, as it was shown then. job_id: the test it is about; null: about none."""

    __tablename__ = "alarm_acknowledgements"
    __table_args__ = (Index("alarm_acknowledgements_by_job", "job_id"),)

    alarm_id: Mapped[str] = mapped_column(primary_key=True)
    priority: Mapped[int]
    kind: Mapped[str]
    host: Mapped[str]
    loop: Mapped[str | None]
    job_id: Mapped[str | None] = mapped_column(ForeignKey("jobs.id"))
    text: Mapped[str]
    since: Mapped[str]
    by: Mapped[str]
    at: Mapped[str]


class WebhookDeliveryRow(Base):
    """What is to be delivered to a webhook, written in the transaction in which it happened.

    id: the same at each attempt.  hook: its name in loops.yaml.  body: JSON, as it is signed and sent.
    due_s: when the next attempt is made, seconds since 1970 UTC; when it ended once it did.
    error: why the last attempt failed.
    """

    __tablename__ = "webhook_deliveries"
    __table_args__ = (Index("webhook_deliveries_due", "host", "state", "due_s"),)

    number: Mapped[int] = mapped_column(primary_key=True, autoincrement=True)
    id: Mapped[str] = mapped_column(unique=True)
    host: Mapped[str]
    hook: Mapped[str]
    job_id: Mapped[str] = mapped_column(ForeignKey("jobs.id"))
    body: Mapped[str] = mapped_column(Text)
    at: Mapped[str]
    state: Mapped[str]
    attempts: Mapped[int]
    due_s: Mapped[float] = mapped_column(Double)
    error: Mapped[str | None]


class BatchRow(Base):
    """A batch. Its host begins their jobs, whatever hosts these are on."""

    __tablename__ = "batches"
    __table_args__ = (Index("batches_by_host", "host", "ended_at"),)

    number: Mapped[int] = mapped_column(primary_key=True, autoincrement=True)
    id: Mapped[str] = mapped_column(unique=True)
    host: Mapped[str]
    state: Mapped[str]
    request: Mapped[JsonObject]
    by: Mapped[str]
    created_at: Mapped[str]
    ended_at: Mapped[str | None]
    # Why no more jobs are begun, and that in words.
    stop_reason: Mapped[str | None]
    detail: Mapped[str | None]


class BatchLoopRow(Base):
    """A loop of such a retune with its latest job. detail: why it will have none, or no other; reason: from the closed
    list."""

    __tablename__ = "batch_loops"

    batch_id: Mapped[str] = mapped_column(ForeignKey("batches.id"), primary_key=True)
    position: Mapped[int] = mapped_column(primary_key=True)
    loop: Mapped[str]
    job_id: Mapped[str | None] = mapped_column(ForeignKey("jobs.id"))
    reason: Mapped[str | None]
    detail: Mapped[str | None]


class IdempotencyRow(Base):
    """A key under which a client may repeat a POST, and the answer that it then gets, see service.store.idempotency.

    principal: id of the API key, or `local`.  token: who answers it now, a new one at each attempt.
    effect: URL of what the request has made or changed, written in the transaction that did so.
    status: null while there is no answer.
    """

    __tablename__ = "idempotency_keys"
    __table_args__ = (
        Index("idempotency_keys_by_age", "at"),
        Index("idempotency_keys_by_principal", "principal", "at"),
    )

    principal: Mapped[str] = mapped_column(primary_key=True)
    key: Mapped[str] = mapped_column(primary_key=True)
    fingerprint: Mapped[str]
    at: Mapped[str]
    host: Mapped[str]
    token: Mapped[str]
    effect: Mapped[str | None]
    status: Mapped[int | None]
    headers: Mapped[dict[str, str] | None]
    body: Mapped[bytes | None] = mapped_column(LargeBinary)


class KeyRow(Base):
    """An API key. Never deleted: the audit log names it."""

    __tablename__ = "api_keys"

    id: Mapped[str] = mapped_column(primary_key=True)
    name: Mapped[str]
    scope: Mapped[str]
    hash: Mapped[str]
    created_at: Mapped[str]
    expires_at: Mapped[str | None]
    revoked_at: Mapped[str | None]


class AuditRow(Base):
    """One change. key: the name of the key, `local` or `cli:USER`; by: who asked, as the request says.  gateway: at
    which gateway it was asked, where several share the database."""

    __tablename__ = "audit"
    __table_args__ = (Index("audit_by_loop", "loop", "number"),)

    number: Mapped[int] = mapped_column(primary_key=True, autoincrement=True)
    at: Mapped[str]
    key: Mapped[str]
    key_id: Mapped[str | None]
    address: Mapped[str | None]
    gateway: Mapped[str | None]
    by: Mapped[str | None]
    what: Mapped[str]
    subject: Mapped[str]
    loop: Mapped[str | None]
    before: Mapped[JsonObject | None]
    after: Mapped[JsonObject | None]

"""The tables of 0.1.0. Whatever has a revision before this one was never released, and is refused."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0100"
down_revision = None
branch_labels = None
depends_on = None


def upgrade() -> None:
    op.create_table(
        "jobs",
        sa.Column("number", sa.Integer, primary_key=True, autoincrement=True),
        sa.Column("id", sa.String, nullable=False, unique=True),
        sa.Column("loop", sa.String, nullable=False),
        sa.Column("state", sa.String, nullable=False),
        sa.Column("dry_run", sa.Boolean, nullable=False),
        sa.Column("request", sa.JSON, nullable=False),
        sa.Column("by", sa.String, nullable=False),
        sa.Column("created_at", sa.String, nullable=False),
        sa.Column("started_at", sa.String),
        sa.Column("ended_at", sa.String),
        sa.Column("stage", sa.String),
        sa.Column("plant_time_s", sa.Double, nullable=False),
        sa.Column("stage_times_s", sa.JSON),
        sa.Column("reason", sa.String),
        sa.Column("detail", sa.String),
        sa.Column("previous_gains", sa.JSON),
        sa.Column("restored", sa.JSON),
        sa.Column("result", sa.JSON),
        sa.Column("host", sa.String, nullable=False, server_default="local"),
        sa.Column("version", sa.String, nullable=False, server_default="0"),
        sa.Column("attempt", sa.Integer, nullable=False, server_default="0"),
        sa.Column("found", sa.JSON),
        sa.Column("session", sa.BigInteger),
        sa.Column("restore_unconfirmed", sa.Boolean, nullable=False, server_default=sa.false()),
        sa.Column("false_pv", sa.Boolean, nullable=False, server_default=sa.false()),
        sa.Column("stop_reason", sa.String),
    )
    op.create_index("jobs_by_host", "jobs", ["host", "state"])
    op.create_index("jobs_by_loop", "jobs", ["loop", "number"])
    op.create_index("jobs_by_reason", "jobs", ["reason"])
    op.create_index("jobs_false_pv", "jobs", ["false_pv"])
    op.create_index("jobs_restore_unconfirmed", "jobs", ["restore_unconfirmed"])
    op.create_index(
        "one_active_job_per_loop",
        "jobs",
        ["loop"],
        unique=True,
        sqlite_where=sa.text("state IN ('queued', 'running') AND dry_run = 0"),
        postgresql_where=sa.text("state IN ('queued', 'running') AND NOT dry_run"),
    )
    op.create_table(
        "loops",
        sa.Column("tag", sa.String, primary_key=True),
        sa.Column("host", sa.String, nullable=False),
        sa.Column("config", sa.JSON, nullable=False),
    )
    op.create_table(
        "loop_locks",
        sa.Column("loop", sa.String, primary_key=True),
        sa.Column("reason", sa.String, nullable=False),
        sa.Column("by", sa.String, nullable=False),
        sa.Column("since", sa.String, nullable=False),
    )
    op.create_table(
        "hosts",
        sa.Column("host", sa.String, primary_key=True),
        sa.Column("claim", sa.String),
        sa.Column("claimed_by", sa.String),
        sa.Column("seen_at", sa.String),
        sa.Column("ages_from", sa.String),
        sa.Column("written_at", sa.String),
    )
    op.create_table(
        "gateways",
        sa.Column("name", sa.String, primary_key=True),
        sa.Column("at_s", sa.Double, nullable=False),
        sa.Column("url", sa.String),
        sa.Column("version", sa.String, nullable=False),
        sa.Column("present", sa.Text, nullable=False),
        sa.Column("settings", sa.Text, nullable=False),
    )
    op.create_table(
        "decision_requests",
        sa.Column("number", sa.Integer, primary_key=True, autoincrement=True),
        sa.Column("host", sa.String, nullable=False),
        sa.Column("asked_at", sa.String, nullable=False),
        sa.Column("asked_s", sa.Double, nullable=False),
        sa.Column("expires_s", sa.Double, nullable=False),
        sa.Column("what", sa.String, nullable=False),
        sa.Column("loop", sa.String, nullable=False),
        sa.Column("job_id", sa.String, sa.ForeignKey("jobs.id")),
        sa.Column("by", sa.String, nullable=False),
        sa.Column("who", sa.JSON, nullable=False),
        sa.Column("claim_principal", sa.String),
        sa.Column("claim_key", sa.String),
        sa.Column("claim_token", sa.String),
        sa.Column("state", sa.String, nullable=False),
        sa.Column("answer", sa.JSON),
        sa.Column("auto_rollback", sa.Boolean),
    )
    op.create_index("decision_requests_by_host", "decision_requests", ["host", "state"])
    op.create_index("decision_requests_by_job", "decision_requests", ["job_id", "number"])
    op.create_table(
        "events",
        sa.Column("job_id", sa.String, sa.ForeignKey("jobs.id"), primary_key=True),
        sa.Column("seq", sa.Integer, primary_key=True),
        sa.Column("at", sa.String, nullable=False),
        sa.Column("plant_time_s", sa.Double, nullable=False),
        sa.Column("kind", sa.String, nullable=False),
        sa.Column("data", sa.JSON, nullable=False),
    )
    op.create_table(
        "sample_chunks",
        sa.Column("job_id", sa.String, sa.ForeignKey("jobs.id"), primary_key=True),
        sa.Column("seq", sa.Integer, primary_key=True),
        sa.Column("stage", sa.String, nullable=False),
        sa.Column("first_t_s", sa.Double, nullable=False),
        sa.Column("count", sa.Integer, nullable=False),
        sa.Column("data", sa.LargeBinary, nullable=False),
    )
    op.create_table(
        "history_blocks",
        sa.Column("loop", sa.String, primary_key=True),
        sa.Column("first_s", sa.Double, primary_key=True),
        sa.Column("last_s", sa.Double, nullable=False),
        sa.Column("after_s", sa.Double),
        sa.Column("host", sa.String, nullable=False),
        sa.Column("count", sa.Integer, nullable=False),
        sa.Column("data", sa.LargeBinary, nullable=False),
    )
    op.create_index("history_blocks_by_age", "history_blocks", ["host", "last_s"])
    op.create_table(
        "loop_knowledge",
        sa.Column("number", sa.Integer, primary_key=True, autoincrement=True),
        sa.Column("loop", sa.String, nullable=False),
        sa.Column("at", sa.String, nullable=False),
        sa.Column("finding", sa.JSON, nullable=False),
        sa.Column("superseded", sa.String),
    )
    op.create_index("loop_knowledge_by_loop", "loop_knowledge", ["loop", "number"])
    op.create_table(
        "job_knowledge",
        sa.Column("job_id", sa.String, sa.ForeignKey("jobs.id"), primary_key=True),
        sa.Column("loop", sa.String, nullable=False),
        sa.Column("data", sa.LargeBinary),
        sa.Column("outdated_at", sa.String),
    )
    op.create_index("job_knowledge_by_loop", "job_knowledge", ["loop", "outdated_at"])
    op.create_table(
        "job_figures",
        sa.Column("job_id", sa.String, sa.ForeignKey("jobs.id"), primary_key=True),
        sa.Column("version", sa.Integer, nullable=False),
        sa.Column("record", sa.LargeBinary),
        sa.Column("designs", sa.LargeBinary),
    )
    op.create_table(
        "watches",
        sa.Column("job_id", sa.String, sa.ForeignKey("jobs.id"), primary_key=True),
        sa.Column("loop", sa.String, nullable=False),
        sa.Column("open", sa.Boolean, nullable=False),
        sa.Column("alarm", sa.Boolean, nullable=False),
        sa.Column("watch", sa.JSON, nullable=False),
    )
    op.create_index("watches_by_loop", "watches", ["loop", "open"])
    op.create_index("watches_with_alarm", "watches", ["alarm"])
    op.create_table(
        "alarm_acknowledgements",
        sa.Column("alarm_id", sa.String, primary_key=True),
        sa.Column("priority", sa.Integer, nullable=False),
        sa.Column("kind", sa.String, nullable=False),
        sa.Column("host", sa.String, nullable=False),
        sa.Column("loop", sa.String),
        sa.Column("job_id", sa.String, sa.ForeignKey("jobs.id")),
        sa.Column("text", sa.String, nullable=False),
        sa.Column("since", sa.String, nullable=False),
        sa.Column("by", sa.String, nullable=False),
        sa.Column("at", sa.String, nullable=False),
    )
    op.create_index("alarm_acknowledgements_by_job", "alarm_acknowledgements", ["job_id"])
    op.create_table(
        "webhook_deliveries",
        sa.Column("number", sa.Integer, primary_key=True, autoincrement=True),
        sa.Column("id", sa.String, nullable=False, unique=True),
        sa.Column("host", sa.String, nullable=False),
        sa.Column("hook", sa.String, nullable=False),
        sa.Column("job_id", sa.String, sa.ForeignKey("jobs.id"), nullable=False),
        sa.Column("body", sa.Text, nullable=False),
        sa.Column("at", sa.String, nullable=False),
        sa.Column("state", sa.String, nullable=False),
        sa.Column("attempts", sa.Integer, nullable=False),
        sa.Column("due_s", sa.Double, nullable=False),
        sa.Column("error", sa.String),
    )
    op.create_index("webhook_deliveries_due", "webhook_deliveries", ["host", "state", "due_s"])
    op.create_table(
        "batches",
        sa.Column("number", sa.Integer, primary_key=True, autoincrement=True),
        sa.Column("id", sa.String, nullable=False, unique=True),
        sa.Column("host", sa.String, nullable=False),
        sa.Column("state", sa.String, nullable=False),
        sa.Column("request", sa.JSON, nullable=False),
        sa.Column("by", sa.String, nullable=False),
        sa.Column("created_at", sa.String, nullable=False),
        sa.Column("ended_at", sa.String),
        sa.Column("stop_reason", sa.String),
        sa.Column("detail", sa.String),
    )
    op.create_index("batches_by_host", "batches", ["host", "ended_at"])
    op.create_table(
        "batch_loops",
        sa.Column("batch_id", sa.String, sa.ForeignKey("batches.id"), primary_key=True),
        sa.Column("position", sa.Integer, primary_key=True),
        sa.Column("loop", sa.String, nullable=False),
        sa.Column("job_id", sa.String, sa.ForeignKey("jobs.id")),
        sa.Column("reason", sa.String),
        sa.Column("detail", sa.String),
    )
    op.create_table(
        "idempotency_keys",
        sa.Column("principal", sa.String, primary_key=True),
        sa.Column("key", sa.String, primary_key=True),
        sa.Column("fingerprint", sa.String, nullable=False),
        sa.Column("at", sa.String, nullable=False),
        sa.Column("host", sa.String, nullable=False),
        sa.Column("token", sa.String, nullable=False),
        sa.Column("effect", sa.String),
        sa.Column("status", sa.Integer),
        sa.Column("headers", sa.JSON),
        sa.Column("body", sa.LargeBinary),
    )
    op.create_index("idempotency_keys_by_age", "idempotency_keys", ["at"])
    op.create_index("idempotency_keys_by_principal", "idempotency_keys", ["principal", "at"])
    op.create_table(
        "api_keys",
        sa.Column("id", sa.String, primary_key=True),
        sa.Column("name", sa.String, nullable=False),
        sa.Column("scope", sa.String, nullable=False),
        sa.Column("hash", sa.String, nullable=False),
        sa.Column("created_at", sa.String, nullable=False),
        sa.Column("expires_at", sa.String),
        sa.Column("revoked_at", sa.String),
    )
    op.create_table(
        "audit",
        sa.Column("number", sa.Integer, primary_key=True, autoincrement=True),
        sa.Column("at", sa.String, nullable=False),
        sa.Column("key", sa.String, nullable=False),
        sa.Column("key_id", sa.String),
        sa.Column("address", sa.String),
        sa.Column("gateway", sa.String),
        sa.Column("by", sa.String),
        sa.Column("what", sa.String, nullable=False),
        sa.Column("subject", sa.String, nullable=False),
        sa.Column("loop", sa.String),
        sa.Column("before", sa.JSON),
        sa.Column("after", sa.JSON),
    )
    op.create_index("audit_by_loop", "audit", ["loop", "number"])


def downgrade() -> None:
    op.drop_table("audit")
    op.drop_table("api_keys")
    op.drop_table("idempotency_keys")
    op.drop_table("batch_loops")
    op.drop_table("batches")
    op.drop_table("webhook_deliveries")
    op.drop_table("alarm_acknowledgements")
    op.drop_table("watches")
    op.drop_table("job_figures")
    op.drop_table("job_knowledge")
    op.drop_table("loop_knowledge")
    op.drop_table("history_blocks")
    op.drop_table("sample_chunks")
    op.drop_table("events")
    op.drop_table("decision_requests")
    op.drop_table("gateways")
    op.drop_table("hosts")
    op.drop_table("loop_locks")
    op.drop_table("loops")
    op.drop_table("jobs")

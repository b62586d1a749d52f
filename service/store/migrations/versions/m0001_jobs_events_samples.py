"""Jobs, events and sample blocks."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0001"
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
        sa.Column("requested_by", sa.String, nullable=False),
        sa.Column("created_at", sa.String, nullable=False),
        sa.Column("started_at", sa.String),
        sa.Column("ended_at", sa.String),
        sa.Column("stage", sa.String),
        sa.Column("plant_time_s", sa.Double, nullable=False),
        sa.Column("stage_times_s", sa.JSON),
        sa.Column("reason", sa.String),
        sa.Column("detail", sa.String),
        sa.Column("old_gains", sa.JSON),
        sa.Column("restored", sa.JSON),
        sa.Column("result", sa.JSON),
    )
    op.create_index(
        "one_active_job_per_loop",
        "jobs",
        ["loop"],
        unique=True,
        sqlite_where=sa.text("state IN ('queued', 'running') AND dry_run = 0"),
        postgresql_where=sa.text("state IN ('queued', 'running') AND NOT dry_run"),
    )
    op.create_index("jobs_by_loop", "jobs", ["loop", "number"])
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


def downgrade() -> None:
    op.drop_table("sample_chunks")
    op.drop_table("events")
    op.drop_table("jobs")

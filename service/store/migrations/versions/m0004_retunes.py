"""Retunes of many loops: what was asked, and each of their loops with its job."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0004"
down_revision = "0003"
branch_labels = None
depends_on = None


def upgrade() -> None:
    op.create_table(
        "retunes",
        sa.Column("number", sa.Integer, primary_key=True, autoincrement=True),
        sa.Column("id", sa.String, nullable=False, unique=True),
        sa.Column("host", sa.String, nullable=False),
        sa.Column("state", sa.String, nullable=False),
        sa.Column("request", sa.JSON, nullable=False),
        sa.Column("requested_by", sa.String, nullable=False),
        sa.Column("created_at", sa.String, nullable=False),
        sa.Column("ended_at", sa.String),
        sa.Column("stop_reason", sa.String),
        sa.Column("detail", sa.String),
    )
    op.create_index("retunes_by_host", "retunes", ["host", "ended_at"])
    op.create_table(
        "retune_loops",
        sa.Column("retune_id", sa.String, sa.ForeignKey("retunes.id"), primary_key=True),
        sa.Column("position", sa.Integer, primary_key=True),
        sa.Column("loop", sa.String, nullable=False),
        sa.Column("job_id", sa.String, sa.ForeignKey("jobs.id")),
        sa.Column("detail", sa.String),
    )


def downgrade() -> None:
    op.drop_table("retune_loops")
    op.drop_index("retunes_by_host", "retunes")
    op.drop_table("retunes")

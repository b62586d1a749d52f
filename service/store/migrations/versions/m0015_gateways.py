"""What each gateway writes of itself, decisions asked at another gateway, and where a change was asked for."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0015"
down_revision = "0014"
branch_labels = None
depends_on = None


def upgrade() -> None:
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
    )
    op.create_index("decision_requests_by_host", "decision_requests", ["host", "state"])
    op.create_index("decision_requests_by_job", "decision_requests", ["job_id", "number"])
    op.add_column("audit", sa.Column("gateway", sa.String))


def downgrade() -> None:
    op.drop_column("audit", "gateway")
    op.drop_table("decision_requests")
    op.drop_table("gateways")

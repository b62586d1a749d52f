"""Jobs that outlive their service: their host, their attempts, the wish to stop them; the loops of every host."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0002"
down_revision = "0001"
branch_labels = None
depends_on = None


def upgrade() -> None:
    op.add_column("jobs", sa.Column("host", sa.String, nullable=False, server_default="local"))
    op.add_column("jobs", sa.Column("version", sa.String, nullable=False, server_default="0"))
    op.add_column("jobs", sa.Column("attempt", sa.Integer, nullable=False, server_default="0"))
    op.add_column("jobs", sa.Column("found", sa.JSON))
    op.add_column("jobs", sa.Column("stop_reason", sa.String))
    op.create_index("jobs_by_host", "jobs", ["host", "state"])
    op.create_table(
        "loops",
        sa.Column("tag", sa.String, primary_key=True),
        sa.Column("host", sa.String, nullable=False),
        sa.Column("config", sa.JSON, nullable=False),
    )


def downgrade() -> None:
    op.drop_table("loops")
    op.drop_index("jobs_by_host", "jobs")
    for column in ("stop_reason", "found", "attempt", "version", "host"):
        op.drop_column("jobs", column)

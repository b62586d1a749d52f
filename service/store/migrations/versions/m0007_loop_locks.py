"""Loops that somebody has locked, and why a loop of a retune of many was skipped."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0007"
down_revision = "0006"
branch_labels = None
depends_on = None


def upgrade() -> None:
    op.create_table(
        "loop_locks",
        sa.Column("loop", sa.String, primary_key=True),
        sa.Column("reason", sa.String, nullable=False),
        sa.Column("by", sa.String, nullable=False),
        sa.Column("since", sa.String, nullable=False),
    )
    op.add_column("retune_loops", sa.Column("reason", sa.String))


def downgrade() -> None:
    op.drop_column("retune_loops", "reason")
    op.drop_table("loop_locks")

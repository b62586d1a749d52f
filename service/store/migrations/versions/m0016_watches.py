"""The watches of loops after gains were accepted, and what a gateway is asked to accept with."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0016"
down_revision = "0015"
branch_labels = None
depends_on = None


def upgrade() -> None:
    op.create_table(
        "watches",
        sa.Column("job_id", sa.String, sa.ForeignKey("jobs.id"), primary_key=True),
        sa.Column("loop", sa.String, nullable=False),
        sa.Column("open", sa.Boolean, nullable=False),
        sa.Column("abnormal", sa.Boolean, nullable=False),
        sa.Column("watch", sa.JSON, nullable=False),
    )
    op.create_index("watches_by_loop", "watches", ["loop", "open"])
    op.create_index("abnormal_watches", "watches", ["abnormal"])
    op.add_column("decision_requests", sa.Column("roll_back_by_itself", sa.Boolean))


def downgrade() -> None:
    op.drop_column("decision_requests", "roll_back_by_itself")
    op.drop_index("abnormal_watches", "watches")
    op.drop_index("watches_by_loop", "watches")
    op.drop_table("watches")

"""What was known of a loop from operation as a job began."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0012"
down_revision = "0011"
branch_labels = None
depends_on = None


def upgrade() -> None:
    op.create_table(
        "job_knowledge",
        sa.Column("job_id", sa.String, sa.ForeignKey("jobs.id"), primary_key=True),
        sa.Column("loop", sa.String, nullable=False),
        sa.Column("data", sa.LargeBinary),
        sa.Column("outdated_at", sa.String),
    )
    op.create_index("job_knowledge_by_loop", "job_knowledge", ["loop", "outdated_at"])


def downgrade() -> None:
    op.drop_index("job_knowledge_by_loop", "job_knowledge")
    op.drop_table("job_knowledge")

"""What was computed of a job after its end: its record with the model, and the designs from robust to fast."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0013"
down_revision = "0012"
branch_labels = None
depends_on = None


def upgrade() -> None:
    op.create_table(
        "job_figures",
        sa.Column("job_id", sa.String, sa.ForeignKey("jobs.id"), primary_key=True),
        sa.Column("version", sa.Integer, nullable=False),
        sa.Column("record", sa.LargeBinary),
        sa.Column("designs", sa.LargeBinary),
    )


def downgrade() -> None:
    op.drop_table("job_figures")

"""Alarms that were signed off. A test that was followed by another one of the loop counts as signed off: nobody could
do it before, and the later test has read the loop."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0014"
down_revision = "0013"
branch_labels = None
depends_on = None

_FOLLOWED = """
    INSERT INTO alarm_sign_offs (alarm_id, level, kind, host, loop, job_id, text, since, "by", at)
    SELECT 'before-0014-' || jobs.id, 1, 'not_restored', jobs.host, jobs.loop, jobs.id,
           'a later test has read the loop', jobs.created_at, 'service', jobs.created_at
    FROM jobs
    WHERE jobs.reason = 'restore_unconfirmed'
      AND EXISTS (
        SELECT 1 FROM jobs AS later
        WHERE later.loop = jobs.loop AND later.number > jobs.number AND NOT later.dry_run AND later.session IS NOT NULL
      )
"""


def upgrade() -> None:
    op.create_table(
        "alarm_sign_offs",
        sa.Column("alarm_id", sa.String, primary_key=True),
        sa.Column("level", sa.Integer, nullable=False),
        sa.Column("kind", sa.String, nullable=False),
        sa.Column("host", sa.String, nullable=False),
        sa.Column("loop", sa.String),
        sa.Column("job_id", sa.String, sa.ForeignKey("jobs.id")),
        sa.Column("text", sa.String, nullable=False),
        sa.Column("since", sa.String, nullable=False),
        sa.Column("by", sa.String, nullable=False),
        sa.Column("at", sa.String, nullable=False),
    )
    op.create_index("alarm_sign_offs_by_job", "alarm_sign_offs", ["job_id"])
    op.create_index("jobs_by_reason", "jobs", ["reason"])
    op.create_index("jobs_looked_after", "jobs", ["look_after"])
    op.execute(_FOLLOWED)


def downgrade() -> None:
    op.drop_index("jobs_looked_after", "jobs")
    op.drop_index("jobs_by_reason", "jobs")
    op.drop_index("alarm_sign_offs_by_job", "alarm_sign_offs")
    op.drop_table("alarm_sign_offs")

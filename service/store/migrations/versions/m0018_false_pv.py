"""Which tests have found PV to be false."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0018"
down_revision = "0017"
branch_labels = None
depends_on = None


def upgrade() -> None:
    op.add_column("jobs", sa.Column("false_pv", sa.Boolean, nullable=False, server_default=sa.false()))
    op.create_index("jobs_false_pv", "jobs", ["false_pv"])


def downgrade() -> None:
    op.drop_index("jobs_false_pv", "jobs")
    op.drop_column("jobs", "false_pv")

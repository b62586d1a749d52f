"""The session of a job, and the loops that are looked after."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0005"
down_revision = "0004"
branch_labels = None
depends_on = None


def upgrade() -> None:
    op.add_column("jobs", sa.Column("session", sa.BigInteger))
    op.add_column("jobs", sa.Column("look_after", sa.Boolean, nullable=False, server_default=sa.false()))


def downgrade() -> None:
    op.drop_column("jobs", "look_after")
    op.drop_column("jobs", "session")

"""What a host keeps of itself: who has its name, and what its clock was seen to say."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0008"
down_revision = "0007"
branch_labels = None
depends_on = None


def upgrade() -> None:
    op.create_table(
        "hosts",
        sa.Column("host", sa.String, primary_key=True),
        sa.Column("claim", sa.String),
        sa.Column("claimed_by", sa.String),
        sa.Column("seen_at", sa.String),
        sa.Column("ages_from", sa.String),
        sa.Column("written_at", sa.String),
    )


def downgrade() -> None:
    op.drop_table("hosts")

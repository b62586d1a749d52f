"""The history of the loops: blocks of what was heard on the buses."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0010"
down_revision = "0009"
branch_labels = None
depends_on = None


def upgrade() -> None:
    op.create_table(
        "history_blocks",
        sa.Column("loop", sa.String, primary_key=True),
        sa.Column("first_s", sa.Double, primary_key=True),
        sa.Column("last_s", sa.Double, nullable=False),
        sa.Column("after_s", sa.Double),
        sa.Column("host", sa.String, nullable=False),
        sa.Column("count", sa.Integer, nullable=False),
        sa.Column("data", sa.LargeBinary, nullable=False),
    )
    op.create_index("history_blocks_by_age", "history_blocks", ["host", "last_s"])


def downgrade() -> None:
    op.drop_index("history_blocks_by_age", "history_blocks")
    op.drop_table("history_blocks")

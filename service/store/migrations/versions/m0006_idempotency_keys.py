"""The keys under which clients repeat a POST, with the answers that are given again."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0006"
down_revision = "0005"
branch_labels = None
depends_on = None


def upgrade() -> None:
    op.create_table(
        "idempotency_keys",
        sa.Column("principal", sa.String, primary_key=True),
        sa.Column("key", sa.String, primary_key=True),
        sa.Column("fingerprint", sa.String, nullable=False),
        sa.Column("at", sa.String, nullable=False),
        sa.Column("host", sa.String, nullable=False),
        sa.Column("token", sa.String, nullable=False),
        sa.Column("effect", sa.String),
        sa.Column("status", sa.Integer),
        sa.Column("headers", sa.JSON),
        sa.Column("body", sa.LargeBinary),
    )
    op.create_index("idempotency_keys_by_age", "idempotency_keys", ["at"])
    op.create_index("idempotency_keys_by_principal", "idempotency_keys", ["principal", "at"])


def downgrade() -> None:
    op.drop_table("idempotency_keys")

"""What is known of the loops: models with the Ms that they give the gains, from tests and from normal operation."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0011"
down_revision = "0010"
branch_labels = None
depends_on = None


def upgrade() -> None:
    op.create_table(
        "loop_knowledge",
        sa.Column("number", sa.Integer, primary_key=True, autoincrement=True),
        sa.Column("loop", sa.String, nullable=False),
        sa.Column("at", sa.String, nullable=False),
        sa.Column("finding", sa.JSON, nullable=False),
        sa.Column("older_plant", sa.String),
    )
    op.create_index("loop_knowledge_by_loop", "loop_knowledge", ["loop", "number"])


def downgrade() -> None:
    op.drop_index("loop_knowledge_by_loop", "loop_knowledge")
    op.drop_table("loop_knowledge")

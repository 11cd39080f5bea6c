"""Records of queries that robots answered themselves, each once."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0019"
down_revision = "0018"
branch_labels = None
depends_on = None


def upgrade() -> None:
    """Add the column, and the index that finds such a record by its id."""
    op.add_column(
        "query_records",
        sa.Column("offline", sa.Boolean(), nullable=False, server_default=sa.false()),
    )
    op.create_index(
        "ix_query_records_offline",
        "query_records",
        ["map_number", "id"],
        unique=True,
        sqlite_where=sa.text("offline = 1"),
        postgresql_where=sa.text("offline"),
    )

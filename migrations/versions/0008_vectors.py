"""No codes of signatures any more: PostgreSQL searches the signatures themselves, as vectors."""

from __future__ import annotations

import re

import sqlalchemy as sa
from alembic import op

revision = "0008"
down_revision = "0007"
branch_labels = None
depends_on = None


def upgrade() -> None:
    """Drop the tables of codes that workers made in PostgreSQL; SQLite has none."""
    connection = op.get_bind()
    if connection.dialect.name == "postgresql":
        there = sa.inspect(connection).get_table_names()
        codes = [name for name in there if re.fullmatch(r"code_fits|code_maps|codes_\d+", name)]
        if codes:
            op.execute(f"DROP TABLE {', '.join(sorted(codes))}")

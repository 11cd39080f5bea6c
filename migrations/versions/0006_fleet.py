"""Quotas and retention of maps; on PostgreSQL numbers of 64 bits, and texts in SQLite's order."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0006"
down_revision = "0005"
branch_labels = None
depends_on = None


def upgrade() -> None:
    """Add the columns; of a server, widen and sort what is there."""
    op.add_column("maps", sa.Column("quota_frames", sa.BigInteger(), nullable=True))
    op.add_column("maps", sa.Column("quota_bytes", sa.BigInteger(), nullable=True))
    op.add_column("maps", sa.Column("retention_days", sa.Float(), nullable=True))
    if op.get_bind().dialect.name == "postgresql":
        _widen(op.get_bind())


def _widen(connection: sa.Connection) -> None:
    """Numbers and texts of all tables, each table written anew once."""
    there = sa.inspect(connection)
    for table in sorted(set(there.get_table_names()) - {"alembic_version"}):
        changes = []
        for column in there.get_columns(table):
            kind, name = column["type"], column["name"]
            if isinstance(kind, sa.String):
                changes.append(f'ALTER "{name}" TYPE {_text(kind)} COLLATE "C"')
            elif isinstance(kind, sa.Integer) and not isinstance(kind, sa.BigInteger):
                changes.append(f'ALTER "{name}" TYPE bigint')
        if changes:
            op.execute(f'ALTER TABLE "{table}" {", ".join(changes)}')
    for sequence in there.get_sequence_names():
        op.execute(f'ALTER SEQUENCE "{sequence}" AS bigint')


def _text(kind: sa.String) -> str:
    return "text" if kind.length is None else f"varchar({kind.length})"

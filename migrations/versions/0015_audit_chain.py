"""Audit lines chained by hash, the range of revisions that may write, what a scrub has read, and
which events end a map.
"""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0015"
down_revision = "0014"
branch_labels = None
depends_on = None

#: The oldest revision whose processes may write to a store of this one. A migration that only adds
#: (tables, columns that may be null) leaves it; one that changes or removes writes its own number.
LEAST_REVISION = "0015"


def _string(length: int) -> sa.types.TypeEngine[str]:
    return sa.String(length).with_variant(sa.String(length, collation="C"), "postgresql")


_WHOLE = sa.BigInteger().with_variant(sa.Integer, "sqlite")


def upgrade() -> None:
    """Create the tables and columns; lines of before have no hash."""
    op.add_column("audit", sa.Column("tenant", _string(128), nullable=True))
    op.add_column("audit", sa.Column("refused", sa.Boolean(), nullable=True))
    op.add_column("audit", sa.Column("sequence", _WHOLE, nullable=True))
    op.add_column("audit", sa.Column("hash", _string(64), nullable=True))
    op.create_index(
        "uq_audit_tenant_refused_sequence", "audit", ["tenant", "refused", "sequence"], unique=True
    )
    op.create_index("ix_audit_at", "audit", ["at"])
    op.create_table(
        "audit_chains",
        sa.Column("tenant", _string(128), nullable=False),
        sa.Column("refused", sa.Boolean(), nullable=False),
        sa.Column("pruned", _WHOLE, nullable=False),
        sa.Column("anchor", _string(64), nullable=False),
        sa.Column("last", _WHOLE, nullable=False),
        sa.Column("head", _string(64), nullable=False),
        sa.PrimaryKeyConstraint("tenant", "refused", name="pk_audit_chains"),
    )
    op.create_table(
        "schema_range",
        sa.Column("least_revision", _string(32), nullable=False),
        sa.PrimaryKeyConstraint("least_revision", name="pk_schema_range"),
    )
    op.execute(f"INSERT INTO schema_range (least_revision) VALUES ('{LEAST_REVISION}')")
    op.create_table(
        "scrubs",
        sa.Column("number", _WHOLE, nullable=False),
        sa.Column("position", _WHOLE, nullable=False),
        sa.Column("next_at", sa.Float(), nullable=False),
        sa.Column("began_at", sa.Float(), nullable=False),
        sa.Column("finished_at", sa.Float(), nullable=True),
        sa.Column("blobs", sa.BigInteger(), nullable=False),
        sa.Column("bytes", sa.BigInteger(), nullable=False),
        sa.Column("damaged", sa.BigInteger(), nullable=False),
        sa.PrimaryKeyConstraint("number", name="pk_scrubs"),
    )
    deleted = sa.text("kind = 'map.deleted'")
    op.create_index(
        "ix_events_map_number_deleted", "events", ["map", "number"], sqlite_where=deleted,
        postgresql_where=deleted,
    )  # fmt: skip

"""Signatures that robots sent with their frames, and how far the senders are trusted."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0020"
down_revision = "0019"
branch_labels = None
depends_on = None

_WHOLE = sa.BigInteger().with_variant(sa.Integer, "sqlite")
_SENT = sa.text("sender IS NOT NULL")


def _string(length: int) -> sa.types.TypeEngine[str]:
    return sa.String(length).with_variant(sa.String(length, collation="C"), "postgresql")


def upgrade() -> None:
    """Add column and table; all signatures that there are were made by workers."""
    op.add_column("signatures", sa.Column("sender", _string(32), nullable=True))
    op.create_index(
        "ix_signatures_sender",
        "signatures",
        ["sender", "frame_number"],
        sqlite_where=_SENT,
        postgresql_where=_SENT,
    )
    op.create_table(
        "signature_senders",
        sa.Column("key_id", _string(32), nullable=False),
        sa.Column("verified", _WHOLE, nullable=False),
        sa.Column("distrusted_at", sa.Float(), nullable=True),
        sa.Column("map", _string(63), nullable=True),
        sa.Column("frame_id", _string(64), nullable=True),
        sa.PrimaryKeyConstraint("key_id", name="pk_signature_senders"),
    )

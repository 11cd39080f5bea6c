"""Keys whose secret is replaced while the one before still works, and when each was last used."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0016"
down_revision = "0015"
branch_labels = None
depends_on = None


def _string(length: int) -> sa.types.TypeEngine[str]:
    return sa.String(length).with_variant(sa.String(length, collation="C"), "postgresql")


def upgrade() -> None:
    """Add the columns; no key has been rotated yet."""
    op.add_column("keys", sa.Column("previous_digest", _string(64), nullable=True))
    op.add_column("keys", sa.Column("previous_until", sa.Float(), nullable=True))
    op.add_column("keys", sa.Column("last_used_at", sa.Float(), nullable=True))
    op.create_index("ix_keys_previous_digest", "keys", ["previous_digest"])

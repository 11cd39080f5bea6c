"""When frames ended, so that rows of deleted and redundant ones can go some days later."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0018"
down_revision = "0017"
branch_labels = None
depends_on = None

_WHOLE = sa.BigInteger().with_variant(sa.Integer, "sqlite")
_ENDED = sa.text("state IN ('deleted', 'redundant')")


def upgrade() -> None:
    """Add the columns. Rows of frames that ended before have no time: workers give them one."""
    op.add_column("frames", sa.Column("ended_at", sa.Float(), nullable=True))
    op.add_column("maps", sa.Column("pruned_revision", _WHOLE, nullable=False, server_default="0"))
    op.create_index(
        "ix_frames_ended",
        "frames",
        ["map_number", "state", "ended_at"],
        sqlite_where=_ENDED,
        postgresql_where=_ENDED,
    )

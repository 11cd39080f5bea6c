"""Original file names of frames and their places within sessions, with indexes to search by."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0010"
down_revision = "0009"
branch_labels = None
depends_on = None

SEARCHED = [
    "map_number", "state", "session", "robot", "captured_at", "sequence", "pose_parent", "pose_x",
    "pose_y", "pose_z",
]  # fmt: skip


def upgrade() -> None:
    """Add the columns, empty in the frames that are there, and the indexes that have them."""
    text = sa.String(255).with_variant(sa.String(255, collation="C"), "postgresql")
    whole = sa.BigInteger().with_variant(sa.Integer, "sqlite")
    op.add_column("frames", sa.Column("name", text, nullable=True))
    op.add_column("frames", sa.Column("sequence", whole, nullable=True))
    op.drop_index("ix_frames_searched", "frames")
    op.create_index("ix_frames_searched", "frames", SEARCHED)
    op.create_index(
        "ix_frames_named", "frames", ["map_number", "name", "state", "session", "robot"]
    )

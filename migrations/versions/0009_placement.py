"""Which way is up in a sensor and in a map, and an index of frames by where they were taken."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0009"
down_revision = "0008"
branch_labels = None
depends_on = None


def upgrade() -> None:
    """Add the columns, in which what is there knows no up, and the index."""
    for table in ("frames", "maps"):
        op.add_column(table, sa.Column("up", sa.JSON(none_as_null=True), nullable=True))
    op.create_index(
        "ix_frames_placed", "frames", ["map_number", "pose_parent", "pose_x", "pose_y", "pose_z"]
    )

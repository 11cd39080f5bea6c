"""Which way is up: in the sensor of a frame, and in the parent frames of a map's poses."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0009"
down_revision = "0008"
branch_labels = None
depends_on = None


def upgrade() -> None:
    """Add the columns; what is there knows no up."""
    for table in ("frames", "maps"):
        op.add_column(table, sa.Column("up", sa.JSON(none_as_null=True), nullable=True))

"""Frames that are point clouds: what is known of the points. Those of before are depth images."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0004"
down_revision = "0003"
branch_labels = None
depends_on = None


def upgrade() -> None:
    """Add the column; what is there has none."""
    op.add_column("frames", sa.Column("cloud", sa.JSON(none_as_null=True), nullable=True))

"""A small record of every query."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0011"
down_revision = "0010"
branch_labels = None
depends_on = None


def _string(length: int) -> sa.types.TypeEngine[str]:
    return sa.String(length).with_variant(sa.String(length, collation="C"), "postgresql")


_WHOLE = sa.BigInteger().with_variant(sa.Integer, "sqlite")
_TEXT = sa.Text().with_variant(sa.Text(collation="C"), "postgresql")


def upgrade() -> None:
    """Create the table."""
    op.create_table(
        "query_records",
        sa.Column("number", _WHOLE, nullable=False),
        sa.Column("id", _string(32), nullable=False),
        sa.Column("at", sa.Float(), nullable=False),
        sa.Column("map_number", _WHOLE, nullable=False),
        sa.Column("maps", sa.JSON(none_as_null=True), nullable=True),
        sa.Column("robot", _string(128), nullable=True),
        sa.Column("session", _string(128), nullable=True),
        sa.Column("key_id", _string(32), nullable=True),
        sa.Column("status", _string(16), nullable=False),
        sa.Column("cause", _string(64), nullable=True),
        sa.Column("reason", _TEXT, nullable=False),
        sa.Column("pose_parent", _string(128), nullable=True),
        sa.Column("pose", sa.JSON(none_as_null=True), nullable=True),
        sa.Column("support", _WHOLE, nullable=True),
        sa.Column("rival_ratio", sa.Float(), nullable=True),
        sa.Column("alternatives", _WHOLE, nullable=False),
        sa.Column("milliseconds", sa.Float(), nullable=False),
        sa.Column("kind", _string(8), nullable=True),
        sa.Column("frame_map", _string(63), nullable=True),
        sa.Column("frame_id", _string(64), nullable=True),
        sa.Column("kept", sa.Boolean(), nullable=False),
        sa.ForeignKeyConstraint(
            ["map_number"], ["maps.number"], name="fk_query_records_map_number"
        ),
        sa.PrimaryKeyConstraint("number", name="pk_query_records"),
        sqlite_autoincrement=True,
    )
    for name, columns in {
        "ix_query_records_at_number": ["at", "number"],
        "ix_query_records_map_number_at_number": ["map_number", "at", "number"],
        "ix_query_records_map_number_status_at_number": ["map_number", "status", "at", "number"],
        "ix_query_records_robot_at_number": ["robot", "at", "number"],
        "ix_query_records_key_id": ["key_id"],
    }.items():
        op.create_index(name, "query_records", columns)

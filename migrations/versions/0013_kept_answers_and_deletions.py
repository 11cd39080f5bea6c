"""Answers that are kept until they are released, and deletions that can be undone."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0013"
down_revision = "0012"
branch_labels = None
depends_on = None


def _string(length: int) -> sa.types.TypeEngine[str]:
    return sa.String(length).with_variant(sa.String(length, collation="C"), "postgresql")


_WHOLE = sa.BigInteger().with_variant(sa.Integer, "sqlite")


def upgrade() -> None:
    """Create the tables."""
    op.create_table(
        "kept_answers",
        sa.Column("number", _WHOLE, nullable=False),
        sa.Column("id", _string(32), nullable=False),
        sa.Column("blob", _string(64), nullable=False),
        sa.Column("bytes", sa.BigInteger(), nullable=False),
        sa.Column("title", _string(200), nullable=True),
        sa.Column("kept_at", sa.Float(), nullable=False),
        sa.Column("until", sa.Float(), nullable=True),
        sa.Column("at", sa.Float(), nullable=False),
        sa.Column("status", _string(16), nullable=False),
        sa.Column("robot", _string(128), nullable=True),
        sa.Column("record", sa.JSON(), nullable=False),
        sa.PrimaryKeyConstraint("number", name="pk_kept_answers"),
        sa.UniqueConstraint("id", name="uq_kept_answers_id"),
        sqlite_autoincrement=True,
    )
    _link("kept_answer_maps", "map_number", "maps")
    _link("kept_answer_frames", "frame_number", "frames")
    op.create_table(
        "deletions",
        sa.Column("number", _WHOLE, nullable=False),
        sa.Column("id", _string(32), nullable=False),
        sa.Column("map_number", _WHOLE, nullable=False),
        sa.Column("at", sa.Float(), nullable=False),
        sa.Column("until", sa.Float(), nullable=False),
        sa.ForeignKeyConstraint(["map_number"], ["maps.number"], name="fk_deletions_map_number"),
        sa.PrimaryKeyConstraint("number", name="pk_deletions"),
        sa.UniqueConstraint("id", name="uq_deletions_id"),
        sqlite_autoincrement=True,
    )
    op.create_table(
        "deleted_frames",
        sa.Column("frame_number", _WHOLE, nullable=False),
        sa.Column("deletion_number", _WHOLE, nullable=False),
        sa.Column("blob", _string(64), nullable=True),
        sa.Column("bytes", sa.BigInteger(), nullable=False),
        sa.Column("data", sa.JSON(), nullable=False),
        sa.ForeignKeyConstraint(
            ["frame_number"], ["frames.number"], name="fk_deleted_frames_frame_number"
        ),
        sa.ForeignKeyConstraint(
            ["deletion_number"], ["deletions.number"], name="fk_deleted_frames_deletion_number"
        ),
        sa.PrimaryKeyConstraint("frame_number", name="pk_deleted_frames"),
    )
    for name, table, columns in (
        ("ix_kept_answers_blob", "kept_answers", ["blob"]),
        ("ix_kept_answers_at_number", "kept_answers", ["at", "number"]),
        ("ix_kept_answer_maps_map_number_kept_number", "kept_answer_maps",
         ["map_number", "kept_number"]),
        ("ix_kept_answer_frames_frame_number", "kept_answer_frames", ["frame_number"]),
        ("ix_deletions_map_number_number", "deletions", ["map_number", "number"]),
        ("ix_deletions_until", "deletions", ["until"]),
        ("ix_deleted_frames_deletion_number_frame_number", "deleted_frames",
         ["deletion_number", "frame_number"]),
        ("ix_deleted_frames_blob", "deleted_frames", ["blob"]),
    ):  # fmt: skip
        op.create_index(name, table, columns)


def _link(name: str, column: str, table: str) -> None:
    """Create a table of what kept answers belong to."""
    op.create_table(
        name,
        sa.Column("kept_number", _WHOLE, nullable=False),
        sa.Column(column, _WHOLE, nullable=False),
        sa.ForeignKeyConstraint(
            ["kept_number"], ["kept_answers.number"], name=f"fk_{name}_kept_number"
        ),
        sa.ForeignKeyConstraint([column], [f"{table}.number"], name=f"fk_{name}_{column}"),
        sa.PrimaryKeyConstraint("kept_number", column, name=f"pk_{name}"),
    )

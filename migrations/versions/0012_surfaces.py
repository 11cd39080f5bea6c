"""Fused surfaces of maps: tiles, the frames in them, and which frame touches which tile."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0012"
down_revision = "0011"
branch_labels = None
depends_on = None


def _string(length: int) -> sa.types.TypeEngine[str]:
    return sa.String(length).with_variant(sa.String(length, collation="C"), "postgresql")


_WHOLE = sa.BigInteger().with_variant(sa.Integer, "sqlite")


def _number(name: str, refers_to: str, table: str) -> list[sa.schema.SchemaItem]:
    """A column of numbers that refers to another table."""
    return [
        sa.Column(name, _WHOLE, nullable=False),
        sa.ForeignKeyConstraint([name], [f"{refers_to}.number"], name=f"fk_{table}_{name}"),
    ]


def upgrade() -> None:
    """Create the tables."""
    op.create_table(
        "surfaces",
        *_number("map_number", "maps", "surfaces"),
        sa.Column("model_id", _string(64), nullable=False),
        sa.Column("cell_m", sa.Float(), nullable=False),
        sa.Column("wanted", sa.Boolean(), nullable=False),
        sa.Column("job_number", _WHOLE, nullable=True),
        sa.Column("revision", _WHOLE, nullable=False),
        sa.Column("edits", _WHOLE, nullable=False),
        sa.Column("pose_edits", _WHOLE, nullable=False),
        sa.Column("scale", _WHOLE, nullable=False),
        sa.Column("taken_from", sa.Float(), nullable=True),
        sa.Column("taken_step_s", sa.Float(), nullable=False),
        sa.Column("first_taken", sa.Float(), nullable=True),
        sa.Column("last_taken", sa.Float(), nullable=True),
        sa.Column("sessions", sa.JSON(), nullable=False),
        sa.Column("parents", sa.JSON(), nullable=False),
        sa.Column("updated_at", sa.Float(), nullable=True),
        sa.PrimaryKeyConstraint("map_number", name="pk_surfaces"),
    )
    _create_tiles()
    op.create_table(
        "surface_frames",
        *_number("frame_number", "frames", "surface_frames"),
        *_number("map_number", "maps", "surface_frames"),
        sa.Column("parent", _string(128), nullable=False),
        sa.Column("changed", sa.Boolean(), nullable=False),
        sa.PrimaryKeyConstraint("frame_number", name="pk_surface_frames"),
    )
    op.create_index(
        "ix_surface_frames_map_number_parent_changed", "surface_frames",
        ["map_number", "parent", "changed"],
    )  # fmt: skip
    op.create_table(
        "surface_touches",
        *_number("tile_number", "surface_tiles", "surface_touches"),
        *_number("frame_number", "frames", "surface_touches"),
        sa.PrimaryKeyConstraint("tile_number", "frame_number", name="pk_surface_touches"),
    )
    op.create_index("ix_surface_touches_frame_number", "surface_touches", ["frame_number"])


def _create_tiles() -> None:
    place = ["map_number", "parent", "level", "tile_x", "tile_y", "tile_z"]
    op.create_table(
        "surface_tiles",
        sa.Column("number", _WHOLE, nullable=False),
        *_number("map_number", "maps", "surface_tiles"),
        sa.Column("parent", _string(128), nullable=False),
        *(sa.Column(name, _WHOLE, nullable=False) for name in (*place[2:], "cells")),
        sa.Column("blob", _string(64), nullable=True),
        sa.Column("digest", _string(64), nullable=False),
        sa.Column("scale", _WHOLE, nullable=False),
        sa.Column("rebuilt_to", _WHOLE, nullable=True),
        sa.Column("draft", _string(64), nullable=True),
        *(
            sa.Column(f"{end}_{axis}", sa.Float(), nullable=False)
            for end in ("low", "high")
            for axis in "xyz"
        ),
        sa.PrimaryKeyConstraint("number", name="pk_surface_tiles"),
        sa.UniqueConstraint(*place, name="uq_surface_tiles_place"),
        sqlite_autoincrement=True,
    )
    for name, columns in {
        "ix_surface_tiles_blob": ["blob"],
        "ix_surface_tiles_draft": ["draft"],
        "ix_surface_tiles_map_number_digest": ["map_number", "digest"],
        "ix_surface_tiles_map_number_rebuilt_to": ["map_number", "rebuilt_to"],
    }.items():
        op.create_index(name, "surface_tiles", columns)

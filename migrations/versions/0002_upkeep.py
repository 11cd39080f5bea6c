"""Filters, re-encoding and novelty: poses and tags to search for, the model to come."""

from __future__ import annotations

from typing import Any

import sqlalchemy as sa
from alembic import op

revision = "0002"
down_revision = "0001"
branch_labels = None
depends_on = None

SEARCHED = [
    "map_number", "state", "session", "robot", "captured_at", "pose_parent", "pose_x", "pose_y",
    "pose_z",
]  # fmt: skip
#: Rows that are read and written at once.
_BLOCK = 1000


def upgrade() -> None:
    """Add the columns, and fill them from what is there."""
    op.add_column("maps", sa.Column("next_model_id", sa.String(length=64), nullable=True))
    op.add_column("jobs", sa.Column("model_id", sa.String(length=64), nullable=True))
    for name in ("pose_x", "pose_y", "pose_z", "novelty"):
        op.add_column("frames", sa.Column(name, sa.Float(), nullable=True))
    op.create_index("ix_frames_searched", "frames", SEARCHED)
    order: list[Any] = ["state", sa.text("priority DESC"), "attempts", "number"]
    op.create_index("ix_jobs_claimed", "jobs", order)
    op.create_table(
        "frame_tags",
        sa.Column("frame_number", sa.Integer(), nullable=False),
        sa.Column("tag", sa.String(length=128), nullable=False),
        sa.ForeignKeyConstraint(
            ["frame_number"], ["frames.number"], name=op.f("fk_frame_tags_frame_number")
        ),
        sa.PrimaryKeyConstraint("frame_number", "tag", name=op.f("pk_frame_tags")),
    )
    op.create_index(op.f("ix_frame_tags_tag_frame_number"), "frame_tags", ["tag", "frame_number"])
    _fill(op.get_bind())


def _fill(connection: sa.Connection) -> None:
    frames = sa.table(
        "frames", sa.column("number"), sa.column("tags", sa.JSON), sa.column("pose", sa.JSON),
        sa.column("pose_x"), sa.column("pose_y"), sa.column("pose_z"),
    )  # fmt: skip
    frame_tags = sa.table("frame_tags", sa.column("frame_number"), sa.column("tag"))
    after = 0
    while True:
        rows = connection.execute(
            sa.select(frames.c.number, frames.c.tags, frames.c.pose)
            .where(frames.c.number > after)
            .order_by(frames.c.number)
            .limit(_BLOCK)
        ).all()
        if not rows:
            return
        for number, _, pose in rows:
            if pose is not None:
                place = {f"pose_{axis}": pose[i][3] for i, axis in enumerate("xyz")}
                connection.execute(sa.update(frames).where(frames.c.number == number).values(place))
        named = [
            {"frame_number": n, "tag": tag} for n, tags, _ in rows for tag in sorted(set(tags))
        ]
        if named:
            connection.execute(sa.insert(frame_tags), named)
        after = rows[-1].number

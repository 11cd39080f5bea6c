"""What each map holds, counted; maps that are gone; blobs of what is deleted; ages of frames."""

from __future__ import annotations

import time

import sqlalchemy as sa
from alembic import op

revision = "0007"
down_revision = "0006"
branch_labels = None
depends_on = None

_COUNTED = "WHERE map_number = maps.number AND state NOT IN ('deleted', 'redundant')"


def upgrade() -> None:
    """Add all that, and count what is there."""
    for name in ("used_frames", "used_bytes"):
        op.add_column("maps", sa.Column(name, sa.BigInteger(), nullable=False, server_default="0"))
    op.execute(
        f"UPDATE maps SET used_frames = (SELECT count(*) FROM frames {_COUNTED}), "
        f"used_bytes = (SELECT coalesce(sum(bytes), 0) FROM frames {_COUNTED})"
    )
    texts = {"collation": "C"} if op.get_bind().dialect.name == "postgresql" else {}
    op.create_table(
        "former_maps",
        sa.Column("name", sa.String(length=63, **texts), nullable=False),
        sa.Column("number", sa.BigInteger(), nullable=False),
        sa.Column("quota_frames", sa.BigInteger(), nullable=True),
        sa.Column("quota_bytes", sa.BigInteger(), nullable=True),
        sa.PrimaryKeyConstraint("name", name=op.f("pk_former_maps")),
    )
    op.create_index(op.f("ix_former_maps_number"), "former_maps", ["number"])
    op.execute(
        "INSERT INTO former_maps (name, number) SELECT map, max(number) FROM events "
        "WHERE map IS NOT NULL AND map NOT IN (SELECT name FROM maps) GROUP BY map"
    )
    op.create_table(
        "doomed",
        sa.Column("blob", sa.String(length=64, **texts), nullable=False),
        sa.Column("at", sa.Float(), nullable=False),
        sa.PrimaryKeyConstraint("blob", name=op.f("pk_doomed")),
    )
    # what was deleted before may have left blobs that only `sceneprint fsck` would find
    op.execute(
        sa.text(
            "INSERT INTO doomed (blob, at) SELECT DISTINCT blob, CAST(:now AS FLOAT) FROM frames "
            "WHERE state = 'deleted'"
        ).bindparams(now=time.time())
    )
    living = sa.text("state != 'deleted'")
    op.create_index(
        "ix_frames_aging", "frames", ["map_number", "received_at"],
        sqlite_where=living, postgresql_where=living,
    )  # fmt: skip

"""Maps, models, frames, signatures, jobs, keys and events."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0001"
down_revision = None
branch_labels = None
depends_on = None


def upgrade() -> None:
    """Make all tables."""
    op.create_table(
        "events",
        sa.Column("number", sa.Integer(), nullable=False),
        sa.Column("at", sa.Float(), nullable=False),
        sa.Column("kind", sa.String(length=32), nullable=False),
        sa.Column("map", sa.String(length=63), nullable=True),
        sa.Column("frame_id", sa.String(length=32), nullable=True),
        sa.Column("job_id", sa.String(length=32), nullable=True),
        sa.Column("data", sa.JSON(), nullable=False),
        sa.PrimaryKeyConstraint("number", name=op.f("pk_events")),
        sqlite_autoincrement=True,
    )
    op.create_table(
        "keys",
        sa.Column("id", sa.String(length=32), nullable=False),
        sa.Column("name", sa.String(length=128), nullable=False),
        sa.Column("digest", sa.String(length=64), nullable=False),
        sa.Column("scopes", sa.JSON(), nullable=False),
        sa.Column("created_at", sa.Float(), nullable=False),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_keys")),
        sa.UniqueConstraint("digest", name=op.f("uq_keys_digest")),
        sa.UniqueConstraint("name", name=op.f("uq_keys_name")),
    )
    op.create_table(
        "models",
        sa.Column("id", sa.String(length=64), nullable=False),
        sa.Column("name", sa.String(length=64), nullable=False),
        sa.Column("content", sa.LargeBinary(), nullable=False),
        sa.Column("created_at", sa.Float(), nullable=False),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_models")),
    )
    op.create_table(
        "maps",
        sa.Column("number", sa.Integer(), nullable=False),
        sa.Column("name", sa.String(length=63), nullable=False),
        sa.Column("title", sa.String(length=200), nullable=True),
        sa.Column("model_id", sa.String(length=64), nullable=False),
        sa.Column("revision", sa.Integer(), nullable=False),
        sa.Column("created_at", sa.Float(), nullable=False),
        sa.ForeignKeyConstraint(["model_id"], ["models.id"], name=op.f("fk_maps_model_id")),
        sa.PrimaryKeyConstraint("number", name=op.f("pk_maps")),
        sa.UniqueConstraint("name", name=op.f("uq_maps_name")),
        sqlite_autoincrement=True,
    )
    op.create_table(
        "frames",
        sa.Column("number", sa.Integer(), nullable=False),
        sa.Column("id", sa.String(length=32), nullable=False),
        sa.Column("map_number", sa.Integer(), nullable=False),
        sa.Column("state", sa.String(length=16), nullable=False),
        sa.Column("reason", sa.Text(), nullable=True),
        sa.Column("content_id", sa.String(length=64), nullable=True),
        sa.Column("blob", sa.String(length=64), nullable=False),
        sa.Column("bytes", sa.Integer(), nullable=False),
        sa.Column("intrinsics", sa.JSON(), nullable=False),
        sa.Column("depth_scale", sa.Float(), nullable=False),
        sa.Column("depth_along_ray", sa.Boolean(), nullable=False),
        sa.Column("robot", sa.String(length=128), nullable=True),
        sa.Column("session", sa.String(length=128), nullable=True),
        sa.Column("captured_at", sa.Float(), nullable=True),
        sa.Column("tags", sa.JSON(), nullable=False),
        sa.Column("pose_parent", sa.String(length=128), nullable=True),
        sa.Column("pose", sa.JSON(none_as_null=True), nullable=True),
        sa.Column("received_at", sa.Float(), nullable=False),
        sa.Column("indexed_at", sa.Float(), nullable=True),
        sa.Column("revision", sa.Integer(), nullable=True),
        sa.ForeignKeyConstraint(["map_number"], ["maps.number"], name=op.f("fk_frames_map_number")),
        sa.PrimaryKeyConstraint("number", name=op.f("pk_frames")),
        sa.UniqueConstraint("id", name=op.f("uq_frames_id")),
        sa.UniqueConstraint(
            "map_number", "content_id", name=op.f("uq_frames_map_number_content_id")
        ),
        sqlite_autoincrement=True,
    )
    op.create_index(op.f("ix_frames_blob"), "frames", ["blob"], unique=False)
    op.create_index(
        op.f("ix_frames_map_number_number"), "frames", ["map_number", "number"], unique=False
    )
    op.create_index(
        op.f("ix_frames_map_number_revision"), "frames", ["map_number", "revision"], unique=False
    )
    op.create_table(
        "jobs",
        sa.Column("number", sa.Integer(), nullable=False),
        sa.Column("id", sa.String(length=32), nullable=False),
        sa.Column("kind", sa.String(length=16), nullable=False),
        sa.Column("frame_number", sa.Integer(), nullable=False),
        sa.Column("state", sa.String(length=16), nullable=False),
        sa.Column("priority", sa.Integer(), nullable=False),
        sa.Column("attempts", sa.Integer(), nullable=False),
        sa.Column("failures", sa.Integer(), nullable=False),
        sa.Column("token", sa.Integer(), nullable=False),
        sa.Column("run_after", sa.Float(), nullable=False),
        sa.Column("leased_until", sa.Float(), nullable=True),
        sa.Column("worker", sa.String(length=128), nullable=True),
        sa.Column("error", sa.Text(), nullable=True),
        sa.Column("traceback", sa.Text(), nullable=True),
        sa.Column("created_at", sa.Float(), nullable=False),
        sa.Column("started_at", sa.Float(), nullable=True),
        sa.Column("finished_at", sa.Float(), nullable=True),
        sa.ForeignKeyConstraint(
            ["frame_number"], ["frames.number"], name=op.f("fk_jobs_frame_number")
        ),
        sa.PrimaryKeyConstraint("number", name=op.f("pk_jobs")),
        sa.UniqueConstraint("id", name=op.f("uq_jobs_id")),
        sqlite_autoincrement=True,
    )
    op.create_index(op.f("ix_jobs_frame_number"), "jobs", ["frame_number"], unique=False)
    op.create_index(op.f("ix_jobs_state_run_after"), "jobs", ["state", "run_after"], unique=False)
    op.create_table(
        "signatures",
        sa.Column("frame_number", sa.Integer(), nullable=False),
        sa.Column("model_id", sa.String(length=64), nullable=False),
        sa.Column("vector", sa.LargeBinary(), nullable=False),
        sa.Column("checksum", sa.BigInteger(), nullable=False),
        sa.Column("geometry", sa.String(length=64), nullable=False),
        sa.Column("n_patches", sa.JSON(), nullable=False),
        sa.Column("n_pairs", sa.JSON(), nullable=False),
        sa.ForeignKeyConstraint(
            ["frame_number"], ["frames.number"], name=op.f("fk_signatures_frame_number")
        ),
        sa.ForeignKeyConstraint(["model_id"], ["models.id"], name=op.f("fk_signatures_model_id")),
        sa.PrimaryKeyConstraint("frame_number", "model_id", name=op.f("pk_signatures")),
    )
    op.create_index(op.f("ix_signatures_geometry"), "signatures", ["geometry"], unique=False)

"""Ids that callers choose, jobs of other kinds, scopes of keys, audit, samples, idempotency."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import sqlalchemy as sa
from alembic import op

revision = "0003"
down_revision = "0002"
branch_labels = None
depends_on = None

SEARCHED = [
    "map_number", "state", "session", "robot", "captured_at", "pose_parent", "pose_x", "pose_y",
    "pose_z",
]  # fmt: skip


def upgrade() -> None:
    """Bring the tables of 0002 to those of 0003; what is in them stays."""
    with _numbers_go_on("frames"):
        _frames()
    with _numbers_go_on("jobs"):
        _jobs()
    with _numbers_go_on("events"):
        _events()
    _keys()
    _new_tables()


@contextmanager
def _numbers_go_on(table: str) -> Iterator[None]:
    """Let a table that SQLite makes anew give no number out that was given out before."""
    connection = op.get_bind()
    if connection.dialect.name != "sqlite":
        yield
        return
    asked = sa.text("SELECT seq FROM sqlite_sequence WHERE name = :name")
    before = connection.execute(asked, {"name": table}).scalar()
    yield
    if before is not None:
        connection.execute(
            sa.text("DELETE FROM sqlite_sequence WHERE name = :name"), {"name": table}
        )
        connection.execute(
            sa.text("INSERT INTO sqlite_sequence (name, seq) VALUES (:name, :seq)"),
            {"name": table, "seq": before},
        )


def _frames() -> None:
    for name in (
        "ix_frames_blob", "ix_frames_map_number_number", "ix_frames_map_number_revision",
        "ix_frames_searched",
    ):  # fmt: skip
        op.drop_index(name, "frames")
    former = sa.Table(
        "frames", sa.MetaData(),
        sa.Column("number", sa.Integer(), nullable=False),
        sa.Column("id", sa.String(length=32), nullable=False),
        sa.Column("map_number", sa.Integer(), nullable=False),
        sa.Column("state", sa.String(length=16), nullable=False),
        sa.Column("reason", sa.Text()),
        sa.Column("content_id", sa.String(length=64)),
        sa.Column("blob", sa.String(length=64), nullable=False),
        sa.Column("bytes", sa.Integer(), nullable=False),
        sa.Column("intrinsics", sa.JSON(), nullable=False),
        sa.Column("depth_scale", sa.Float(), nullable=False),
        sa.Column("depth_along_ray", sa.Boolean(), nullable=False),
        sa.Column("robot", sa.String(length=128)),
        sa.Column("session", sa.String(length=128)),
        sa.Column("captured_at", sa.Float()),
        sa.Column("tags", sa.JSON(), nullable=False),
        sa.Column("pose_parent", sa.String(length=128)),
        sa.Column("pose", sa.JSON(none_as_null=True)),
        sa.Column("received_at", sa.Float(), nullable=False),
        sa.Column("indexed_at", sa.Float()),
        sa.Column("revision", sa.Integer()),
        sa.Column("pose_x", sa.Float()),
        sa.Column("pose_y", sa.Float()),
        sa.Column("pose_z", sa.Float()),
        sa.Column("novelty", sa.Float()),
        sa.ForeignKeyConstraint(["map_number"], ["maps.number"], name="fk_frames_map_number"),
        sa.PrimaryKeyConstraint("number", name="pk_frames"),
        sa.UniqueConstraint("id", name="uq_frames_id"),
        sa.UniqueConstraint("map_number", "content_id", name="uq_frames_map_number_content_id"),
        sqlite_autoincrement=True,
    )  # fmt: skip
    with op.batch_alter_table("frames", copy_from=former) as batch:
        batch.drop_constraint("uq_frames_id", type_="unique")
        batch.drop_constraint("uq_frames_map_number_content_id", type_="unique")
        batch.alter_column("id", type_=sa.String(length=64), existing_nullable=False)
        batch.add_column(sa.Column("base_frame", sa.String(length=128)))
        batch.add_column(sa.Column("base", sa.JSON(none_as_null=True)))
        batch.create_unique_constraint("uq_frames_map_number_id", ["map_number", "id"])
    op.create_index("ix_frames_map_number_content_id", "frames", ["map_number", "content_id"])
    op.create_index("ix_frames_blob", "frames", ["blob"])
    op.create_index("ix_frames_map_number_number", "frames", ["map_number", "number"])
    op.create_index("ix_frames_map_number_revision", "frames", ["map_number", "revision"])
    op.create_index("ix_frames_map_number_indexed_at", "frames", ["map_number", "indexed_at"])
    op.create_index("ix_frames_searched", "frames", SEARCHED)


def _jobs() -> None:
    for name in ("ix_jobs_claimed", "ix_jobs_frame_number", "ix_jobs_state_run_after"):
        op.drop_index(name, "jobs")
    former = sa.Table(
        "jobs", sa.MetaData(),
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
        sa.Column("leased_until", sa.Float()),
        sa.Column("worker", sa.String(length=128)),
        sa.Column("error", sa.Text()),
        sa.Column("traceback", sa.Text()),
        sa.Column("created_at", sa.Float(), nullable=False),
        sa.Column("started_at", sa.Float()),
        sa.Column("finished_at", sa.Float()),
        sa.Column("model_id", sa.String(length=64)),
        sa.ForeignKeyConstraint(["frame_number"], ["frames.number"], name="fk_jobs_frame_number"),
        sa.PrimaryKeyConstraint("number", name="pk_jobs"),
        sa.UniqueConstraint("id", name="uq_jobs_id"),
        sqlite_autoincrement=True,
    )  # fmt: skip
    with op.batch_alter_table("jobs", copy_from=former) as batch:
        batch.alter_column("frame_number", existing_type=sa.Integer(), nullable=True)
        batch.add_column(sa.Column("map_number", sa.Integer()))
        for name in ("data", "progress", "result"):
            batch.add_column(sa.Column(name, sa.JSON(none_as_null=True)))
        batch.create_foreign_key("fk_jobs_map_number", "maps", ["map_number"], ["number"])
    op.execute(
        "UPDATE jobs SET map_number = "
        "(SELECT map_number FROM frames WHERE frames.number = jobs.frame_number)"
    )
    op.create_index("ix_jobs_frame_number", "jobs", ["frame_number"])
    op.create_index("ix_jobs_map_number_number", "jobs", ["map_number", "number"])
    op.create_index("ix_jobs_state_run_after", "jobs", ["state", "run_after"])
    op.create_index(
        "ix_jobs_claimed", "jobs", ["state", sa.text("priority DESC"), "attempts", "number"]
    )


def _events() -> None:
    """Ids of frames may be longer now."""
    former = sa.Table(
        "events", sa.MetaData(),
        sa.Column("number", sa.Integer(), nullable=False),
        sa.Column("at", sa.Float(), nullable=False),
        sa.Column("kind", sa.String(length=32), nullable=False),
        sa.Column("map", sa.String(length=63)),
        sa.Column("frame_id", sa.String(length=32)),
        sa.Column("job_id", sa.String(length=32)),
        sa.Column("data", sa.JSON(), nullable=False),
        sa.PrimaryKeyConstraint("number", name="pk_events"),
        sqlite_autoincrement=True,
    )  # fmt: skip
    with op.batch_alter_table("events", copy_from=former) as batch:
        batch.alter_column("frame_id", type_=sa.String(length=64), existing_nullable=True)
    op.create_index("ix_events_map_number", "events", ["map", "number"])


def _keys() -> None:
    """A key of before opened everything, and goes on to."""
    connection = op.get_bind()
    asked = sa.text("SELECT id, name, digest, created_at FROM keys")
    there = [dict(row) for row in connection.execute(asked).mappings()]
    op.drop_table("keys")
    keys = op.create_table(
        "keys",
        sa.Column("id", sa.String(length=32), nullable=False),
        sa.Column("name", sa.String(length=128), nullable=False),
        sa.Column("digest", sa.String(length=64), nullable=False),
        sa.Column("grants", sa.JSON(), nullable=False),
        sa.Column("created_at", sa.Float(), nullable=False),
        sa.Column("expires_at", sa.Float()),
        sa.PrimaryKeyConstraint("id", name="pk_keys"),
        sa.UniqueConstraint("digest", name="uq_keys_digest"),
        sa.UniqueConstraint("name", name="uq_keys_name"),
    )
    if there:
        connection.execute(sa.insert(keys), [{**row, "grants": {"*": "admin"}} for row in there])


def _new_tables() -> None:
    op.create_table(
        "job_items",
        sa.Column("job_number", sa.Integer(), nullable=False),
        sa.Column("number", sa.Integer(), nullable=False),
        sa.Column("data", sa.JSON(), nullable=False),
        sa.ForeignKeyConstraint(["job_number"], ["jobs.number"], name="fk_job_items_job_number"),
        sa.PrimaryKeyConstraint("job_number", "number", name="pk_job_items"),
    )
    op.create_table(
        "job_files",
        sa.Column("job_number", sa.Integer(), nullable=False),
        sa.Column("name", sa.String(length=64), nullable=False),
        sa.Column("blob", sa.String(length=64), nullable=False),
        sa.Column("bytes", sa.BigInteger(), nullable=False),
        sa.Column("media_type", sa.String(length=64), nullable=False),
        sa.ForeignKeyConstraint(["job_number"], ["jobs.number"], name="fk_job_files_job_number"),
        sa.PrimaryKeyConstraint("job_number", "name", name="pk_job_files"),
    )
    op.create_index("ix_job_files_blob", "job_files", ["blob"])
    op.create_table(
        "idempotency",
        sa.Column("actor", sa.String(length=128), nullable=False),
        sa.Column("key", sa.String(length=255), nullable=False),
        sa.Column("fingerprint", sa.String(length=64), nullable=False),
        sa.Column("data", sa.JSON(), nullable=False),
        sa.Column("created_at", sa.Float(), nullable=False),
        sa.PrimaryKeyConstraint("actor", "key", name="pk_idempotency"),
    )
    op.create_index("ix_idempotency_created_at", "idempotency", ["created_at"])
    op.create_table(
        "audit",
        sa.Column("number", sa.Integer(), nullable=False),
        sa.Column("at", sa.Float(), nullable=False),
        sa.Column("actor", sa.String(length=128), nullable=False),
        sa.Column("address", sa.String(length=64)),
        sa.Column("action", sa.String(length=64), nullable=False),
        sa.Column("map", sa.String(length=63)),
        sa.Column("target", sa.String(length=128)),
        sa.Column("request_id", sa.String(length=64)),
        sa.Column("data", sa.JSON(), nullable=False),
        sa.PrimaryKeyConstraint("number", name="pk_audit"),
        sqlite_autoincrement=True,
    )
    op.create_table(
        "samples",
        sa.Column("number", sa.Integer(), nullable=False),
        sa.Column("at", sa.Float(), nullable=False),
        sa.Column("process", sa.String(length=128), nullable=False),
        sa.Column("kind", sa.String(length=16), nullable=False),
        sa.Column("data", sa.JSON(), nullable=False),
        sa.PrimaryKeyConstraint("number", name="pk_samples"),
        sqlite_autoincrement=True,
    )
    op.create_index("ix_samples_kind_at", "samples", ["kind", "at"])

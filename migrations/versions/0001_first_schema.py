"""Create the tables of version 1.0."""

from __future__ import annotations

import secrets

import sqlalchemy as sa
from alembic import op
from sqlalchemy.types import TypeEngine

revision = "0001"
down_revision = None
branch_labels = None
depends_on = None

#: Numbers of 64 bits. SQLite's have 64 bits anyway, and only what it calls INTEGER numbers rows.
WHOLE = sa.BigInteger().with_variant(sa.Integer, "sqlite")
#: Texts in the order of their code points, as in SQLite, whatever the server's language is.
TEXT = sa.Text().with_variant(sa.Text(collation="C"), "postgresql")


def _string(length: int) -> TypeEngine[str]:
    """Return the type of a short text, in the order of `TEXT`."""
    return sa.String(length).with_variant(sa.String(length, collation="C"), "postgresql")


def _create_audit() -> None:
    op.create_table(
        "audit",
        sa.Column("number", WHOLE, nullable=False),
        sa.Column("at", sa.Float(), nullable=False),
        sa.Column("actor", _string(128), nullable=False),
        sa.Column("address", _string(64)),
        sa.Column("tenant", _string(128), nullable=False),
        sa.Column("action", _string(32), nullable=False),
        sa.Column("map", _string(63)),
        sa.Column("target", _string(128)),
        sa.Column("request_id", _string(64)),
        sa.Column("data", sa.JSON(), nullable=False),
        sa.PrimaryKeyConstraint("number", name="pk_audit"),
        sqlite_autoincrement=True,
    )
    op.create_index("ix_audit_tenant_number", "audit", ["tenant", "number"])


def _create_doomed() -> None:
    op.create_table(
        "doomed",
        sa.Column("blob", _string(64), nullable=False),
        sa.Column("at", sa.Float(), nullable=False),
        sa.PrimaryKeyConstraint("blob", name="pk_doomed"),
    )


def _create_events() -> None:
    op.create_table(
        "events",
        sa.Column("number", WHOLE, nullable=False),
        sa.Column("at", sa.Float(), nullable=False),
        sa.Column("kind", _string(32), nullable=False),
        sa.Column("map", _string(63)),
        sa.Column("frame_id", _string(64)),
        sa.Column("job_id", _string(32)),
        sa.Column("data", sa.JSON(), nullable=False),
        sa.PrimaryKeyConstraint("number", name="pk_events"),
        sqlite_autoincrement=True,
    )
    op.create_index("ix_events_map_number", "events", ["map", "number"])
    op.create_index(
        "ix_events_map_number_deleted",
        "events",
        ["map", "number"],
        sqlite_where=sa.text("kind = 'map.deleted'"),
        postgresql_where=sa.text("kind = 'map.deleted'"),
    )


def _create_former_maps() -> None:
    op.create_table(
        "former_maps",
        sa.Column("name", _string(63), nullable=False),
        sa.Column("number", sa.BigInteger(), nullable=False),
        sa.Column("quota_frames", sa.BigInteger()),
        sa.Column("quota_bytes", sa.BigInteger()),
        sa.PrimaryKeyConstraint("name", name="pk_former_maps"),
    )
    op.create_index("ix_former_maps_number", "former_maps", ["number"])


def _create_idempotency() -> None:
    op.create_table(
        "idempotency",
        sa.Column("actor", _string(128), nullable=False),
        sa.Column("key", _string(255), nullable=False),
        sa.Column("fingerprint", _string(64), nullable=False),
        sa.Column("data", sa.JSON(), nullable=False),
        sa.Column("created_at", sa.Float(), nullable=False),
        sa.PrimaryKeyConstraint("actor", "key", name="pk_idempotency"),
    )
    op.create_index("ix_idempotency_created_at", "idempotency", ["created_at"])


def _create_keys() -> None:
    op.create_table(
        "keys",
        sa.Column("id", _string(32), nullable=False),
        sa.Column("name", _string(128), nullable=False),
        sa.Column("digest", _string(64), nullable=False),
        sa.Column("grants", sa.JSON(), nullable=False),
        sa.Column("created_at", sa.Float(), nullable=False),
        sa.Column("expires_at", sa.Float()),
        sa.Column("tenant", _string(128), nullable=False, server_default=""),
        sa.Column("previous_digest", _string(64)),
        sa.Column("previous_until", sa.Float()),
        sa.Column("last_used_at", sa.Float()),
        sa.PrimaryKeyConstraint("id", name="pk_keys"),
        sa.UniqueConstraint("digest", name="uq_keys_digest"),
        sa.UniqueConstraint("name", name="uq_keys_name"),
    )
    op.create_index("ix_keys_previous_digest", "keys", ["previous_digest"])
    op.create_index("ix_keys_tenant", "keys", ["tenant"])


def _create_models() -> None:
    op.create_table(
        "models",
        sa.Column("id", _string(64), nullable=False),
        sa.Column("name", _string(64), nullable=False),
        sa.Column("content", sa.LargeBinary(), nullable=False),
        sa.Column("created_at", sa.Float(), nullable=False),
        sa.PrimaryKeyConstraint("id", name="pk_models"),
    )


def _create_pending_events() -> None:
    op.create_table(
        "pending_events",
        sa.Column("number", WHOLE, nullable=False),
        sa.Column("at", sa.Float(), nullable=False),
        sa.Column("kind", _string(32), nullable=False),
        sa.Column("map", _string(63)),
        sa.Column("frame_id", _string(64)),
        sa.Column("job_id", _string(32)),
        sa.Column("data", sa.JSON(), nullable=False),
        sa.PrimaryKeyConstraint("number", name="pk_pending_events"),
        sqlite_autoincrement=True,
    )


def _create_samples() -> None:
    op.create_table(
        "samples",
        sa.Column("number", WHOLE, nullable=False),
        sa.Column("at", sa.Float(), nullable=False),
        sa.Column("process", _string(128), nullable=False),
        sa.Column("kind", _string(16), nullable=False),
        sa.Column("data", sa.JSON(), nullable=False),
        sa.PrimaryKeyConstraint("number", name="pk_samples"),
        sqlite_autoincrement=True,
    )
    op.create_index("ix_samples_kind_at", "samples", ["kind", "at"])


def _create_schema_range() -> None:
    op.create_table(
        "schema_range",
        sa.Column("least_revision", _string(32), nullable=False),
        sa.PrimaryKeyConstraint("least_revision", name="pk_schema_range"),
    )


def _create_scrubs() -> None:
    op.create_table(
        "scrubs",
        sa.Column("number", WHOLE, nullable=False, autoincrement=False),
        sa.Column("position", WHOLE, nullable=False),
        sa.Column("next_at", sa.Float(), nullable=False),
        sa.Column("began_at", sa.Float(), nullable=False),
        sa.Column("finished_at", sa.Float()),
        sa.Column("blobs", sa.BigInteger(), nullable=False),
        sa.Column("bytes", sa.BigInteger(), nullable=False),
        sa.Column("damaged", sa.BigInteger(), nullable=False),
        sa.PrimaryKeyConstraint("number", name="pk_scrubs"),
    )


def _create_secrets() -> None:
    op.create_table(
        "secrets",
        sa.Column("name", _string(32), nullable=False),
        sa.Column("value", sa.LargeBinary(), nullable=False),
        sa.PrimaryKeyConstraint("name", name="pk_secrets"),
    )


def _create_tenants() -> None:
    op.create_table(
        "tenants",
        sa.Column("name", _string(128), nullable=False),
        sa.Column("created_at", sa.Float(), nullable=False),
        sa.Column("turn", WHOLE, nullable=False, server_default="0"),
        sa.PrimaryKeyConstraint("name", name="pk_tenants"),
    )


def _create_maps() -> None:
    op.create_table(
        "maps",
        sa.Column("number", WHOLE, nullable=False),
        sa.Column("name", _string(63), nullable=False),
        sa.Column("title", _string(200)),
        sa.Column("model_id", _string(64), nullable=False),
        sa.Column("next_model_id", _string(64)),
        sa.Column("revision", WHOLE, nullable=False),
        sa.Column("created_at", sa.Float(), nullable=False),
        sa.Column("quota_frames", sa.BigInteger()),
        sa.Column("quota_bytes", sa.BigInteger()),
        sa.Column("retention_days", sa.Float()),
        sa.Column("used_frames", sa.BigInteger(), nullable=False, server_default="0"),
        sa.Column("used_bytes", sa.BigInteger(), nullable=False, server_default="0"),
        sa.Column("up", sa.JSON()),
        sa.Column("pruned_revision", WHOLE, nullable=False, server_default="0"),
        sa.PrimaryKeyConstraint("number", name="pk_maps"),
        sa.ForeignKeyConstraint(["model_id"], ["models.id"], name="fk_maps_model_id"),
        sa.UniqueConstraint("name", name="uq_maps_name"),
        sqlite_autoincrement=True,
    )


def _create_frames() -> None:
    op.create_table(
        "frames",
        sa.Column("number", WHOLE, nullable=False),
        sa.Column("id", _string(64), nullable=False),
        sa.Column("map_number", WHOLE, nullable=False),
        sa.Column("state", _string(16), nullable=False),
        sa.Column("reason", TEXT),
        sa.Column("content_id", _string(64)),
        sa.Column("blob", _string(64), nullable=False),
        sa.Column("bytes", WHOLE, nullable=False),
        sa.Column("intrinsics", sa.JSON(), nullable=False),
        sa.Column("depth_scale", sa.Float(), nullable=False),
        sa.Column("depth_along_ray", sa.Boolean(), nullable=False),
        sa.Column("robot", _string(128)),
        sa.Column("session", _string(128)),
        sa.Column("captured_at", sa.Float()),
        sa.Column("tags", sa.JSON(), nullable=False),
        sa.Column("pose_parent", _string(128)),
        sa.Column("pose", sa.JSON()),
        sa.Column("pose_x", sa.Float()),
        sa.Column("pose_y", sa.Float()),
        sa.Column("pose_z", sa.Float()),
        sa.Column("sent_parent", _string(128)),
        sa.Column("sent_pose", sa.JSON()),
        sa.Column("base_frame", _string(128)),
        sa.Column("base", sa.JSON()),
        sa.Column("novelty", sa.Float()),
        sa.Column("received_at", sa.Float(), nullable=False),
        sa.Column("indexed_at", sa.Float()),
        sa.Column("revision", WHOLE),
        sa.Column("cloud", sa.JSON()),
        sa.Column("up", sa.JSON()),
        sa.Column("name", _string(255)),
        sa.Column("sequence", WHOLE),
        sa.Column("samples", sa.JSON()),
        sa.Column("ended_at", sa.Float()),
        sa.Column("deletion", WHOLE),
        sa.Column("deleted_from", _string(16)),
        sa.Column("deleted_content", _string(64)),
        sa.PrimaryKeyConstraint("number", name="pk_frames"),
        sa.ForeignKeyConstraint(["map_number"], ["maps.number"], name="fk_frames_map_number"),
        sa.UniqueConstraint("map_number", "id", name="uq_frames_map_number_id"),
        sqlite_autoincrement=True,
    )
    op.create_index(
        "ix_frames_aging",
        "frames",
        ["map_number", "received_at"],
        sqlite_where=sa.text("state != 'deleted'"),
        postgresql_where=sa.text("state != 'deleted'"),
    )
    op.create_index("ix_frames_blob", "frames", ["blob"])
    op.create_index(
        "ix_frames_ended",
        "frames",
        ["map_number", "state", "ended_at"],
        sqlite_where=sa.text("state IN ('deleted', 'redundant')"),
        postgresql_where=sa.text("state IN ('deleted', 'redundant')"),
    )
    op.create_index("ix_frames_map_number_content_id", "frames", ["map_number", "content_id"])
    op.create_index("ix_frames_map_number_number", "frames", ["map_number", "number"])
    op.create_index("ix_frames_map_number_revision", "frames", ["map_number", "revision"])
    op.create_index(
        "ix_frames_named", "frames", ["map_number", "name", "state", "session", "robot"]
    )
    op.create_index(
        "ix_frames_placed", "frames", ["map_number", "pose_parent", "pose_x", "pose_y", "pose_z"]
    )
    op.create_index(
        "ix_frames_searched",
        "frames",
        [
            "map_number",
            "state",
            "session",
            "robot",
            "captured_at",
            "sequence",
            "pose_parent",
            "pose_x",
            "pose_y",
            "pose_z",
        ],
    )
    op.create_index(
        "ix_frames_tombstones",
        "frames",
        ["map_number", "deletion", "number"],
        sqlite_where=sa.text("deletion IS NOT NULL"),
        postgresql_where=sa.text("deletion IS NOT NULL"),
    )


def _create_parent_joins() -> None:
    op.create_table(
        "parent_joins",
        sa.Column("map_number", WHOLE, nullable=False),
        sa.Column("parent", _string(128), nullable=False),
        sa.Column("towards", _string(128), nullable=False),
        sa.Column("transform", sa.JSON(), nullable=False),
        sa.Column("job_id", _string(32), nullable=False),
        sa.Column("joined_at", sa.Float(), nullable=False),
        sa.Column("undone_at", sa.Float()),
        sa.PrimaryKeyConstraint("map_number", "parent", "towards", name="pk_parent_joins"),
        sa.ForeignKeyConstraint(["map_number"], ["maps.number"], name="fk_parent_joins_map_number"),
    )


def _create_queries() -> None:
    op.create_table(
        "queries",
        sa.Column("number", WHOLE, nullable=False),
        sa.Column("id", _string(32), nullable=False),
        sa.Column("at", sa.Float(), nullable=False),
        sa.Column("map_number", WHOLE, nullable=False),
        sa.Column("maps", sa.JSON()),
        sa.Column("robot", _string(128)),
        sa.Column("session", _string(128)),
        sa.Column("key_id", _string(32)),
        sa.Column("status", _string(16), nullable=False),
        sa.Column("cause", _string(64)),
        sa.Column("reason", TEXT, nullable=False),
        sa.Column("pose_parent", _string(128)),
        sa.Column("pose", sa.JSON()),
        sa.Column("confidence", sa.Float()),
        sa.Column("support", WHOLE),
        sa.Column("alternatives", WHOLE, nullable=False),
        sa.Column("milliseconds", sa.Float(), nullable=False),
        sa.Column("kind", _string(8)),
        sa.Column("frame_map", _string(63)),
        sa.Column("frame_id", _string(64)),
        sa.Column("listed", sa.Boolean(), nullable=False),
        sa.Column("kept_at", sa.Float()),
        sa.Column("title", _string(200)),
        sa.Column("shown", sa.JSON()),
        sa.Column("bytes", sa.BigInteger(), nullable=False),
        sa.Column("answer", sa.LargeBinary()),
        sa.PrimaryKeyConstraint("number", name="pk_queries"),
        sa.ForeignKeyConstraint(["map_number"], ["maps.number"], name="fk_queries_map_number"),
        sa.UniqueConstraint("id", name="uq_queries_id"),
        sqlite_autoincrement=True,
    )
    op.create_index("ix_queries_at_number", "queries", ["at", "number"])
    op.create_index(
        "ix_queries_kept",
        "queries",
        ["map_number", "at", "number"],
        sqlite_where=sa.text("kept_at IS NOT NULL"),
        postgresql_where=sa.text("kept_at IS NOT NULL"),
    )
    op.create_index("ix_queries_map_number_at_number", "queries", ["map_number", "at", "number"])
    op.create_index(
        "ix_queries_map_number_status_at_number",
        "queries",
        ["map_number", "status", "at", "number"],
    )
    op.create_index("ix_queries_robot_at_number", "queries", ["robot", "at", "number"])
    op.create_index(
        "ix_queries_stored",
        "queries",
        ["at", "number", "bytes"],
        sqlite_where=sa.text("bytes > 0"),
        postgresql_where=sa.text("bytes > 0"),
    )


def _create_surface_tiles() -> None:
    op.create_table(
        "surface_tiles",
        sa.Column("number", WHOLE, nullable=False),
        sa.Column("map_number", WHOLE, nullable=False),
        sa.Column("parent", _string(128), nullable=False),
        sa.Column("level", WHOLE, nullable=False),
        sa.Column("tile_x", WHOLE, nullable=False),
        sa.Column("tile_y", WHOLE, nullable=False),
        sa.Column("tile_z", WHOLE, nullable=False),
        sa.Column("cells", WHOLE, nullable=False),
        sa.Column("blob", _string(64)),
        sa.Column("digest", _string(64), nullable=False),
        sa.Column("scale", WHOLE, nullable=False),
        sa.Column("rebuilt_to", WHOLE),
        sa.Column("draft", _string(64)),
        sa.Column("low_x", sa.Float(), nullable=False),
        sa.Column("low_y", sa.Float(), nullable=False),
        sa.Column("low_z", sa.Float(), nullable=False),
        sa.Column("high_x", sa.Float(), nullable=False),
        sa.Column("high_y", sa.Float(), nullable=False),
        sa.Column("high_z", sa.Float(), nullable=False),
        sa.PrimaryKeyConstraint("number", name="pk_surface_tiles"),
        sa.ForeignKeyConstraint(
            ["map_number"], ["maps.number"], name="fk_surface_tiles_map_number"
        ),
        sa.UniqueConstraint(
            "map_number",
            "parent",
            "level",
            "tile_x",
            "tile_y",
            "tile_z",
            name="uq_surface_tiles_place",
        ),
        sqlite_autoincrement=True,
    )
    op.create_index("ix_surface_tiles_blob", "surface_tiles", ["blob"])
    op.create_index("ix_surface_tiles_draft", "surface_tiles", ["draft"])
    op.create_index("ix_surface_tiles_map_number_digest", "surface_tiles", ["map_number", "digest"])
    op.create_index(
        "ix_surface_tiles_map_number_rebuilt_to", "surface_tiles", ["map_number", "rebuilt_to"]
    )


def _create_surfaces() -> None:
    op.create_table(
        "surfaces",
        sa.Column("map_number", WHOLE, nullable=False),
        sa.Column("model_id", _string(64), nullable=False),
        sa.Column("cell_m", sa.Float(), nullable=False),
        sa.Column("wanted", sa.Boolean(), nullable=False),
        sa.Column("job_number", WHOLE),
        sa.Column("revision", WHOLE, nullable=False),
        sa.Column("edits", WHOLE, nullable=False),
        sa.Column("pose_edits", WHOLE, nullable=False),
        sa.Column("scale", WHOLE, nullable=False),
        sa.Column("taken_from", sa.Float()),
        sa.Column("taken_step_s", sa.Float(), nullable=False),
        sa.Column("first_taken", sa.Float()),
        sa.Column("last_taken", sa.Float()),
        sa.Column("sessions", sa.JSON(), nullable=False),
        sa.Column("parents", sa.JSON(), nullable=False),
        sa.Column("updated_at", sa.Float()),
        sa.PrimaryKeyConstraint("map_number", name="pk_surfaces"),
        sa.ForeignKeyConstraint(["map_number"], ["maps.number"], name="fk_surfaces_map_number"),
    )


def _create_frame_tags() -> None:
    op.create_table(
        "frame_tags",
        sa.Column("frame_number", WHOLE, nullable=False),
        sa.Column("tag", _string(128), nullable=False),
        sa.PrimaryKeyConstraint("frame_number", "tag", name="pk_frame_tags"),
        sa.ForeignKeyConstraint(
            ["frame_number"], ["frames.number"], name="fk_frame_tags_frame_number"
        ),
    )
    op.create_index("ix_frame_tags_tag_frame_number", "frame_tags", ["tag", "frame_number"])


def _create_jobs() -> None:
    op.create_table(
        "jobs",
        sa.Column("number", WHOLE, nullable=False),
        sa.Column("id", _string(32), nullable=False),
        sa.Column("kind", _string(16), nullable=False),
        sa.Column("frame_number", WHOLE),
        sa.Column("map_number", WHOLE),
        sa.Column("model_id", _string(64)),
        sa.Column("data", sa.JSON()),
        sa.Column("progress", sa.JSON()),
        sa.Column("result", sa.JSON()),
        sa.Column("state", _string(16), nullable=False),
        sa.Column("priority", WHOLE, nullable=False),
        sa.Column("attempts", WHOLE, nullable=False),
        sa.Column("failures", WHOLE, nullable=False),
        sa.Column("token", WHOLE, nullable=False),
        sa.Column("run_after", sa.Float(), nullable=False),
        sa.Column("leased_until", sa.Float()),
        sa.Column("worker", _string(128)),
        sa.Column("error", TEXT),
        sa.Column("traceback", TEXT),
        sa.Column("created_at", sa.Float(), nullable=False),
        sa.Column("started_at", sa.Float()),
        sa.Column("finished_at", sa.Float()),
        sa.Column("tenant", _string(128), nullable=False, server_default=""),
        sa.Column("turn", WHOLE),
        sa.PrimaryKeyConstraint("number", name="pk_jobs"),
        sa.ForeignKeyConstraint(["frame_number"], ["frames.number"], name="fk_jobs_frame_number"),
        sa.ForeignKeyConstraint(["map_number"], ["maps.number"], name="fk_jobs_map_number"),
        sa.UniqueConstraint("id", name="uq_jobs_id"),
        sqlite_autoincrement=True,
    )
    op.create_index(
        "ix_jobs_claimed",
        "jobs",
        ["state", "tenant", sa.text("priority DESC"), "attempts", "number"],
    )
    op.create_index("ix_jobs_frame_number", "jobs", ["frame_number"])
    op.create_index("ix_jobs_map_number_number", "jobs", ["map_number", "number"])
    op.create_index("ix_jobs_state_run_after", "jobs", ["state", "run_after"])
    op.create_index("ix_jobs_tenant_turn", "jobs", ["tenant", "turn"])
    op.create_index("ix_jobs_turn", "jobs", ["turn"])


def _create_signatures() -> None:
    op.create_table(
        "signatures",
        sa.Column("frame_number", WHOLE, nullable=False),
        sa.Column("model_id", _string(64), nullable=False),
        sa.Column("vector", sa.LargeBinary(), nullable=False),
        sa.Column("checksum", sa.BigInteger(), nullable=False),
        sa.Column("geometry", _string(64), nullable=False),
        sa.Column("n_patches", sa.JSON(), nullable=False),
        sa.Column("n_pairs", sa.JSON(), nullable=False),
        sa.PrimaryKeyConstraint("frame_number", "model_id", name="pk_signatures"),
        sa.ForeignKeyConstraint(
            ["frame_number"], ["frames.number"], name="fk_signatures_frame_number"
        ),
        sa.ForeignKeyConstraint(["model_id"], ["models.id"], name="fk_signatures_model_id"),
    )
    op.create_index("ix_signatures_geometry", "signatures", ["geometry"])


def _create_surface_frames() -> None:
    op.create_table(
        "surface_frames",
        sa.Column("frame_number", WHOLE, nullable=False),
        sa.Column("map_number", WHOLE, nullable=False),
        sa.Column("parent", _string(128), nullable=False),
        sa.Column("changed", sa.Boolean(), nullable=False),
        sa.PrimaryKeyConstraint("frame_number", name="pk_surface_frames"),
        sa.ForeignKeyConstraint(
            ["frame_number"], ["frames.number"], name="fk_surface_frames_frame_number"
        ),
        sa.ForeignKeyConstraint(
            ["map_number"], ["maps.number"], name="fk_surface_frames_map_number"
        ),
    )
    op.create_index(
        "ix_surface_frames_map_number_parent_changed",
        "surface_frames",
        ["map_number", "parent", "changed"],
    )


def _create_surface_touches() -> None:
    op.create_table(
        "surface_touches",
        sa.Column("tile_number", WHOLE, nullable=False),
        sa.Column("frame_number", WHOLE, nullable=False),
        sa.PrimaryKeyConstraint("tile_number", "frame_number", name="pk_surface_touches"),
        sa.ForeignKeyConstraint(
            ["frame_number"], ["frames.number"], name="fk_surface_touches_frame_number"
        ),
        sa.ForeignKeyConstraint(
            ["tile_number"], ["surface_tiles.number"], name="fk_surface_touches_tile_number"
        ),
    )
    op.create_index("ix_surface_touches_frame_number", "surface_touches", ["frame_number"])


def _create_job_files() -> None:
    op.create_table(
        "job_files",
        sa.Column("job_number", WHOLE, nullable=False),
        sa.Column("name", _string(64), nullable=False),
        sa.Column("blob", _string(64), nullable=False),
        sa.Column("bytes", sa.BigInteger(), nullable=False),
        sa.Column("media_type", _string(64), nullable=False),
        sa.PrimaryKeyConstraint("job_number", "name", name="pk_job_files"),
        sa.ForeignKeyConstraint(["job_number"], ["jobs.number"], name="fk_job_files_job_number"),
    )
    op.create_index("ix_job_files_blob", "job_files", ["blob"])


def _create_job_items() -> None:
    op.create_table(
        "job_items",
        sa.Column("job_number", WHOLE, nullable=False),
        sa.Column("number", WHOLE, nullable=False),
        sa.Column("data", sa.JSON(), nullable=False),
        sa.PrimaryKeyConstraint("job_number", "number", name="pk_job_items"),
        sa.ForeignKeyConstraint(["job_number"], ["jobs.number"], name="fk_job_items_job_number"),
    )


_COLUMNS = "at, kind, map, frame_id, job_id, data"

#: The process that numbers events holds this lock until it commits, so that numbers are in commit
#: order. The lock's numbers are those of `LOCKS` and `EVENTS` in `sceneprint/store/postgres`.
_NUMBER = f"""
CREATE FUNCTION number_pending_events() RETURNS void LANGUAGE plpgsql AS $$
BEGIN
    PERFORM pg_advisory_xact_lock(380542, 8);
    PERFORM set_config('sceneprint.numbering', 'on', true);
    WITH pending AS (DELETE FROM pending_events RETURNING *)
    INSERT INTO events ({_COLUMNS}) SELECT {_COLUMNS} FROM pending ORDER BY number;
    PERFORM set_config('sceneprint.numbering', '', true);
END $$
"""
#: Runs before other events are inserted, so that the events of a map stay in order.
_BEFORE = """
CREATE FUNCTION number_pending_events_first() RETURNS trigger LANGUAGE plpgsql AS $$
BEGIN
    PERFORM number_pending_events();
    RETURN NULL;
END $$
"""
_TRIGGER = """
CREATE TRIGGER number_pending_events_first BEFORE INSERT ON events FOR EACH STATEMENT
WHEN (current_setting('sceneprint.numbering', true) IS DISTINCT FROM 'on')
EXECUTE FUNCTION number_pending_events_first()
"""


def upgrade() -> None:
    """Create the tables, and on PostgreSQL the trigger that numbers pending events."""
    for create in (
        _create_audit,
        _create_doomed,
        _create_events,
        _create_former_maps,
        _create_idempotency,
        _create_keys,
        _create_models,
        _create_pending_events,
        _create_samples,
        _create_schema_range,
        _create_scrubs,
        _create_secrets,
        _create_tenants,
        _create_maps,
        _create_frames,
        _create_parent_joins,
        _create_queries,
        _create_surface_tiles,
        _create_surfaces,
        _create_frame_tags,
        _create_jobs,
        _create_signatures,
        _create_surface_frames,
        _create_surface_touches,
        _create_job_files,
        _create_job_items,
    ):
        create()
    connection = op.get_bind()
    connection.execute(sa.text("INSERT INTO schema_range VALUES (:least)"), {"least": revision})
    connection.execute(
        sa.text("INSERT INTO secrets (name, value) VALUES ('seals', :value)"),
        {"value": secrets.token_bytes(32)},
    )
    if connection.dialect.name == "postgresql":
        for statement in (_NUMBER, _BEFORE, _TRIGGER):
            op.execute(statement)

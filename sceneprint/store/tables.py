"""The tables. `migrations/` makes them; a test holds the two together.

Times are seconds since 1970. `number` orders rows as they came and is never given out twice;
`id` is what the outside knows.
"""

from __future__ import annotations

from sqlalchemy import (
    JSON,
    BigInteger,
    Boolean,
    Column,
    Float,
    ForeignKey,
    Index,
    Integer,
    LargeBinary,
    MetaData,
    String,
    Table,
    Text,
    UniqueConstraint,
)

metadata = MetaData(
    naming_convention={
        "pk": "pk_%(table_name)s",
        "fk": "fk_%(table_name)s_%(column_0_name)s",
        "uq": "uq_%(table_name)s_%(column_0_N_name)s",
        "ix": "ix_%(table_name)s_%(column_0_N_name)s",
    }
)

models = Table(
    "models",
    metadata,
    Column("id", String(64), primary_key=True),
    Column("name", String(64), nullable=False),
    Column("content", LargeBinary, nullable=False),  # the model file: a node needs no other copy
    Column("created_at", Float, nullable=False),
)

maps = Table(
    "maps",
    metadata,
    Column("number", Integer, primary_key=True),
    Column("name", String(63), nullable=False, unique=True),
    Column("title", String(200)),
    Column("model_id", String(64), ForeignKey("models.id"), nullable=False),
    Column("next_model_id", String(64)),  # its frames are being signed with this one as well
    # counts what changes for searching; set on a frame in the commit that indexes or deletes it
    Column("revision", Integer, nullable=False),
    Column("created_at", Float, nullable=False),
    sqlite_autoincrement=True,
)

frames = Table(
    "frames",
    metadata,
    Column("number", Integer, primary_key=True),
    Column("id", String(64), nullable=False),  # one that is deleted may give it up to another
    Column("map_number", Integer, ForeignKey("maps.number"), nullable=False),
    Column("state", String(16), nullable=False),
    Column("reason", Text),
    Column("content_id", String(64)),  # null when deleted: the same frame may come again
    Column("blob", String(64), nullable=False),
    Column("bytes", Integer, nullable=False),
    Column("intrinsics", JSON, nullable=False),  # JSON's null of a cloud
    Column("depth_scale", Float, nullable=False),
    Column("depth_along_ray", Boolean, nullable=False),
    Column("robot", String(128)),
    Column("session", String(128)),
    Column("captured_at", Float),
    Column("tags", JSON, nullable=False),
    Column("pose_parent", String(128)),
    Column("pose", JSON(none_as_null=True)),  # T_parent_sensor, 4 rows of 4
    Column("pose_x", Float),  # its translation, metres, to be searched for
    Column("pose_y", Float),
    Column("pose_z", Float),
    Column("base_frame", String(128)),
    Column("base", JSON(none_as_null=True)),  # T_base_sensor, 4 rows of 4
    Column("novelty", Float),  # kept only if the nearest frame is farther, as a share of d0
    Column("received_at", Float, nullable=False),
    Column("indexed_at", Float),
    Column("revision", Integer),
    Column("cloud", JSON(none_as_null=True)),  # what its points are; null: it is a depth image
    UniqueConstraint("map_number", "id"),
    Index(None, "map_number", "content_id"),
    Index(None, "map_number", "revision"),
    Index(None, "map_number", "number"),
    Index(None, "map_number", "indexed_at"),
    Index(  # all that a filter asks about: rows need not be read for it
        "ix_frames_searched",
        "map_number",
        "state",
        "session",
        "robot",
        "captured_at",
        "pose_parent",
        "pose_x",
        "pose_y",
        "pose_z",
    ),
    Index(None, "blob"),
    sqlite_autoincrement=True,
)

#: `frames.tags` once more, a row each, to be searched for.
frame_tags = Table(
    "frame_tags",
    metadata,
    Column("frame_number", Integer, ForeignKey("frames.number"), primary_key=True),
    Column("tag", String(128), primary_key=True),
    Index(None, "tag", "frame_number"),
)

signatures = Table(
    "signatures",
    metadata,
    Column("frame_number", Integer, ForeignKey("frames.number"), primary_key=True),
    Column("model_id", String(64), ForeignKey("models.id"), primary_key=True),
    Column("vector", LargeBinary, nullable=False),
    Column("checksum", BigInteger, nullable=False),  # CRC-32 of the vector
    Column("geometry", String(64), nullable=False),  # blob of the artifact
    Column("n_patches", JSON, nullable=False),
    Column("n_pairs", JSON, nullable=False),
    Index(None, "geometry"),
)

jobs = Table(
    "jobs",
    metadata,
    Column("number", Integer, primary_key=True),
    Column("id", String(32), nullable=False, unique=True),
    Column("kind", String(16), nullable=False),
    Column("frame_number", Integer, ForeignKey("frames.number")),  # null: of no single frame
    Column("map_number", Integer, ForeignKey("maps.number")),  # null: of no map
    Column("model_id", String(64)),  # to sign with; null: the map's own
    Column("data", JSON(none_as_null=True)),  # what was asked for, by the kind
    Column("progress", JSON(none_as_null=True)),  # done, total, and how the next slice goes on
    Column("result", JSON(none_as_null=True)),  # what came of it, in short
    Column("state", String(16), nullable=False),
    Column("priority", Integer, nullable=False),
    Column("attempts", Integer, nullable=False),
    Column("failures", Integer, nullable=False),  # of the attempts, those that broke down
    Column("token", Integer, nullable=False),  # fencing: grows with every claim
    Column("run_after", Float, nullable=False),
    Column("leased_until", Float),
    Column("worker", String(128)),
    Column("error", Text),
    Column("traceback", Text),
    Column("created_at", Float, nullable=False),
    Column("started_at", Float),
    Column("finished_at", Float),
    Index(None, "state", "run_after"),
    Index(None, "frame_number"),
    Index(None, "map_number", "number"),
    sqlite_autoincrement=True,
)
#: The order in which jobs are claimed.
Index("ix_jobs_claimed", jobs.c.state, jobs.c.priority.desc(), jobs.c.attempts, jobs.c.number)

#: What a long job found, appended slice by slice.
job_items = Table(
    "job_items",
    metadata,
    Column("job_number", Integer, ForeignKey("jobs.number"), primary_key=True),
    Column("number", Integer, primary_key=True),
    Column("data", JSON, nullable=False),
)

#: What a job works on, or made.
job_files = Table(
    "job_files",
    metadata,
    Column("job_number", Integer, ForeignKey("jobs.number"), primary_key=True),
    Column("name", String(64), primary_key=True),
    Column("blob", String(64), nullable=False),
    Column("bytes", BigInteger, nullable=False),
    Column("media_type", String(64), nullable=False),
    Index(None, "blob"),
)

keys = Table(
    "keys",
    metadata,
    Column("id", String(32), primary_key=True),
    Column("name", String(128), nullable=False, unique=True),
    Column("digest", String(64), nullable=False, unique=True),  # SHA-256 of the secret
    Column("grants", JSON, nullable=False),  # scope by name of a map, "*" for all
    Column("created_at", Float, nullable=False),
    Column("expires_at", Float),
)

events = Table(
    "events",
    metadata,
    Column("number", Integer, primary_key=True),
    Column("at", Float, nullable=False),
    Column("kind", String(32), nullable=False),
    Column("map", String(63)),
    Column("frame_id", String(64)),
    Column("job_id", String(32)),
    Column("data", JSON, nullable=False),
    Index(None, "map", "number"),
    sqlite_autoincrement=True,
)

#: What was done under an `Idempotency-Key`, for a day.
idempotency = Table(
    "idempotency",
    metadata,
    Column("actor", String(128), primary_key=True),  # name of the caller's key, or ""
    Column("key", String(255), primary_key=True),
    Column("fingerprint", String(64), nullable=False),  # of route and payload
    Column("data", JSON, nullable=False),  # ids of what was made
    Column("created_at", Float, nullable=False),
    Index(None, "created_at"),
)

#: Who changed what.
audit = Table(
    "audit",
    metadata,
    Column("number", Integer, primary_key=True),
    Column("at", Float, nullable=False),
    Column("actor", String(128), nullable=False),
    Column("address", String(64)),
    Column("action", String(64), nullable=False),
    Column("map", String(63)),
    Column("target", String(128)),
    Column("request_id", String(64)),
    Column("data", JSON, nullable=False),
    sqlite_autoincrement=True,
)

#: Figures of processes, a few times a minute, for an hour or two.
samples = Table(
    "samples",
    metadata,
    Column("number", Integer, primary_key=True),
    Column("at", Float, nullable=False),
    Column("process", String(128), nullable=False),
    Column("kind", String(16), nullable=False),
    Column("data", JSON, nullable=False),
    Index(None, "kind", "at"),
    sqlite_autoincrement=True,
)

#: Made with the database, and never told: see `seals`.
secrets = Table(
    "secrets",
    metadata,
    Column("name", String(32), primary_key=True),
    Column("value", LargeBinary, nullable=False),
)

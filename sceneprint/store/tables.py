"""The tables, and what their rows are in Python. `migrations/` makes them; a test holds the two
together.

Times are seconds since 1970. `number` orders rows as they came and is never given out twice;
`id` is what the outside knows.
"""

from __future__ import annotations

import time
import uuid
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, fields
from itertools import islice
from typing import Any

from sqlalchemy import (
    ARRAY,
    JSON,
    BigInteger,
    Boolean,
    Column,
    ColumnElement,
    Connection,
    Float,
    ForeignKey,
    Index,
    Integer,
    LargeBinary,
    MetaData,
    Row,
    RowMapping,
    Select,
    String,
    Table,
    Text,
    UniqueConstraint,
    any_,
    bindparam,
    cast,
    extract,
    func,
    literal,
    literal_column,
    select,
)
from sqlalchemy.types import TypeEngine

from sceneprint.process import current_actor, current_tenant, request_id
from sceneprint_client.api import FrameState, JobState
from sceneprint_client.api.frames import Kind

#: Numbers: SQLite's have 64 bits anyway, and only what it calls INTEGER numbers rows there.
WHOLE = BigInteger().with_variant(Integer, "sqlite")
#: Texts in the order of their code points, as in SQLite, whatever the server's language is.
TEXT = Text().with_variant(Text(collation="C"), "postgresql")


def _string(length: int) -> TypeEngine[str]:
    return String(length).with_variant(String(length, collation="C"), "postgresql")


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
    Column("id", _string(64), primary_key=True),
    Column("name", _string(64), nullable=False),
    Column("content", LargeBinary, nullable=False),  # the model file: a node needs no other copy
    Column("created_at", Float, nullable=False),
)

maps = Table(
    "maps",
    metadata,
    Column("number", WHOLE, primary_key=True),
    Column("name", _string(63), nullable=False, unique=True),
    Column("title", _string(200)),
    Column("model_id", _string(64), ForeignKey("models.id"), nullable=False),
    Column("next_model_id", _string(64)),  # its frames are being signed with this one as well
    # counts what changes for searching; set on a frame in the commit that indexes or deletes it
    Column("revision", WHOLE, nullable=False),
    Column("created_at", Float, nullable=False),
    Column("quota_frames", BigInteger),  # null: as many frames as there is room for
    Column("quota_bytes", BigInteger),  # of their uploads
    Column("retention_days", Float),  # after which a frame is deleted; null: never
    # what it holds: frames that are neither deleted nor redundant, and bytes of their uploads
    Column("used_frames", BigInteger, nullable=False, server_default="0"),
    Column("used_bytes", BigInteger, nullable=False, server_default="0"),
    Column("up", JSON(none_as_null=True)),  # unit vector in the parent frames; null: learnt
    # greatest revision of a deleted frame whose row is gone: who stands before it must begin anew
    Column("pruned_revision", WHOLE, nullable=False, server_default="0"),
    sqlite_autoincrement=True,
)

frames = Table(
    "frames",
    metadata,
    Column("number", WHOLE, primary_key=True),
    Column("id", _string(64), nullable=False),  # one that is deleted may give it up to another
    Column("map_number", WHOLE, ForeignKey("maps.number"), nullable=False),
    Column("state", _string(16), nullable=False),
    Column("reason", TEXT),
    Column("content_id", _string(64)),  # null when deleted: the same frame may come again
    Column("blob", _string(64), nullable=False),
    Column("bytes", WHOLE, nullable=False),
    Column("intrinsics", JSON, nullable=False),  # JSON's null of a cloud
    Column("depth_scale", Float, nullable=False),
    Column("depth_along_ray", Boolean, nullable=False),
    Column("robot", _string(128)),
    Column("session", _string(128)),
    Column("captured_at", Float),
    Column("tags", JSON, nullable=False),
    Column("pose_parent", _string(128)),
    Column("pose", JSON(none_as_null=True)),  # T_parent_sensor, 4 rows of 4
    Column("pose_x", Float),  # its translation, metres, to be searched for
    Column("pose_y", Float),
    Column("pose_z", Float),
    # where a join moved the pose: its parent frame and its matrix as they were sent
    Column("sent_parent", _string(128)),
    Column("sent_pose", JSON(none_as_null=True)),
    Column("base_frame", _string(128)),
    Column("base", JSON(none_as_null=True)),  # T_base_sensor, 4 rows of 4
    Column("novelty", Float),  # kept only if the nearest frame is farther, as a share of d0
    Column("received_at", Float, nullable=False),
    Column("indexed_at", Float),
    Column("revision", WHOLE),
    Column("cloud", JSON(none_as_null=True)),  # what its points are; null: it is a depth image
    Column("up", JSON(none_as_null=True)),  # unit vector in the sensor's axes
    Column("name", _string(255)),  # of the original file or message; a label, never a path
    Column("sequence", WHOLE),  # place within the session
    Column("samples", JSON(none_as_null=True)),  # how far away they are, and whether trusted
    Column("ended_at", Float),  # when it was deleted, or found redundant
    # of a tombstone, a deleted frame that can be restored: the first revision of its deletion
    Column("deletion", WHOLE),
    Column("deleted_from", _string(16)),  # its state before; null: another frame has its id now
    Column("deleted_content", _string(64)),  # its content_id before
    UniqueConstraint("map_number", "id"),
    Index(None, "map_number", "content_id"),
    Index(None, "map_number", "revision"),
    Index(None, "map_number", "number"),
    Index(  # all that a filter asks about: rows need not be read for it
        "ix_frames_searched",
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
    ),
    Index(None, "blob"),
    Index("ix_frames_named", "map_number", "name", "state", "session", "robot"),
    Index("ix_frames_placed", "map_number", "pose_parent", "pose_x", "pose_y", "pose_z"),
    sqlite_autoincrement=True,
)
#: Tombstones of a map, the oldest deletions first.
Index(
    "ix_frames_tombstones", frames.c.map_number, frames.c.deletion, frames.c.number,
    sqlite_where=frames.c.deletion.is_not(None), postgresql_where=frames.c.deletion.is_not(None),
)  # fmt: skip
#: The oldest frames of a map that are still there: rows of deleted ones stay for some days.
Index(
    "ix_frames_aging", frames.c.map_number, frames.c.received_at,
    sqlite_where=frames.c.state != "deleted", postgresql_where=frames.c.state != "deleted",
)  # fmt: skip

#: Frames whose rows go in the end. As the index says it: of values that are bound to a statement no
#: planner knows that they are these.
ENDED: ColumnElement[bool] = frames.c.state.in_(
    [literal_column("'deleted'"), literal_column("'redundant'")]
)
Index(
    "ix_frames_ended", frames.c.map_number, frames.c.state, frames.c.ended_at,
    sqlite_where=ENDED, postgresql_where=ENDED,
)  # fmt: skip

#: Joins of parent frames: poses sent in `parent` are stored in the root that its joins lead to.
parent_joins = Table(
    "parent_joins",
    metadata,
    Column("map_number", WHOLE, ForeignKey("maps.number"), primary_key=True),
    Column("parent", _string(128), primary_key=True),
    Column("towards", _string(128), primary_key=True),  # a root then, and joined itself by now
    Column("transform", JSON, nullable=False),  # T_towards_parent, 4 rows of 4
    Column("job_id", _string(32), nullable=False),  # association that found it
    Column("joined_at", Float, nullable=False),
    Column("undone_at", Float),  # null: it stands, and no other that stands leads from `parent`
)

#: `frames.tags` once more, a row each, to be searched for.
frame_tags = Table(
    "frame_tags",
    metadata,
    Column("frame_number", WHOLE, ForeignKey("frames.number"), primary_key=True),
    Column("tag", _string(128), primary_key=True),
    Index(None, "tag", "frame_number"),
)

signatures = Table(
    "signatures",
    metadata,
    Column("frame_number", WHOLE, ForeignKey("frames.number"), primary_key=True),
    Column("model_id", _string(64), ForeignKey("models.id"), primary_key=True),
    Column("vector", LargeBinary, nullable=False),
    Column("checksum", BigInteger, nullable=False),  # CRC-32 of the vector
    Column("geometry", _string(64), nullable=False),  # blob of the artifact
    Column("n_patches", JSON, nullable=False),
    Column("n_pairs", JSON, nullable=False),
    Index(None, "geometry"),
)

jobs = Table(
    "jobs",
    metadata,
    Column("number", WHOLE, primary_key=True),
    Column("id", _string(32), nullable=False, unique=True),
    Column("kind", _string(16), nullable=False),
    Column("frame_number", WHOLE, ForeignKey("frames.number")),  # null: of no single frame
    Column("map_number", WHOLE, ForeignKey("maps.number")),  # null: of no map
    Column("model_id", _string(64)),  # to sign with; null: the map's own
    Column("data", JSON(none_as_null=True)),  # what was asked for, by the kind
    Column("progress", JSON(none_as_null=True)),  # done, total, and how the next slice goes on
    Column("result", JSON(none_as_null=True)),  # what came of it, in short
    Column("state", _string(16), nullable=False),
    Column("priority", WHOLE, nullable=False),
    Column("attempts", WHOLE, nullable=False),
    Column("failures", WHOLE, nullable=False),  # of the attempts, those that broke down
    Column("token", WHOLE, nullable=False),  # fencing: grows with every claim
    Column("run_after", Float, nullable=False),
    Column("leased_until", Float),
    Column("worker", _string(128)),
    Column("error", TEXT),
    Column("traceback", TEXT),
    Column("created_at", Float, nullable=False),
    Column("started_at", Float),
    Column("finished_at", Float),
    Column("tenant", _string(128), nullable=False, server_default=""),  # who asked; "": nobody
    Column("turn", WHOLE),  # number of its latest claim: each is greater than those before
    Index(None, "state", "run_after"),
    Index(None, "frame_number"),
    Index(None, "map_number", "number"),
    Index(None, "turn"),
    Index(None, "tenant", "turn"),
    sqlite_autoincrement=True,
)
#: The order in which the jobs of a tenant are claimed.
Index(
    "ix_jobs_claimed", jobs.c.state, jobs.c.tenant, jobs.c.priority.desc(), jobs.c.attempts,
    jobs.c.number,
)  # fmt: skip

#: What a long job found, appended slice by slice.
job_items = Table(
    "job_items",
    metadata,
    Column("job_number", WHOLE, ForeignKey("jobs.number"), primary_key=True),
    Column("number", WHOLE, primary_key=True),
    Column("data", JSON, nullable=False),
)

#: What a job works on, or made.
job_files = Table(
    "job_files",
    metadata,
    Column("job_number", WHOLE, ForeignKey("jobs.number"), primary_key=True),
    Column("name", _string(64), primary_key=True),
    Column("blob", _string(64), nullable=False),
    Column("bytes", BigInteger, nullable=False),
    Column("media_type", _string(64), nullable=False),
    Index(None, "blob"),
)

#: Name of the file of an import that is its archive; it counts against the quota of the map.
ARCHIVE = "archive"

keys = Table(
    "keys",
    metadata,
    Column("id", _string(32), primary_key=True),
    Column("name", _string(128), nullable=False, unique=True),
    Column("digest", _string(64), nullable=False, unique=True),  # SHA-256 of the secret
    Column("grants", JSON, nullable=False),  # scope by name of a map, "*" for all
    Column("created_at", Float, nullable=False),
    Column("expires_at", Float),
    Column("tenant", _string(128), nullable=False, server_default=""),
    # of the secret before the last rotation, which works until then
    Column("previous_digest", _string(64), index=True),
    Column("previous_until", Float),
    Column("last_used_at", Float),
    Index(None, "tenant"),
)

#: Who pays: keys belong to tenants.
tenants = Table(
    "tenants",
    metadata,
    Column("name", _string(128), primary_key=True),
    Column("created_at", Float, nullable=False),
    Column("turn", WHOLE, nullable=False, server_default="0"),  # the latest of jobs removed since
)

events = Table(
    "events",
    metadata,
    Column("number", WHOLE, primary_key=True),
    Column("at", Float, nullable=False),
    Column("kind", _string(32), nullable=False),
    Column("map", _string(63)),
    Column("frame_id", _string(64)),
    Column("job_id", _string(32)),
    Column("data", JSON, nullable=False),
    Index(None, "map", "number"),
    sqlite_autoincrement=True,
)
#: Where the events of a former map of a name end.
Index(
    "ix_events_map_number_deleted", events.c.map, events.c.number,
    sqlite_where=events.c.kind == "map.deleted", postgresql_where=events.c.kind == "map.deleted",
)  # fmt: skip

#: Events of writers of single maps of PostgreSQL, which commit in any order: `number_events` moves
#: them into `events`, with numbers in the order of commits.
pending_events = Table(
    "pending_events",
    metadata,
    Column("number", WHOLE, primary_key=True),
    Column("at", Float, nullable=False),
    Column("kind", _string(32), nullable=False),
    Column("map", _string(63)),
    Column("frame_id", _string(64)),
    Column("job_id", _string(32)),
    Column("data", JSON, nullable=False),
    sqlite_autoincrement=True,
)

#: What was done under an `Idempotency-Key`, for a day.
idempotency = Table(
    "idempotency",
    metadata,
    Column("actor", _string(128), primary_key=True),  # name of the caller's key, or ""
    Column("key", _string(255), primary_key=True),
    Column("fingerprint", _string(64), nullable=False),  # of route and payload
    Column("data", JSON, nullable=False),  # ids of what was made
    Column("created_at", Float, nullable=False),
    Index(None, "created_at"),
)

#: Who changed what, a line for each change; append-only.
audit = Table(
    "audit",
    metadata,
    Column("number", WHOLE, primary_key=True),
    Column("at", Float, nullable=False),
    Column("actor", _string(128), nullable=False),  # name of the key; "" where none is required
    Column("address", _string(64)),
    Column("tenant", _string(128), nullable=False),
    Column("action", _string(32), nullable=False),
    Column("map", _string(63)),
    Column("target", _string(128)),
    Column("request_id", _string(64)),
    Column("data", JSON, nullable=False),
    Index(None, "tenant", "number"),
    sqlite_autoincrement=True,
)

#: One row: the oldest revision whose processes may write to this schema.
schema_range = Table(
    "schema_range",
    metadata,
    Column("least_revision", _string(32), primary_key=True),
)

#: One row: how far stored bytes have been read to see that they are sound.
scrubs = Table(
    "scrubs",
    metadata,
    Column("number", WHOLE, primary_key=True, autoincrement=False),
    Column("position", WHOLE, nullable=False),  # number of the last frame that was read
    Column("next_at", Float, nullable=False),  # when somebody may go on, by the database's clock
    Column("began_at", Float, nullable=False),  # of this pass
    Column("finished_at", Float),  # the last whole pass; null: there was none
    Column("blobs", BigInteger, nullable=False),  # these and the next: of this pass, or the last
    Column("bytes", BigInteger, nullable=False),
    Column("damaged", BigInteger, nullable=False),
)

#: Figures of processes, a few times a minute, for an hour or two.
samples = Table(
    "samples",
    metadata,
    Column("number", WHOLE, primary_key=True),
    Column("at", Float, nullable=False),
    Column("process", _string(128), nullable=False),
    Column("kind", _string(16), nullable=False),
    Column("data", JSON, nullable=False),
    Index(None, "kind", "at"),
    sqlite_autoincrement=True,
)

#: Names of maps that are gone: the last event of each, and the quota that the next one inherits.
former_maps = Table(
    "former_maps",
    metadata,
    Column("name", _string(63), primary_key=True),
    Column("number", BigInteger, nullable=False),  # of the event
    Column("quota_frames", BigInteger),
    Column("quota_bytes", BigInteger),
    Index(None, "number"),
)

#: Queries and their outcomes, for some time, and their answers while there is room.
queries = Table(
    "queries",
    metadata,
    Column("number", WHOLE, primary_key=True),
    Column("id", _string(32), nullable=False, unique=True),  # of the answer
    Column("at", Float, nullable=False),  # when the query came
    Column("map_number", WHOLE, ForeignKey("maps.number"), nullable=False),
    Column("maps", JSON(none_as_null=True)),  # names of all maps searched; null: this one alone
    Column("robot", _string(128)),
    Column("session", _string(128)),
    Column("key_id", _string(32)),  # of the key that the request came with
    Column("status", _string(16), nullable=False),
    Column("cause", _string(64)),
    Column("reason", TEXT, nullable=False),
    Column("pose_parent", _string(128)),
    Column("pose", JSON(none_as_null=True)),  # T_parent_query: x, y, z, qx, qy, qz, qw
    Column("confidence", Float),
    Column("support", WHOLE),
    Column("alternatives", WHOLE, nullable=False),
    Column("milliseconds", Float, nullable=False),
    Column("kind", _string(8)),
    Column("frame_map", _string(63)),  # the stored frame that was the query
    Column("frame_id", _string(64)),
    Column("listed", Boolean, nullable=False),  # false: stored only to look at its answer
    Column("kept_at", Float),  # since when the answer is kept; null: it expires
    Column("title", _string(200)),  # of a kept answer
    Column("shown", JSON(none_as_null=True)),  # numbers of the frames that the answer shows
    Column("bytes", BigInteger, nullable=False),  # of the answer; 0: it is not stored
    Column("answer", LargeBinary),  # of a kept one; others are files, see `answer_files`
    Index(None, "at", "number"),
    Index(None, "map_number", "at", "number"),
    Index(None, "map_number", "status", "at", "number"),
    Index(None, "robot", "at", "number"),
    sqlite_autoincrement=True,
)
#: Stored answers by age, and kept ones: few among many rows.
Index(
    "ix_queries_stored", queries.c.at, queries.c.number, queries.c.bytes,
    sqlite_where=literal_column("bytes > 0"), postgresql_where=literal_column("bytes > 0"),
)  # fmt: skip
Index(
    "ix_queries_kept", queries.c.map_number, queries.c.at, queries.c.number,
    sqlite_where=literal_column("kept_at IS NOT NULL"),
    postgresql_where=literal_column("kept_at IS NOT NULL"),
)  # fmt: skip

#: The fused surface of a map: where its making stands.
surfaces = Table(
    "surfaces",
    metadata,
    Column("map_number", WHOLE, ForeignKey("maps.number"), primary_key=True),
    Column("model_id", _string(64), nullable=False),  # whose artifacts are fused
    Column("cell_m", Float, nullable=False),  # of the finest level
    Column("wanted", Boolean, nullable=False),  # false: it was deleted, and nobody asked again
    Column("job_number", WHOLE),  # of its latest job, which may have been removed since
    # revision and edits of the map up to which nothing is left to do
    Column("revision", WHOLE, nullable=False),
    Column("edits", WHOLE, nullable=False),
    Column("pose_edits", WHOLE, nullable=False),  # counts edits of what is fused
    # of times in the tiles that are given out; `scale` counts how often it was changed
    Column("scale", WHOLE, nullable=False),
    Column("taken_from", Float),
    Column("taken_step_s", Float, nullable=False),
    Column("first_taken", Float),
    Column("last_taken", Float),
    Column("sessions", JSON, nullable=False),
    Column("parents", JSON, nullable=False),  # those of most frames: name, frames, up, axes
    Column("updated_at", Float),
)

#: Tiles of surfaces.
surface_tiles = Table(
    "surface_tiles",
    metadata,
    Column("number", WHOLE, primary_key=True),
    Column("map_number", WHOLE, ForeignKey("maps.number"), nullable=False),
    Column("parent", _string(128), nullable=False),
    Column("level", WHOLE, nullable=False),
    Column("tile_x", WHOLE, nullable=False),
    Column("tile_y", WHOLE, nullable=False),
    Column("tile_z", WHOLE, nullable=False),
    Column("cells", WHOLE, nullable=False),
    Column("blob", _string(64)),  # sums of the finest level, cells of the others; null: none yet
    Column("digest", _string(64), nullable=False),  # of the cells, as the outside knows them
    Column("scale", WHOLE, nullable=False),  # by which its times are told
    # of a tile that is made anew: the last frame in `draft`, 0 at first; null: it is up to date
    Column("rebuilt_to", WHOLE),
    Column("draft", _string(64)),
    Column("low_x", Float, nullable=False),  # box of its cells, metres
    Column("low_y", Float, nullable=False),
    Column("low_z", Float, nullable=False),
    Column("high_x", Float, nullable=False),
    Column("high_y", Float, nullable=False),
    Column("high_z", Float, nullable=False),
    UniqueConstraint(
        "map_number", "parent", "level", "tile_x", "tile_y", "tile_z", name="uq_surface_tiles_place"
    ),
    Index(None, "blob"),
    Index(None, "draft"),
    Index(None, "map_number", "digest"),
    Index(None, "map_number", "rebuilt_to"),
    sqlite_autoincrement=True,
)

#: Frames that are fused.
surface_frames = Table(
    "surface_frames",
    metadata,
    Column("frame_number", WHOLE, ForeignKey("frames.number"), primary_key=True),
    Column("map_number", WHOLE, ForeignKey("maps.number"), nullable=False),
    Column("parent", _string(128), nullable=False),
    Column("changed", Boolean, nullable=False),  # edited since: to be taken out, and fused anew
    Index(None, "map_number", "parent", "changed"),
)

#: Which tiles of the finest level they are fused into.
surface_touches = Table(
    "surface_touches",
    metadata,
    Column("tile_number", WHOLE, ForeignKey("surface_tiles.number"), primary_key=True),
    Column("frame_number", WHOLE, ForeignKey("frames.number"), primary_key=True),
    Index(None, "frame_number"),
)

#: Blobs of what was deleted, until somebody has seen that they are removed.
doomed = Table(
    "doomed",
    metadata,
    Column("blob", _string(64), primary_key=True),
    Column("at", Float, nullable=False),
)

#: Made with the database, and never told: see `opaque_ids`.
secrets = Table(
    "secrets",
    metadata,
    Column("name", _string(32), primary_key=True),
    Column("value", LargeBinary, nullable=False),
)


# Asking for rows: how many there are, and those of many numbers.

#: Numbers in one list: SQLite takes 32,766 values.
MOST_ROWS = 10_000


def count_rows(connection: Connection, *conditions: ColumnElement[bool]) -> int:
    """How many rows of a table meet some conditions."""
    return int(connection.execute(select(func.count()).where(*conditions)).scalar_one())


def blocks(numbers: Iterable[int]) -> Iterator[list[int]]:
    """The numbers, at most `MOST_ROWS` at a time; no list where there are none."""
    left = iter(numbers)
    while block := list(islice(left, MOST_ROWS)):
        yield block


def among(
    connection: Connection, column: Column[int], numbers: Sequence[int]
) -> ColumnElement[bool]:
    """That a number is one of a block; for PostgreSQL they are one value, however many they are.

    As 10,000 values of a statement they would take ten times as long to be read.
    """
    if connection.dialect.name == "postgresql":
        return column == any_(literal(list(numbers), ARRAY(BigInteger)))
    return column.in_(numbers)


def rows_among(
    connection: Connection, asked: Select[Any], column: Column[int], numbers: Iterable[int]
) -> Iterator[Any]:
    """Rows that a statement finds where a column is one of some numbers, however many."""
    for some in blocks(numbers):
        yield from connection.execute(asked.where(among(connection, column, some)))


def rows_of_statement(
    connection: Connection, statement: Callable[[str], Select[Any]], numbers: Iterable[int],
    **values: object,
) -> Iterator[Any]:  # fmt: skip
    """As `rows_among`, by a statement that is built once.

    Parameters
    ----------
    statement : makes it for a dialect, with `among_numbers`, and returns the same one each time
    numbers : however many
    values : its other parameters
    """
    asked = statement(connection.dialect.name)
    for some in blocks(numbers):
        yield from connection.execute(asked, {"numbers": some, **values})


def among_numbers(dialect: str, column: Column[int]) -> ColumnElement[bool]:
    """As `among`, for the parameter `numbers` of a statement that is executed more than once."""
    if dialect == "postgresql":
        return column == any_(bindparam("numbers", type_=ARRAY(BigInteger)))
    return column.in_(bindparam("numbers", expanding=True))


# Rows as the rest of the package sees them.


@dataclass(frozen=True)
class MapRow:
    """A map; fields as in the table."""

    number: int
    name: str
    title: str | None
    model_id: str
    next_model_id: str | None
    revision: int
    created_at: float
    quota_frames: int | None = None
    quota_bytes: int | None = None
    retention_days: float | None = None
    used_frames: int = 0
    used_bytes: int = 0
    up: list[float] | None = None
    pruned_revision: int = 0


@dataclass(frozen=True)
class FrameRow:
    """A frame; fields as in the table."""

    number: int
    id: str
    map_number: int
    state: FrameState
    reason: str | None
    content_id: str | None
    blob: str
    bytes: int
    intrinsics: dict[str, Any] | None
    depth_scale: float
    depth_along_ray: bool
    robot: str | None
    session: str | None
    captured_at: float | None
    tags: list[str]
    pose_parent: str | None
    pose: list[list[float]] | None
    pose_x: float | None
    pose_y: float | None
    pose_z: float | None
    base_frame: str | None
    base: list[list[float]] | None
    novelty: float | None
    received_at: float
    indexed_at: float | None
    revision: int | None
    cloud: dict[str, Any] | None
    up: list[float] | None = None
    name: str | None = None
    sequence: int | None = None
    samples: dict[str, Any] | None = None
    ended_at: float | None = None
    deletion: int | None = None
    deleted_from: FrameState | None = None
    deleted_content: str | None = None
    sent_parent: str | None = None
    sent_pose: list[list[float]] | None = None

    @property
    def kind(self) -> Kind:
        """A depth image or a point cloud."""
        return "depth" if self.cloud is None else "cloud"


@dataclass(frozen=True)
class JobRow:
    """A job; fields as in the table."""

    number: int
    id: str
    kind: str
    frame_number: int | None
    map_number: int | None
    model_id: str | None
    data: dict[str, Any] | None
    progress: dict[str, Any] | None
    result: dict[str, Any] | None
    state: JobState
    priority: int
    attempts: int
    failures: int
    token: int
    run_after: float
    leased_until: float | None
    worker: str | None
    error: str | None
    traceback: str | None
    created_at: float
    started_at: float | None
    finished_at: float | None
    tenant: str
    turn: int | None

    @property
    def frame(self) -> int:
        """Number of the frame that a job of a single frame is about."""
        if self.frame_number is None:
            raise ValueError(f"job {self.id} of kind {self.kind} is of no single frame")
        return self.frame_number


def map_row(row: RowMapping) -> MapRow:
    """A row of the table `maps`."""
    return MapRow(**row)


def frame_row(row: RowMapping) -> FrameRow:
    """A row of the table `frames`."""
    return FrameRow(**{**row, "state": FrameState(row["state"])})


def frame_rows(found: Iterable[Row[Any]]) -> list[FrameRow]:
    """Rows of `FRAME_COLUMNS`; by their places, which costs a third of `frame_row`."""
    rows = []
    for row in found:
        values = list(row)
        values[_FRAME_STATE] = FrameState(values[_FRAME_STATE])
        rows.append(FrameRow(*values))
    return rows


def job_row(row: RowMapping) -> JobRow:
    """A row of the table `jobs`."""
    return JobRow(**{**row, "state": JobState(row["state"])})


def job_of_columns(row: Sequence[Any]) -> JobRow:
    """A row that begins with `JOB_COLUMNS`."""
    values = list(row[: len(JOB_COLUMNS)])
    values[_JOB_STATE] = JobState(values[_JOB_STATE])
    return JobRow(*values)


#: Columns of `maps`, `frames` and `jobs` in the order of the fields of their rows.
MAP_COLUMNS = tuple(maps.c[one.name] for one in fields(MapRow))
FRAME_COLUMNS = tuple(frames.c[one.name] for one in fields(FrameRow))
JOB_COLUMNS = tuple(jobs.c[one.name] for one in fields(JobRow))
_FRAME_STATE = [column.name for column in FRAME_COLUMNS].index("state")
_JOB_STATE = [column.name for column in JOB_COLUMNS].index("state")


# The clock by which leases end and jobs are due: of the database, as those of its hosts differ.
#
# A SQLite file has one host, and so one clock.


#: Seconds since 1970 at a statement of PostgreSQL: the transaction may have waited for its turn
#: since it began. Not clock_timestamp(), which is another time for each row, so that no index would
#: be used.
STATEMENT_TIME: ColumnElement[float] = cast(extract("epoch", func.statement_timestamp()), Float(53))


def now(connection: Connection) -> ColumnElement[float]:
    """The time of the statement it is part of, seconds since 1970."""
    if connection.dialect.name == "sqlite":
        return literal(time.time())
    return STATEMENT_TIME


def job_values(
    connection: Connection, kind: str, priority: int, model_id: str | None = None,
    data: dict[str, Any] | None = None,
) -> dict[str, Any]:  # fmt: skip
    """Columns of a job that is queued now, but for what it is about: see `enqueue`."""
    made = now(connection)
    if data is None:
        data = request_data()
    return {
        "id": uuid.uuid4().hex, "kind": kind, "model_id": model_id, "data": data,
        "state": JobState.QUEUED, "priority": priority, "attempts": 0, "failures": 0, "token": 0,
        "run_after": made, "created_at": made, "tenant": current_tenant(),
    }  # fmt: skip


def request_data() -> dict[str, Any] | None:
    """Return what a job keeps of the request that queues it; None outside of one."""
    if request_id() is None:
        return None
    return {"request_id": request_id()}  # the worker's log lines name it


def audit_values(
    action: str, map_name: str | None, target: str | None, data: dict[str, Any]
) -> dict[str, Any] | None:
    """Return the columns of a line of the audit log for a change by the current actor.

    None of a worker: what it carries out has a line from when it was requested.
    """
    actor = current_actor()
    if actor is None:
        return None
    return {
        "at": time.time(), "actor": actor.name, "address": actor.address,
        "tenant": current_tenant(), "action": action, "map": map_name, "target": target,
        "request_id": request_id(), "data": data,
    }  # fmt: skip


def event_values(
    kind: str, map_name: str | None, frame_id: str | None, job_id: str | None, data: dict[str, Any]
) -> dict[str, Any]:
    """Columns of an event that happens now."""
    return {
        "at": time.time(), "kind": kind, "map": map_name, "frame_id": frame_id, "job_id": job_id,
        "data": data,
    }  # fmt: skip

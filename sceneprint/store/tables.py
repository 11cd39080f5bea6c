"""Tables of the database, and classes of their rows. `create_schema` in `database` creates them.

Times are seconds since 1970. Values of `number` are in the order of insertion and never reused;
`id` is public.
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
from sqlalchemy.dialects import postgresql, sqlite
from sqlalchemy.types import TypeEngine

from sceneprint.process import current_actor, current_tenant, request_id
from sceneprint_client.api import FrameState, JobState
from sceneprint_client.api.frames import Kind

#: Type of 64-bit integers. In SQLite, all integers have 64 bits; only INTEGER autoincrements.
WHOLE = BigInteger().with_variant(Integer, "sqlite")
#: Type of texts sorted by code points, as in SQLite, independent of the locale of the server.
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
    Column("content", LargeBinary, nullable=False),  # the model file
    Column("created_at", Float, nullable=False),
)

maps = Table(
    "maps",
    metadata,
    Column("number", WHOLE, primary_key=True),
    Column("name", _string(63), nullable=False, unique=True),
    Column("title", _string(200)),
    Column("model_id", _string(64), ForeignKey("models.id"), nullable=False),
    Column("next_model_id", _string(64)),  # next model during a re-encoding
    # number of changes to the searched frames; indexed and deleted frames get the current value
    Column("revision", WHOLE, nullable=False),
    Column("created_at", Float, nullable=False),
    Column("quota_frames", BigInteger),  # null: unlimited
    Column("quota_bytes", BigInteger),  # maximum bytes of uploads
    Column("retention_days", Float),  # age at which frames are deleted; null: never
    # usage: frames that are neither deleted nor redundant, and bytes of their uploads
    Column("used_frames", BigInteger, nullable=False, server_default="0"),
    Column("used_bytes", BigInteger, nullable=False, server_default="0"),
    Column("up", JSON(none_as_null=True)),  # unit vector in the parent frames; null: estimated
    # greatest revision of a removed row; readers at earlier revisions must restart
    Column("pruned_revision", WHOLE, nullable=False, server_default="0"),
    sqlite_autoincrement=True,
)

frames = Table(
    "frames",
    metadata,
    Column("number", WHOLE, primary_key=True),
    Column("id", _string(64), nullable=False),  # ids of deleted frames can be reused
    Column("map_number", WHOLE, ForeignKey("maps.number"), nullable=False),
    Column("state", _string(16), nullable=False),
    Column("reason", TEXT),
    Column("content_id", _string(64)),  # null if deleted, so that the content can be uploaded again
    Column("blob", _string(64), nullable=False),
    Column("bytes", WHOLE, nullable=False),
    Column("intrinsics", JSON, nullable=False),  # JSON null for a cloud
    Column("depth_scale", Float, nullable=False),
    Column("depth_along_ray", Boolean, nullable=False),
    Column("robot", _string(128)),
    Column("session", _string(128)),
    Column("captured_at", Float),
    Column("tags", JSON, nullable=False),
    Column("pose_parent", _string(128)),
    Column("pose", JSON(none_as_null=True)),  # T_parent_sensor, 4 rows of 4
    Column("pose_x", Float),  # translation of the pose, metres
    Column("pose_y", Float),
    Column("pose_z", Float),
    # parent frame and pose as uploaded, if a join transformed the pose
    Column("sent_parent", _string(128)),
    Column("sent_pose", JSON(none_as_null=True)),
    Column("base_frame", _string(128)),
    Column("base", JSON(none_as_null=True)),  # T_base_sensor, 4 rows of 4
    Column("novelty", Float),  # minimum distance from the nearest frame, as a share of d0
    Column("received_at", Float, nullable=False),
    Column("indexed_at", Float),
    Column("revision", WHOLE),
    Column("cloud", JSON(none_as_null=True)),  # description of the points; null: a depth image
    Column("up", JSON(none_as_null=True)),  # unit vector in the sensor frame
    Column("name", _string(255)),  # name of the original file or message; never used as a path
    Column("sequence", WHOLE),  # position within the session
    Column("samples", JSON(none_as_null=True)),  # ranges of the samples, and `trust_depth`
    Column("ended_at", Float),  # time at which the frame was deleted or found redundant
    # first revision of the deletion, if the frame can be restored (tombstone)
    Column("deletion", WHOLE),
    Column("deleted_from", _string(16)),  # former state; null if another frame uses the id now
    Column("deleted_content", _string(64)),  # former content_id
    UniqueConstraint("map_number", "id"),
    Index(None, "map_number", "content_id"),
    Index(None, "map_number", "revision"),
    Index(None, "map_number", "number"),
    Index(  # covering index for filters
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
#: Tombstones of a map, oldest deletions first.
Index(
    "ix_frames_tombstones", frames.c.map_number, frames.c.deletion, frames.c.number,
    sqlite_where=frames.c.deletion.is_not(None), postgresql_where=frames.c.deletion.is_not(None),
)  # fmt: skip
#: Existing frames of a map, oldest first.
Index(
    "ix_frames_aging", frames.c.map_number, frames.c.received_at,
    sqlite_where=frames.c.state != "deleted", postgresql_where=frames.c.state != "deleted",
)  # fmt: skip

#: Condition for frames whose rows are removed after some days, with literal values: planners do not
#: match bound values to a partial index.
ENDED: ColumnElement[bool] = frames.c.state.in_(
    [literal_column("'deleted'"), literal_column("'redundant'")]
)
Index(
    "ix_frames_ended", frames.c.map_number, frames.c.state, frames.c.ended_at,
    sqlite_where=ENDED, postgresql_where=ENDED,
)  # fmt: skip

#: Joins of parent frames; see `parent_joins`.
parent_joins = Table(
    "parent_joins",
    metadata,
    Column("map_number", WHOLE, ForeignKey("maps.number"), primary_key=True),
    Column("parent", _string(128), primary_key=True),
    Column("towards", _string(128), primary_key=True),  # root at the time of the join
    Column("transform", JSON, nullable=False),  # T_towards_parent, 4 rows of 4
    Column("job_id", _string(32), nullable=False),  # association that found the join
    Column("joined_at", Float, nullable=False),
    Column("undone_at", Float),  # null: the join is in effect; at most one per `parent`
)

#: Values of `frames.tags` as rows for searches.
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
    Column("geometry", _string(64), nullable=False),  # blob of the geometry artifact
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
    Column("frame_number", WHOLE, ForeignKey("frames.number")),  # null for long jobs
    Column("map_number", WHOLE, ForeignKey("maps.number")),  # null for jobs without a map
    Column("model_id", _string(64)),  # model to sign with; null: model of the map
    Column("data", JSON(none_as_null=True)),  # parameters, by kind
    Column("progress", JSON(none_as_null=True)),  # done, total, and state for the next slice
    Column("result", JSON(none_as_null=True)),  # summary of the results
    Column("state", _string(16), nullable=False),
    Column("priority", WHOLE, nullable=False),
    Column("attempts", WHOLE, nullable=False),
    Column("failures", WHOLE, nullable=False),  # number of failed attempts
    Column("token", WHOLE, nullable=False),  # fencing token, incremented by each claim
    Column("run_after", Float, nullable=False),
    Column("leased_until", Float),
    Column("worker", _string(128)),
    Column("error", TEXT),
    Column("traceback", TEXT),
    Column("created_at", Float, nullable=False),
    Column("started_at", Float),
    Column("finished_at", Float),
    Column("tenant", _string(128), nullable=False, server_default=""),  # requester, or ""
    Column("turn", WHOLE),  # number of the latest claim, counted across all jobs
    Index(None, "state", "run_after"),
    Index(None, "frame_number"),
    Index(None, "map_number", "number"),
    Index(None, "turn"),
    Index(None, "tenant", "turn"),
    sqlite_autoincrement=True,
)
#: Jobs of a tenant in the order of claims.
Index(
    "ix_jobs_claimed", jobs.c.state, jobs.c.tenant, jobs.c.priority.desc(), jobs.c.attempts,
    jobs.c.number, jobs.c.kind,
)  # fmt: skip

#: Results of long jobs, appended slice by slice.
job_items = Table(
    "job_items",
    metadata,
    Column("job_number", WHOLE, ForeignKey("jobs.number"), primary_key=True),
    Column("number", WHOLE, primary_key=True),
    Column("data", JSON, nullable=False),
)

#: Input and output files of jobs.
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

#: Name of the uploaded archive of an import, which counts against the quota of the map.
ARCHIVE = "archive"
#: Names of all files of an import; the index of a recording does not count against the quota.
IMPORT_FILES = (ARCHIVE, "index")

keys = Table(
    "keys",
    metadata,
    Column("id", _string(32), primary_key=True),
    Column("name", _string(128), nullable=False, unique=True),
    Column("digest", _string(64), nullable=False, unique=True),  # SHA-256 of the secret
    Column("grants", JSON, nullable=False),  # scope by map name; "*" for all maps
    Column("created_at", Float, nullable=False),
    Column("expires_at", Float),
    Column("tenant", _string(128), nullable=False, server_default=""),
    # SHA-256 of the previous secret, which is valid until `previous_until`
    Column("previous_digest", _string(64), index=True),
    Column("previous_until", Float),
    Column("last_used_at", Float),
    Index(None, "tenant"),
)

#: Owners of keys.
tenants = Table(
    "tenants",
    metadata,
    Column("name", _string(128), primary_key=True),
    Column("created_at", Float, nullable=False),
    Column("turn", WHOLE, nullable=False, server_default="0"),  # highest turn of any removed job
)


def _event_table(name: str, *indexes: Index) -> Table:
    return Table(
        name,
        metadata,
        Column("number", WHOLE, primary_key=True),
        Column("at", Float, nullable=False),
        Column("kind", _string(32), nullable=False),
        Column("map", _string(63)),
        Column("frame_id", _string(64)),
        Column("job_id", _string(32)),
        Column("data", JSON, nullable=False),
        *indexes,
        sqlite_autoincrement=True,
    )


events = _event_table("events", Index(None, "map", "number"))
#: Events of writers of single maps on PostgreSQL. `number_events` moves them to `events`, with
#: numbers in commit order.
pending_events = _event_table("pending_events")
#: Last events of former maps.
Index(
    "ix_events_map_number_deleted", events.c.map, events.c.number,
    sqlite_where=events.c.kind == "map.deleted", postgresql_where=events.c.kind == "map.deleted",
)  # fmt: skip

#: Results of requests with an `Idempotency-Key`, stored for a day.
idempotency = Table(
    "idempotency",
    metadata,
    Column("actor", _string(128), primary_key=True),  # name of the key; "" without a key
    Column("key", _string(255), primary_key=True),
    Column("fingerprint", _string(64), nullable=False),  # hash of route and payload
    Column("data", JSON, nullable=False),  # ids of the result
    Column("created_at", Float, nullable=False),
    Index(None, "created_at"),
)

#: Lines of the audit log.
audit = Table(
    "audit",
    metadata,
    Column("number", WHOLE, primary_key=True),
    Column("at", Float, nullable=False),
    Column("actor", _string(128), nullable=False),  # name of the key; "" without a key
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

#: Single row with the oldest revision whose processes may write to this schema.
schema_range = Table(
    "schema_range",
    metadata,
    Column("least_revision", _string(32), primary_key=True),
)

#: Single row with the progress of the scrub, which verifies stored bytes.
scrubs = Table(
    "scrubs",
    metadata,
    Column("number", WHOLE, primary_key=True, autoincrement=False),
    Column("position", WHOLE, nullable=False),  # number of the last checked frame
    Column("next_at", Float, nullable=False),  # earliest time of the next slice, database clock
    Column("began_at", Float, nullable=False),  # start of this pass
    Column("finished_at", Float),  # end of the last complete pass; null before the first
    Column("blobs", BigInteger, nullable=False),  # counts of the current or last pass
    Column("bytes", BigInteger, nullable=False),
    Column("damaged", BigInteger, nullable=False),
)

#: Counts of processes, written a few times per minute and stored for two hours.
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

#: Deleted maps with their last event, and their quotas for the next map of the same name.
former_maps = Table(
    "former_maps",
    metadata,
    Column("name", _string(63), primary_key=True),
    Column("number", BigInteger, nullable=False),  # number of the event
    Column("quota_frames", BigInteger),
    Column("quota_bytes", BigInteger),
    Index(None, "number"),
)

#: Queries and their outcomes, stored for a limited time, and their answers while space permits.
queries = Table(
    "queries",
    metadata,
    Column("number", WHOLE, primary_key=True),
    Column("id", _string(32), nullable=False, unique=True),  # id of the answer
    Column("at", Float, nullable=False),  # arrival of the query
    Column("map_number", WHOLE, ForeignKey("maps.number"), nullable=False),
    Column("maps", JSON(none_as_null=True)),  # names of all searched maps; null: only this one
    Column("robot", _string(128)),
    Column("session", _string(128)),
    Column("key_id", _string(32)),
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
    Column("frame_map", _string(63)),  # map of a stored query frame; null for an upload
    Column("frame_id", _string(64)),
    Column("listed", Boolean, nullable=False),  # false: lists omit the query
    Column("kept_at", Float),  # time from which the answer is permanent; null: it expires
    Column("title", _string(200)),  # title of a permanent answer
    Column("shown", JSON(none_as_null=True)),  # frame numbers in the answer
    Column("bytes", BigInteger, nullable=False),  # size of the answer; 0 if it is not stored
    Column("answer", LargeBinary),  # permanent answer; see `answer_files` for others
    Index(None, "at", "number"),
    Index(None, "map_number", "at", "number"),
    Index(None, "map_number", "status", "at", "number"),
    Index(None, "robot", "at", "number"),
    sqlite_autoincrement=True,
)
#: Stored answers by age, and permanent answers.
Index(
    "ix_queries_stored", queries.c.at, queries.c.number, queries.c.bytes,
    sqlite_where=literal_column("bytes > 0"), postgresql_where=literal_column("bytes > 0"),
)  # fmt: skip
Index(
    "ix_queries_kept", queries.c.map_number, queries.c.at, queries.c.number,
    sqlite_where=literal_column("kept_at IS NOT NULL"),
    postgresql_where=literal_column("kept_at IS NOT NULL"),
)  # fmt: skip

#: Surfaces of maps, and their progress.
surfaces = Table(
    "surfaces",
    metadata,
    Column("map_number", WHOLE, ForeignKey("maps.number"), primary_key=True),
    Column("model_id", _string(64), nullable=False),  # model of the fused artifacts
    Column("cell_m", Float, nullable=False),  # cell width of the finest level, metres
    Column("wanted", Boolean, nullable=False),  # false: the surface was deleted
    Column("job_number", WHOLE),  # latest job, possibly removed
    # revision of the map and number of edits that the surface includes
    Column("revision", WHOLE, nullable=False),
    Column("edits", WHOLE, nullable=False),
    Column("pose_edits", WHOLE, nullable=False),  # number of edits of fused frames
    # time scale in published tiles; `scale` counts its changes
    Column("scale", WHOLE, nullable=False),
    Column("taken_from", Float),
    Column("taken_step_s", Float, nullable=False),
    Column("first_taken", Float),
    Column("last_taken", Float),
    Column("sessions", JSON, nullable=False),
    Column(
        "parents", JSON, nullable=False
    ),  # parent frames with the most frames: name, frames, up, axes
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
    Column("blob", _string(64)),  # sums at the finest level, else cells; null: none yet
    Column("digest", _string(64), nullable=False),  # digest of the published cells
    Column("scale", WHOLE, nullable=False),  # `scale` of the surface at its publication
    # last frame in `draft` during a rebuild, initially 0; null if the tile is up to date
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

#: Fused frames.
surface_frames = Table(
    "surface_frames",
    metadata,
    Column("frame_number", WHOLE, ForeignKey("frames.number"), primary_key=True),
    Column("map_number", WHOLE, ForeignKey("maps.number"), nullable=False),
    Column("parent", _string(128), nullable=False),
    Column(
        "changed", Boolean, nullable=False
    ),  # edited after its fusion, so it must be fused again
    Index(None, "map_number", "parent", "changed"),
)

#: Links between fused frames and tiles of the finest level.
surface_touches = Table(
    "surface_touches",
    metadata,
    Column("tile_number", WHOLE, ForeignKey("surface_tiles.number"), primary_key=True),
    Column("frame_number", WHOLE, ForeignKey("frames.number"), primary_key=True),
    Index(None, "frame_number"),
)

#: Blobs of deleted rows, until the blobs are removed.
doomed = Table(
    "doomed",
    metadata,
    Column("blob", _string(64), primary_key=True),
    Column("at", Float, nullable=False),
)

#: Secrets that never leave the database; see `opaque_ids`.
secrets = Table(
    "secrets",
    metadata,
    Column("name", _string(32), primary_key=True),
    Column("value", LargeBinary, nullable=False),
)


# Counts of rows, and selection of rows by many numbers.

#: Maximum length of a list of numbers in a statement; SQLite allows 32,766 parameters.
MOST_ROWS = 10_000


def count_rows(connection: Connection, *conditions: ColumnElement[bool]) -> int:
    """Return the number of rows that satisfy the conditions."""
    return int(connection.execute(select(func.count()).where(*conditions)).scalar_one())


def blocks(numbers: Iterable[int]) -> Iterator[list[int]]:
    """Split numbers into lists of up to `MOST_ROWS`."""
    rest = iter(numbers)
    while block := list(islice(rest, MOST_ROWS)):
        yield block


def among(
    connection: Connection, column: Column[int], numbers: Sequence[int]
) -> ColumnElement[bool]:
    """Return the SQL condition that the value of a column is in `numbers`.

    PostgreSQL receives an array, ten times as fast as 10,000 parameters.
    """
    if connection.dialect.name == "postgresql":
        return column == any_(literal(list(numbers), ARRAY(BigInteger)))
    return column.in_(numbers)


def rows_among(
    connection: Connection, statement: Select[Any], column: Column[int], numbers: Iterable[int]
) -> Iterator[Any]:
    """Yield the rows of a statement for which the value of a column is in `numbers`."""
    for block in blocks(numbers):
        yield from connection.execute(statement.where(among(connection, column, block)))


def rows_of_statement(
    connection: Connection, statement: Callable[[str], Select[Any]], numbers: Iterable[int],
    **values: object,
) -> Iterator[Any]:  # fmt: skip
    """Yield the rows of a cached statement; see `rows_among`.

    Parameters
    ----------
    statement : function that returns the cached statement for a dialect, with `among_numbers`
    numbers : any count of numbers
    values : other parameters of the statement
    """
    cached = statement(connection.dialect.name)
    for block in blocks(numbers):
        yield from connection.execute(cached, {"numbers": block, **values})


def among_numbers(dialect: str, column: Column[int]) -> ColumnElement[bool]:
    """Return the SQL condition of `among` for the parameter `numbers` of a cached statement."""
    if dialect == "postgresql":
        return column == any_(bindparam("numbers", type_=ARRAY(BigInteger)))
    return column.in_(bindparam("numbers", expanding=True))


def dialect_insert(connection: Connection, table: Table) -> Any:
    """Return an INSERT that supports ON CONFLICT, in the dialect of the database."""
    return (sqlite if connection.dialect.name == "sqlite" else postgresql).insert(table)


@dataclass(frozen=True)
class MapRow:
    """A row of the table `maps`."""

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
    """A row of the table `frames`."""

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
        """Kind of the frame: depth image or point cloud."""
        return "depth" if self.cloud is None else "cloud"


@dataclass(frozen=True)
class JobRow:
    """A row of the table `jobs`."""

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
        """Number of the frame of the job; raise ValueError if the job has none."""
        if self.frame_number is None:
            raise ValueError(f"job {self.id} of kind {self.kind} has no frame")
        return self.frame_number


def map_row(row: RowMapping) -> MapRow:
    """Convert a row of the table `maps`."""
    return MapRow(**row)


def frame_row(row: RowMapping) -> FrameRow:
    """Convert a row of the table `frames`."""
    return FrameRow(**{**row, "state": FrameState(row["state"])})


def frame_rows(selected: Iterable[Row[Any]]) -> list[FrameRow]:
    """Convert rows of `FRAME_COLUMNS` by position, three times as fast as `frame_row`."""
    rows = []
    for row in selected:
        values = list(row)
        values[_FRAME_STATE] = FrameState(values[_FRAME_STATE])
        rows.append(FrameRow(*values))
    return rows


def job_row(row: RowMapping) -> JobRow:
    """Convert a row of the table `jobs`."""
    return JobRow(**{**row, "state": JobState(row["state"])})


def job_of_columns(row: Sequence[Any]) -> JobRow:
    """Convert the first columns of a row, `JOB_COLUMNS`, to a job."""
    values = list(row[: len(JOB_COLUMNS)])
    values[_JOB_STATE] = JobState(values[_JOB_STATE])
    return JobRow(*values)


#: Columns of `maps`, `frames` and `jobs` in the order of the fields of their rows.
MAP_COLUMNS = tuple(maps.c[member.name] for member in fields(MapRow))
FRAME_COLUMNS = tuple(frames.c[member.name] for member in fields(FrameRow))
JOB_COLUMNS = tuple(jobs.c[member.name] for member in fields(JobRow))
_FRAME_STATE = [column.name for column in FRAME_COLUMNS].index("state")
_JOB_STATE = [column.name for column in JOB_COLUMNS].index("state")


# Leases and jobs use the clock of the database, since the clocks of hosts differ.

#: Start of a PostgreSQL statement, seconds since 1970. The start of the transaction would precede
#: the wait for its turn, and clock_timestamp() differs by row, which prevents the use of an index.
STATEMENT_TIME: ColumnElement[float] = cast(extract("epoch", func.statement_timestamp()), Float(53))


def now(connection: Connection) -> ColumnElement[float]:
    """Return an expression for the time of a statement, seconds since 1970."""
    if connection.dialect.name == "sqlite":
        return literal(time.time())
    return STATEMENT_TIME


def job_values(
    connection: Connection, kind: str, priority: int, model_id: str | None = None,
    data: dict[str, Any] | None = None,
) -> dict[str, Any]:  # fmt: skip
    """Return the columns of a newly queued job, except its frame and map; see `enqueue`."""
    at = now(connection)
    return {
        "id": uuid.uuid4().hex, "kind": kind, "model_id": model_id,
        "data": request_data() if data is None else data, "state": JobState.QUEUED,
        "priority": priority, "attempts": 0, "failures": 0, "token": 0, "run_after": at,
        "created_at": at, "tenant": current_tenant(),
    }  # fmt: skip


def request_data() -> dict[str, Any] | None:
    """Return the request id as data of a job; None outside of a request."""
    if request_id() is None:
        return None
    return {"request_id": request_id()}  # log lines of the worker contain it


def audit_values(
    action: str, map_name: str | None, target: str | None, data: dict[str, Any]
) -> dict[str, Any] | None:
    """Return the columns of an audit line for a change by the current actor.

    Return None without an actor: the request that queued the job of a worker has a line.
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
    """Return the columns of an event at the current time."""
    return {
        "at": time.time(), "kind": kind, "map": map_name, "frame_id": frame_id, "job_id": job_id,
        "data": data,
    }  # fmt: skip

"""Insertion of new frames with their jobs, events and audit lines, the usual effect of an upload.

    [NewFrame, ...]  --receive_frames-->  ids of the inserted frames

On PostgreSQL, one statement inserts frames of several maps, so that they share round trips and the
wait for the disk. SQLite has no round trips, and uses one statement per table and frame.
"""

from __future__ import annotations

import uuid
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextvars import Context, copy_context
from dataclasses import dataclass, field
from functools import cache
from typing import Any

from sqlalchemy import (
    CTE,
    JSON,
    BigInteger,
    ColumnElement,
    Connection,
    FromClause,
    Insert,
    Select,
    String,
    Table,
    TableValuedAlias,
    and_,
    bindparam,
    cast,
    column,
    exists,
    func,
    insert,
    literal,
    literal_column,
    or_,
    select,
    true,
    tuple_,
    update,
)
from sqlalchemy.sql.dml import ReturningUpdate
from sqlalchemy.types import TypeEngine

from sceneprint.store.audit_log import append_lines
from sceneprint.store.events import events_table
from sceneprint.store.maps import received_values, write_tags
from sceneprint.store.tables import (
    STATEMENT_TIME,
    TEXT,
    WHOLE,
    MapRow,
    audit,
    audit_values,
    event_values,
    frame_tags,
    frames,
    idempotency,
    job_values,
    jobs,
    maps,
)


@dataclass(frozen=True, eq=False)
class NewFrame:
    """A frame to insert unless its map contains the same content.

    Parameters
    ----------
    row : row of the map, as last read
    values : columns, see `add_frame`
    priority : priority of the job that signs the frame
    result : columns of a row of `idempotency`; only on PostgreSQL
    frame_id, job_id : new ids
    context : context variables of the request
    """

    row: MapRow
    values: dict[str, Any]
    priority: int = 0
    result: dict[str, Any] | None = None
    frame_id: str = field(default_factory=lambda: uuid.uuid4().hex)
    job_id: str = field(default_factory=lambda: uuid.uuid4().hex)
    context: Context = field(default_factory=copy_context)

    @property
    def content(self) -> tuple[int, str]:
        """Unique key of the content: map number and content id."""
        return self.row.number, self.values["content_id"]

    @property
    def tags(self) -> list[str]:
        """Distinct tags of the frame."""
        return sorted(set(self.values["tags"]))

    @property
    def room(self) -> dict[str, Any]:
        """Parameters of `_count_frame`."""
        return {"map_number": self.row.number, "map_name": self.row.name,
                "size": self.values["bytes"], "content": self.values["content_id"]}  # fmt: skip

    def rows(self, connection: Connection) -> dict[str, dict[str, Any]]:
        """Return the columns of all rows to insert (frame, job, event, optional rows) by table."""
        number = self.row.number
        job = self.context.run(job_values, connection, "sign", self.priority)
        event = event_values("frame.received", self.row.name, self.frame_id, self.job_id, {})
        line = self.context.run(audit_values, event["kind"], self.row.name, self.frame_id, {})
        rows = {
            "frame": received_values(connection, number, self.frame_id, self.values),
            "job": {**job, "id": self.job_id, "map_number": number},
            "event": event,
        }
        optional = {"line": line, "result": self.result}
        return {**rows, **{of: row for of, row in optional.items() if row is not None}}


def receive_frames(connection: Connection, new: Sequence[NewFrame]) -> set[str]:
    """Insert frames unless their maps contain the same content, and queue jobs to sign them.

    Parameters
    ----------
    connection : transaction that writes to the maps
    new : frames; of several frames with the same map and content, only the first is inserted

    Returns
    -------
    ids : ids of the inserted frames. A frame is not inserted if its map was deleted or renamed, has
        the content, or lacks room for all its frames, or (on PostgreSQL) if the idempotency key has
        a result. The caller must determine the reason

    Raises
    ------
    IntegrityError : If another map stores a result for the same idempotency key concurrently.
    """
    of_content = dict[tuple[int, str], NewFrame]()
    for frame in new:
        of_content.setdefault(frame.content, frame)
    first = list(of_content.values())
    if connection.dialect.name == "sqlite":
        return {frame.frame_id for frame in first if _insert_on_sqlite(connection, frame)}
    if not first:
        return set()
    rows = [frame.rows(connection) for frame in first]
    names = dict[str, dict[str, None]]()
    for row in rows:
        for of, values in row.items():
            names.setdefault(of, {}).update(dict.fromkeys(values))
    fixed = {key: rows[0][of][name] for of, name, key in _keys(names) if key in _FIXED}
    columns = tuple((of, tuple(names[of])) for of in ("frame", "job", "event", *_OPTIONAL)
                    if of in names)  # fmt: skip
    statement = _insert_frames(
        events_table(connection), columns, fixed=tuple(fixed.items()),
        tagged=any(frame.tags for frame in first),
    )  # fmt: skip
    records = [_record(i, *pair) for i, pair in enumerate(zip(first, rows, strict=True))]
    return set(connection.execute(statement, {"records": records}).scalars())


def _insert_on_sqlite(connection: Connection, frame: NewFrame) -> bool:
    """Insert a frame on SQLite unless its map contains it; return whether it was inserted."""
    if connection.execute(_count_frame(), frame.room).first() is None:
        return False
    rows = frame.rows(connection)
    new = insert(frames).values(rows["frame"]).returning(frames.c.number)
    number = connection.execute(new).scalar_one()
    write_tags(connection, number, frame.tags)
    connection.execute(insert(jobs).values(frame_number=number, **rows["job"]))
    connection.execute(insert(events_table(connection)).values(rows["event"]))
    append_lines(connection, [rows.get("line")])
    return True


@cache
def _count_frame() -> ReturningUpdate[tuple[int]]:
    """Return a statement that adds a frame to the usage of its map, if the quota allows it."""
    number, size = bindparam("map_number", type_=WHOLE), bindparam("size", type_=WHOLE)
    content = bindparam("content", type_=TEXT)
    alike = frames.c.map_number == number, frames.c.content_id == content
    return (
        update(maps)
        .where(
            maps.c.number == number,
            maps.c.name == bindparam("map_name", type_=TEXT),
            *_room_conditions(1, size),
            ~exists().where(*alike),
        )
        .values(_usage_after(1, size))
        .returning(maps.c.number)
    )


def _room_conditions(n: Any, size: Any) -> tuple[ColumnElement[bool], ColumnElement[bool]]:
    """Return the SQL conditions for maps with room for `n` more frames and `size` more bytes."""
    return (
        or_(maps.c.quota_frames.is_(None), maps.c.used_frames + n <= maps.c.quota_frames),
        or_(maps.c.quota_bytes.is_(None), maps.c.used_bytes + size <= maps.c.quota_bytes),
    )


def _usage_after(n: Any, size: Any) -> dict[str, Any]:
    return {"used_frames": maps.c.used_frames + n, "used_bytes": maps.c.used_bytes + size}


# Statement for many frames on PostgreSQL. Its records have keys such as `frame_<column>`. Values
# that the server can derive are not sent, to save a fifth of the time.

#: Columns with the time of the statement.
_STAMPED = frozenset(("frame_received_at", "job_run_after", "job_created_at"))
#: Columns with the same value for all new frames.
_FIXED = frozenset(
    ("frame_state", "job_kind", "job_model_id", "job_state", "job_attempts", "job_failures",
     "job_token", "event_kind")
)  # fmt: skip
#: Columns that repeat the value of another column.
_SAME = {
    "job_map_number": "frame_map_number", "event_frame_id": "frame_id", "event_job_id": "job_id",
    "line_at": "event_at", "line_tenant": "job_tenant", "line_action": "event_kind",
    "line_map": "event_map", "line_target": "frame_id", "line_data": "event_data",
}  # fmt: skip
#: Optional rows of a new frame, with the column that is null without the row.
_OPTIONAL = {"line": "actor", "result": "key"}


def _keys(names: Mapping[str, Iterable[str]]) -> Iterator[tuple[str, str, str]]:
    """Yield table, column name and record key of each column."""
    return ((of, name, f"{of}_{name}") for of, columns in names.items() for name in columns)


def _is_sent(key: str) -> bool:
    return not (key in _STAMPED or key in _FIXED or key in _SAME)


def _record(place: int, frame: NewFrame, rows: dict[str, dict[str, Any]]) -> dict[str, Any]:
    """Return the record of a frame for `_insert_frames`."""
    values = {key: rows[of][name] for of, name, key in _keys(rows) if _is_sent(key)}
    return {**values, "place": place, "tags": frame.tags, "size": frame.room["size"]}


@cache
def _insert_frames(
    event_table: Table, columns: tuple[tuple[str, tuple[str, ...]], ...], *,
    fixed: tuple[tuple[str, Any], ...], tagged: bool,
) -> Select[Any]:  # fmt: skip
    """Return the statement that inserts frames with all related rows.

    Parameters
    ----------
    columns : names of the columns of each row
    fixed : values that are equal for all frames, by key
    tagged : whether any frame has tags
    """
    of = {"frame": frames, "job": jobs, "event": event_table, "line": audit, "result": idempotency}
    tables = {name: (of[name], names) for name, names in columns}
    constants = dict(fixed)
    records = _records(tables)
    lacking = _lacking(records, result="result" in tables)
    room = _count_frames(lacking)
    has_room = and_(room.c.number == lacking.c.frame_map_number,
                    room.c.name == lacking.c.event_map)  # fmt: skip
    source = lacking.join(room, has_room)
    new = (
        _insert_rows("frame", tables, constants, lacking, source)
        .returning(frames.c.number, frames.c.id)
        .cte("new")
    )
    inserted = lacking.join(new, new.c.id == lacking.c.frame_id)
    others = [
        _insert_rows("job", tables, constants, lacking, inserted, frame_number=new.c.number),
        _insert_rows("event", tables, constants, lacking, inserted),
    ]
    if tagged:
        tag = func.json_array_elements_text(lacking.c.tags)
        rows = select(new.c.number, tag).select_from(inserted)
        others.append(insert(frame_tags).from_select(["frame_number", "tag"], rows))
    for name in (name for name in _OPTIONAL if name in tables):
        present = lacking.c[f"{name}_{_OPTIONAL[name]}"].is_not(None)
        others.append(_insert_rows(name, tables, constants, lacking, inserted, present))
    return select(new.c.id).add_cte(*(table.cte(f"other_{i}") for i, table in enumerate(others)))


_Tables = dict[str, tuple[Table, tuple[str, ...]]]


def _records(tables: _Tables) -> TableValuedAlias:
    """Return a table expression for the records of `_record`."""
    names = {of: columns for of, (_, columns) in tables.items()}
    columns = [
        column(key, _kind(tables[of][0].c[name].type))
        for of, name, key in _keys(names)
        if _is_sent(key)
    ]
    own = column("place", BigInteger), column("size", BigInteger), column("tags", JSON)
    rows = func.json_to_recordset(bindparam("records", type_=JSON))
    table = rows.table_valued(*columns, *own, name="records")
    return table.render_derived(name="records", with_types=True)


def _kind(kind: TypeEngine[Any]) -> TypeEngine[Any]:
    """Return the type of a record column, without its length, so that long values raise errors."""
    return TEXT if isinstance(kind, String) else kind


def _lacking(records: TableValuedAlias, *, result: bool) -> CTE:
    """Select the records with content that is not stored, and a key without a result.

    Each lookup reads the next entry of one index: a cached plan may date from a time when the
    tables were empty, and all indexes seemed equally good.
    """
    key = frames.c.map_number, frames.c.content_id
    own = records.c.frame_map_number, records.c.frame_content_id
    is_next = (
        select(and_(key[0] == own[0], key[1] == own[1]))
        .where(tuple_(*key) >= tuple_(*own))
        .order_by(*key)
        .limit(1)
    )
    absent = [is_next.scalar_subquery().is_not(true())]
    if result:
        same = (
            idempotency.c.actor == records.c.result_actor,
            idempotency.c.key == records.c.result_key,
        )
        done = select(true()).where(*same).limit(1).scalar_subquery()
        absent.append(done.is_(None))
    return select(records).where(*absent).cte("lacking")


def _count_frames(lacking: CTE) -> CTE:
    """Return an UPDATE that adds the records to the usage of the maps with room for them."""
    each = lacking.c.frame_map_number, lacking.c.event_map
    size = cast(func.sum(lacking.c.size), BigInteger)
    more = select(*each, func.count().label("n"), size.label("size")).group_by(*each).cte("more")
    own = maps.c.number == more.c.frame_map_number, maps.c.name == more.c.event_map
    counted = update(maps).where(*own, *_room_conditions(more.c.n, more.c.size))
    return (
        counted.values(_usage_after(more.c.n, more.c.size))
        .returning(maps.c.number, maps.c.name)
        .cte("room")
    )


def _insert_rows(
    of: str, tables: _Tables, fixed: dict[str, Any], lacking: CTE, source: FromClause,
    *conditions: ColumnElement[bool], **more: ColumnElement[Any],
) -> Insert:  # fmt: skip
    """Return a statement that inserts a row for each frame of `source`, in record order."""
    table, names = tables[of]

    def value(name: str) -> ColumnElement[Any]:
        key = f"{of}_{name}"
        if key in _STAMPED:
            return STATEMENT_TIME
        key = _SAME.get(key, key)
        if key in fixed:
            return literal(fixed[key], _kind(table.c[name].type))
        sent, kind = lacking.c[key], table.c[name].type
        if isinstance(kind, JSON) and not kind.none_as_null:  # null in a record is SQL's null
            return func.coalesce(sent, literal_column("CAST('null' AS json)"))
        return sent

    rows = select(*map(value, names), *more.values()).select_from(source).where(*conditions)
    return insert(table).from_select([*names, *more], rows.order_by(lacking.c.place))

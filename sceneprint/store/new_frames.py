"""New frames, taken with the jobs that sign them: all that most uploads write.

    [NewFrame, ...]  --receive_frames-->  those that were taken

Others wait for this. On PostgreSQL it is one statement for all of them, whatever their maps: what
a statement costs beside its rows, and the wait for the disk, is shared. On SQLite, where no round
trip is waited for, it is a statement for each table and frame.
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
    """A frame whose content its map may lack.

    Parameters
    ----------
    row : of the map, as it was when somebody looked
    values : see `add_frame`
    priority : of the job that signs it
    kept : columns of `idempotency`, PostgreSQL
    frame_id, job_id : that they get
    context : of the request that it came with, whoever writes it
    """

    row: MapRow
    values: dict[str, Any]
    priority: int = 0
    kept: dict[str, Any] | None = None
    frame_id: str = field(default_factory=lambda: uuid.uuid4().hex)
    job_id: str = field(default_factory=lambda: uuid.uuid4().hex)
    context: Context = field(default_factory=copy_context)

    @property
    def content(self) -> tuple[int, str]:
        """What a map has once: its number, and the content."""
        return self.row.number, self.values["content_id"]

    @property
    def tags(self) -> list[str]:
        """Its tags, each once."""
        return sorted(set(self.values["tags"]))

    @property
    def room(self) -> dict[str, Any]:
        """What `_room_taken` asks for."""
        return {"map_number": self.row.number, "map_name": self.row.name,
                "size": self.values["bytes"], "content": self.values["content_id"]}  # fmt: skip

    def rows(self, connection: Connection) -> dict[str, dict[str, Any]]:
        """Return the columns of its frame, job and event; of its line of the audit log and of its
        idempotency key, where it has them.
        """
        number = self.row.number
        job = self.context.run(job_values, connection, "sign", self.priority)
        told = event_values("frame.received", self.row.name, self.frame_id, self.job_id, {})
        line = self.context.run(audit_values, told["kind"], self.row.name, self.frame_id, {})
        rows = {
            "frame": received_values(connection, number, self.frame_id, self.values),
            "job": {**job, "id": self.job_id, "map_number": number},
            "event": told,
        }
        optional = {"line": line, "kept": self.kept}
        return {**rows, **{of: row for of, row in optional.items() if row is not None}}


def receive_frames(connection: Connection, given: Sequence[NewFrame]) -> set[str]:
    """Take frames whose content their maps lack, and queue their signing.

    Parameters
    ----------
    connection : of a transaction that writes to their maps
    given : the first of those with one content in one map is taken

    Returns
    -------
    ids : of those that were taken. Nothing was written of others: the map is gone or renamed, has
        no room for all that came for it, or has the content; `add_frame` and what is asked before
        it say which. Nor, on PostgreSQL, where something is known under the key of `kept`

    Raises
    ------
    IntegrityError : something is done at this moment under the key of a `kept`, for another map.
    """
    of_content = dict[tuple[int, str], NewFrame]()
    for one in given:
        of_content.setdefault(one.content, one)
    first = list(of_content.values())
    if connection.dialect.name == "sqlite":
        return {one.frame_id for one in first if _received(connection, one)}
    if not first:
        return set()
    rows = [one.rows(connection) for one in first]
    names = dict[str, dict[str, None]]()
    for row in rows:
        for of, values in row.items():
            names.setdefault(of, {}).update(dict.fromkeys(values))
    fixed = {key: rows[0][of][name] for of, name, key in _keys(names) if key in _FIXED}
    columns = tuple((of, tuple(names[of])) for of in ("frame", "job", "event", *_OPTIONAL)
                    if of in names)  # fmt: skip
    asked = _reception(
        events_table(connection), columns, fixed=tuple(fixed.items()),
        tagged=any(one.tags for one in first),
    )  # fmt: skip
    records = [_record(i, *one) for i, one in enumerate(zip(first, rows, strict=True))]
    found = connection.execute(asked, {"records": records})
    return set(found.scalars())


def _received(connection: Connection, one: NewFrame) -> bool:
    """Take a frame on SQLite; whether it was taken."""
    if connection.execute(_room_taken(), one.room).first() is None:
        return False
    rows = one.rows(connection)
    made = insert(frames).values(rows["frame"]).returning(frames.c.number)
    number = connection.execute(made).scalar_one()
    write_tags(connection, number, one.tags)
    connection.execute(insert(jobs).values(frame_number=number, **rows["job"]))
    connection.execute(insert(events_table(connection)).values(rows["event"]))
    append_lines(connection, [rows.get("line")])
    return True


@cache
def _room_taken() -> ReturningUpdate[tuple[int]]:
    """Count one frame more, if its map is still the same, has room, and lacks the content."""
    number, size = bindparam("map_number", type_=WHOLE), bindparam("size", type_=WHOLE)
    content = bindparam("content", type_=TEXT)
    alike = frames.c.map_number == number, frames.c.content_id == content
    return (
        update(maps)
        .where(
            maps.c.number == number,
            maps.c.name == bindparam("map_name", type_=TEXT),
            *_has_room(1, size),
            ~exists().where(*alike),
        )
        .values(_counted(1, size))
        .returning(maps.c.number)
    )


def _has_room(n: Any, size: Any) -> tuple[ColumnElement[bool], ColumnElement[bool]]:
    """Whether a map has room for so many frames more, of so many bytes."""
    return (
        or_(maps.c.quota_frames.is_(None), maps.c.used_frames + n <= maps.c.quota_frames),
        or_(maps.c.quota_bytes.is_(None), maps.c.used_bytes + size <= maps.c.quota_bytes),
    )


def _counted(n: Any, size: Any) -> dict[str, Any]:
    return {"used_frames": maps.c.used_frames + n, "used_bytes": maps.c.used_bytes + size}


# One statement for many frames, PostgreSQL.

# Columns of what is inserted are named by keys: `frame_<column>` and so on. Not sent for each frame
# are those whose values are known otherwise: reading them took a fifth of all.

#: Those whose values are the time of the statement.
_STAMPED = frozenset(("frame_received_at", "job_run_after", "job_created_at"))
#: Those whose values are the same for all new frames.
_FIXED = frozenset(
    ("frame_state", "job_kind", "job_model_id", "job_state", "job_attempts", "job_failures",
     "job_token", "event_kind")
)  # fmt: skip
#: Those whose values are another's.
_SAME = {
    "job_map_number": "frame_map_number", "event_frame_id": "frame_id", "event_job_id": "job_id",
    "line_at": "event_at", "line_tenant": "job_tenant", "line_action": "event_kind",
    "line_map": "event_map", "line_target": "frame_id", "line_data": "event_data",
}  # fmt: skip
#: What not every new frame has, each with a column that is null where it is missing.
_OPTIONAL = {"line": "actor", "kept": "key"}


def _keys(names: Mapping[str, Iterable[str]]) -> Iterator[tuple[str, str, str]]:
    """Of each column what it is of, its name and its key."""
    return ((of, name, f"{of}_{name}") for of, columns in names.items() for name in columns)


def _is_sent(key: str) -> bool:
    return not (key in _STAMPED or key in _FIXED or key in _SAME)


def _record(place: int, one: NewFrame, rows: dict[str, dict[str, Any]]) -> dict[str, Any]:
    """A frame as `_reception` is given it."""
    values = {key: rows[of][name] for of, name, key in _keys(rows) if _is_sent(key)}
    return {**values, "place": place, "tags": one.tags, "size": one.room["size"]}


@cache
def _reception(
    told: Table, columns: tuple[tuple[str, tuple[str, ...]], ...], *,
    fixed: tuple[tuple[str, Any], ...], tagged: bool,
) -> Select[Any]:  # fmt: skip
    """Return the statement that takes frames with their jobs, events, tags, lines of the audit log
    and idempotency keys.

    Parameters
    ----------
    told : table that events are inserted into
    columns : names of the columns of each row
    fixed : values of columns by their keys, the same for all
    tagged : whether a frame has a tag
    """
    of = {"frame": frames, "job": jobs, "event": told, "line": audit, "kept": idempotency}
    tables = {name: (of[name], names) for name, names in columns}
    known = dict(fixed)
    given = _given(tables)
    lacking = _lacking(given, kept="kept" in tables)
    room = _rooms_taken(lacking)
    has_room = and_(room.c.number == lacking.c.frame_map_number,
                    room.c.name == lacking.c.event_map)  # fmt: skip
    source = lacking.join(room, has_room)
    made = _inserted("frame", tables, known, lacking, source).returning(
        frames.c.number, frames.c.id
    )
    new = made.cte("new")
    taken = lacking.join(new, new.c.id == lacking.c.frame_id)
    others = [
        _inserted("job", tables, known, lacking, taken, frame_number=new.c.number),
        _inserted("event", tables, known, lacking, taken),
    ]
    if tagged:
        tag = func.json_array_elements_text(lacking.c.tags)
        rows = select(new.c.number, tag).select_from(taken)
        others.append(insert(frame_tags).from_select(["frame_number", "tag"], rows))
    for name in (one for one in _OPTIONAL if one in tables):
        is_there = lacking.c[f"{name}_{_OPTIONAL[name]}"].is_not(None)
        others.append(_inserted(name, tables, known, lacking, taken, is_there))
    return select(new.c.id).add_cte(*(one.cte(f"other_{i}") for i, one in enumerate(others)))


_Tables = dict[str, tuple[Table, tuple[str, ...]]]


def _given(tables: _Tables) -> TableValuedAlias:
    """Records of `_record`, as rows."""
    names = {of: columns for of, (_, columns) in tables.items()}
    columns = [
        column(key, _kind(tables[of][0].c[name].type))
        for of, name, key in _keys(names)
        if _is_sent(key)
    ]
    own = column("place", BigInteger), column("size", BigInteger), column("tags", JSON)
    records = func.json_to_recordset(bindparam("records", type_=JSON))
    given = records.table_valued(*columns, *own, name="given")
    return given.render_derived(name="given", with_types=True)


def _kind(kind: TypeEngine[Any]) -> TypeEngine[Any]:
    """The type of a column of a record: a length would cut off what the table refuses."""
    return TEXT if isinstance(kind, String) else kind


def _lacking(given: TableValuedAlias, *, kept: bool) -> CTE:
    """Of what was given, what its map lacks, and what was not done before under its key.

    Each is looked for by itself, as what comes next in the order of one index: the plan may be of
    when the tables were empty, and any index of a map's frames seemed as good.
    """
    key = frames.c.map_number, frames.c.content_id
    own = given.c.frame_map_number, given.c.frame_content_id
    next_is_it = (
        select(and_(key[0] == own[0], key[1] == own[1]))
        .where(tuple_(*key) >= tuple_(*own))
        .order_by(*key)
        .limit(1)
    )
    absent = [next_is_it.scalar_subquery().is_not(true())]
    if kept:
        same = idempotency.c.actor == given.c.kept_actor, idempotency.c.key == given.c.kept_key
        done = select(true()).where(*same).limit(1).scalar_subquery()
        absent.append(done.is_(None))
    return select(given).where(*absent).cte("lacking")


def _rooms_taken(lacking: CTE) -> CTE:
    """Maps that are what was looked at still, and have room for all that they lack, counted."""
    each = lacking.c.frame_map_number, lacking.c.event_map
    size = cast(func.sum(lacking.c.size), BigInteger)
    more = select(*each, func.count().label("n"), size.label("size")).group_by(*each).cte("more")
    own = maps.c.number == more.c.frame_map_number, maps.c.name == more.c.event_map
    counted = update(maps).where(*own, *_has_room(more.c.n, more.c.size))
    return (
        counted.values(_counted(more.c.n, more.c.size))
        .returning(maps.c.number, maps.c.name)
        .cte("room")
    )


def _inserted(
    of: str, tables: _Tables, fixed: dict[str, Any], lacking: CTE, source: FromClause,
    *conditions: ColumnElement[bool], **more: ColumnElement[Any],
) -> Insert:  # fmt: skip
    """A row inserted for each frame of a source, in the order in which they were given."""
    table, names = tables[of]

    def value(name: str) -> ColumnElement[Any]:
        key = f"{of}_{name}"
        if key in _STAMPED:
            return STATEMENT_TIME
        key = _SAME.get(key, key)
        if key in fixed:
            return literal(fixed[key], _kind(table.c[name].type))
        sent, kind = lacking.c[key], table.c[name].type
        if isinstance(kind, JSON) and not kind.none_as_null:  # a record's null is that of SQL
            return func.coalesce(sent, literal_column("CAST('null' AS json)"))
        return sent

    rows = select(*map(value, names), *more.values()).select_from(source).where(*conditions)
    return insert(table).from_select([*names, *more], rows.order_by(lacking.c.place))

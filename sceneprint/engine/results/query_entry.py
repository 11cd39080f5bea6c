"""What the log has of a query: a row with its outcome, and its answer as bytes.

SentQuery, Answer | error  --query_row-->  NewQuery;  QueryRow  --query_record-->  QueryRecord
StoredAnswer  --encode_answer-->  bytes  --decode_answer-->  StoredAnswer
"""

from __future__ import annotations

import json
import struct
import time
import uuid
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, replace

import numpy as np
from pydantic import ValidationError

from sceneprint.engine.serializers import when
from sceneprint.errors import SceneprintError, UnknownQuery
from sceneprint.store.deletion import DAY_S
from sceneprint.store.frame_queries import QueryOrigin
from sceneprint.store.query_rows import NewQuery, QueryRow
from sceneprint.types import Bytes, Floats
from sceneprint_client.api import Answer, FrameName, Query
from sceneprint_client.api.base import Quaternion, Vector
from sceneprint_client.api.results import QueryRecord, RecordedPose
from sceneprint_client.errors import kebab_case

# An answer as bytes.


@dataclass(frozen=True, eq=False)
class StoredAnswer:
    """An answer with what looking at it, and asking again, requires.

    Parameters
    ----------
    answer, query : as the caller got and sent them
    model_id : of the model that signed the query
    vector : (D,) its signature
    geometry : its artifact as bytes; None where the query was not validated
    ranked : numbers of the frames of R, in its order
    at : when it was given, seconds since 1970
    taken : who took an uploaded query, in which run and when
    base : name of the robot's base, and T_base_query (4, 4); None where it is not known
    up : (3,) unit vector in the query's sensor; None where it is not known
    """

    answer: Answer
    query: Query
    model_id: str
    vector: Bytes
    geometry: bytes | None
    ranked: tuple[int, ...] = ()
    at: float = field(default_factory=time.time)
    taken: QueryOrigin = field(default_factory=lambda: QueryOrigin(None, None, None))
    base: tuple[str, Floats] | None = None
    up: Floats | None = None


#: Bytes of the head and of the signature; the geometry artifact follows them.
_PARTS = struct.Struct("<II")
#: What decoding raises where bytes are damaged.
DAMAGED = (ValueError, KeyError, TypeError, ValidationError, struct.error)


def encode_answer(one: StoredAnswer) -> bytes:
    """Return an answer as bytes."""
    head = json.dumps(
        {
            "answer": one.answer.model_dump(mode="json"),
            # without the maps, which the answer has; only fields that were set, as the defaults of
            # `validation` are those of the model
            "query": one.query.model_dump(
                mode="json", include=set(Query.model_fields), exclude_unset=True
            ),
            "model_id": one.model_id,
            "geometry": one.geometry is not None,
            "ranked": one.ranked,
            "at": one.at,
            "taken": asdict(one.taken),
            "base": None if one.base is None else [one.base[0], one.base[1].tolist()],
            "up": None if one.up is None else one.up.tolist(),
        }
    ).encode()
    vector = one.vector.tobytes()
    return _PARTS.pack(len(head), len(vector)) + head + vector + (one.geometry or b"")


def decode_answer(data: bytes) -> StoredAnswer:
    """Return an answer from its bytes; ValueError and others where they are damaged."""
    head_bytes, vector_bytes = _PARTS.unpack_from(data)
    begin = _PARTS.size + head_bytes
    head, end = json.loads(data[_PARTS.size : begin]), begin + vector_bytes
    base, up = head["base"], head["up"]
    return StoredAnswer(
        answer=Answer.model_validate(head["answer"]),
        query=Query.model_validate(head["query"]),
        model_id=head["model_id"],
        vector=np.frombuffer(data[begin:end], np.uint8),
        geometry=data[end:] if head["geometry"] else None,
        ranked=tuple(head["ranked"]),
        at=head["at"],
        taken=QueryOrigin(**head["taken"]),
        base=None if base is None else (base[0], np.array(base[1])),
        up=None if up is None else np.array(up),
    )


# The outcome of a query as a row.


@dataclass(frozen=True)
class SentQuery:
    """A query as it came.

    Parameters
    ----------
    maps : names of those to search, one or more
    query : its options
    robot, session : who sent it, in which run
    key_id : of the key of the request
    frame : the stored frame that is the query
    at : when it came, seconds since 1970
    """

    maps: Sequence[str]
    query: Query
    robot: str | None = None
    session: str | None = None
    key_id: str | None = None
    frame: FrameName | None = None
    at: float = field(default_factory=time.time)


def query_row(sent: SentQuery, outcome: Answer | Exception, seconds: float) -> NewQuery:
    """Return the row of a query that was answered, or that failed with an error."""
    several, frame = len(sent.maps) > 1, sent.frame
    row = NewQuery(
        # as exact as JSON, so that a time of the list finds the same rows
        id=uuid.uuid4().hex, at=round(sent.at, 6), map=sent.maps[0],
        maps=tuple(sent.maps) if several else None, robot=sent.robot, session=sent.session,
        status="failed", cause=None, reason="", pose_parent=None, pose=None, confidence=None,
        support=None, alternatives=0, milliseconds=round(1e3 * seconds, 2),
        kind=None, frame_map=None if frame is None else frame.map,
        frame_id=None if frame is None else frame.frame_id, key_id=sent.key_id,
        listed=sent.query.record,
    )  # fmt: skip
    if isinstance(outcome, SceneprintError):
        return replace(row, cause=kebab_case(type(outcome).__name__), reason=str(outcome))
    if isinstance(outcome, Exception):
        reason = "the service failed; its log has the traceback"
        return replace(row, cause="internal-error", reason=reason)
    there = outcome.location
    places = [there, *outcome.alternatives, *outcome.matches]
    own = next((one.map for one in places if one is not None and one.map is not None), None)
    row = replace(
        row, id=outcome.query_id, map=own if several and own else row.map, status=outcome.status,
        cause=outcome.cause, reason=outcome.reason, kind=outcome.kind,
        alternatives=len(outcome.alternatives),
    )  # fmt: skip
    if there is None:
        best = next(iter(outcome.alternatives), None)
        return row if best is None else replace(row, confidence=best.confidence)
    t, r = there.pose.translation, there.pose.rotation
    return replace(
        row, pose_parent=there.pose.parent_frame, pose=(t.x, t.y, t.z, r.x, r.y, r.z, r.w),
        confidence=there.confidence, support=there.support,
    )  # fmt: skip


def query_record(row: QueryRow, days: float, may_read: Callable[[str], bool]) -> QueryRecord:
    """Return a row as JSON, with its expiry after `days`, and without names of maps that `may_read`
    refuses.
    """
    frame = pose = None
    if row.frame_id is not None and row.frame_map is not None and may_read(row.frame_map):
        frame = FrameName(map=row.frame_map, frame_id=row.frame_id)
    if row.pose is not None and row.pose_parent is not None:
        x, y, z, qx, qy, qz, qw = row.pose
        pose = RecordedPose(
            parent_frame=row.pose_parent, translation=Vector(x=x, y=y, z=z),
            rotation=Quaternion(x=qx, y=qy, z=qz, w=qw),
        )  # fmt: skip
    return QueryRecord(
        query_id=row.id, at=when(row.at), map=row.map,
        maps=[one for one in row.searched if one == row.map or may_read(one)],
        robot=row.robot, session=row.session, key=row.key, status=row.status, cause=row.cause,
        reason=row.reason, pose=pose, confidence=row.confidence, support=row.support,
        alternatives=row.alternatives, milliseconds=row.milliseconds, kind=row.kind, frame=frame,
        stored=row.bytes > 0, kept_at=when(row.kept_at),
        title=row.title if all(map(may_read, row.searched)) else None,
        expires_at=None if row.kept_at else when(row.at + DAY_S * days),
    )  # fmt: skip


def unknown_query(query_id: str) -> UnknownQuery:
    """Return the error for an answer that is not there, or that the caller may not see."""
    return UnknownQuery(
        f"There is no answer {query_id!r:.80}: it never existed, or it expired. Send the query "
        "again, without `keep=false`."
    )

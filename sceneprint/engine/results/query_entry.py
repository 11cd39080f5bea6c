"""Entries of the query log: a row with the outcome, and the encoded answer.

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

from sceneprint.engine.serializers import copy_fields, when
from sceneprint.errors import SceneprintError, UnknownQuery
from sceneprint.store.deletion import DAY_S
from sceneprint.store.frame_queries import QueryOrigin
from sceneprint.store.query_rows import NewQuery, QueryRow
from sceneprint.types import Bytes, Floats
from sceneprint_client.api import Answer, FrameName, Query
from sceneprint_client.api.base import Quaternion, Vector
from sceneprint_client.api.results import QueryRecord, RecordedPose
from sceneprint_client.errors import kebab_case


@dataclass(frozen=True, eq=False)
class StoredAnswer:
    """An answer with the data to inspect it and to repeat the query.

    Parameters
    ----------
    vector : (D,) signature of the query
    geometry : encoded geometry of the query; None if validation is skipped
    ranked : frame numbers of R, in the order of R
    at : time of the answer, seconds since 1970
    origin : robot, session and capture time of an uploaded query
    base : name of the base frame of the robot, and T_base_query (4, 4); None if unknown
    up : (3,) unit up vector in the sensor frame of the query; None if unknown
    """

    answer: Answer
    query: Query
    model_id: str
    vector: Bytes
    geometry: bytes | None
    ranked: tuple[int, ...] = ()
    at: float = field(default_factory=time.time)
    origin: QueryOrigin = field(default_factory=lambda: QueryOrigin(None, None, None))
    base: tuple[str, Floats] | None = None
    up: Floats | None = None


#: Sizes, in bytes, of the head and the signature, which follow them; the geometry is last.
_PARTS = struct.Struct("<II")
#: Errors that `decode_answer` raises for damaged bytes.
DAMAGED = (ValueError, KeyError, TypeError, ValidationError, struct.error)


def encode_answer(stored: StoredAnswer) -> bytes:
    """Encode an answer as bytes."""
    head = json.dumps(
        {
            "answer": stored.answer.model_dump(mode="json"),
            # omit the maps, which are in the answer, and unset fields: defaults of `validation`
            # depend on the model
            "query": stored.query.model_dump(
                mode="json", include=set(Query.model_fields), exclude_unset=True
            ),
            "model_id": stored.model_id,
            "geometry": stored.geometry is not None,
            "ranked": stored.ranked,
            "at": stored.at,
            "taken": asdict(stored.origin),
            "base": None if stored.base is None else [stored.base[0], stored.base[1].tolist()],
            "up": None if stored.up is None else stored.up.tolist(),
        }
    ).encode()
    vector = stored.vector.tobytes()
    return _PARTS.pack(len(head), len(vector)) + head + vector + (stored.geometry or b"")


def decode_answer(data: bytes) -> StoredAnswer:
    """Decode an answer; raise an error in DAMAGED if the bytes are damaged."""
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
        origin=QueryOrigin(**head["taken"]),
        base=None if base is None else (base[0], np.array(base[1])),
        up=None if up is None else np.array(up),
    )


@dataclass(frozen=True)
class SentQuery:
    """A query request.

    Parameters
    ----------
    maps : names of one or more maps to search
    robot, session : origin of the frame
    key_id : id of the caller's key
    frame : stored frame that is queried; None for an upload
    at : time of the request, seconds since 1970
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
        # round the time as in JSON, so that filters by time match
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
    location = outcome.location
    places = [location, *outcome.alternatives, *outcome.matches]
    own = next((place.map for place in places if place is not None and place.map is not None), None)
    row = replace(
        row, id=outcome.query_id, map=own if several and own else row.map, status=outcome.status,
        cause=outcome.cause, reason=outcome.reason, kind=outcome.kind,
        alternatives=len(outcome.alternatives),
    )  # fmt: skip
    if location is None:
        best = next(iter(outcome.alternatives), None)
        return row if best is None else replace(row, confidence=best.confidence)
    t, r = location.pose.translation, location.pose.rotation
    return replace(
        row, pose_parent=location.pose.parent_frame, pose=(t.x, t.y, t.z, r.x, r.y, r.z, r.w),
        confidence=location.confidence, support=location.support,
    )  # fmt: skip


def query_record(row: QueryRow, days: float, may_read: Callable[[str], bool]) -> QueryRecord:
    """Return the API record of a query.

    Parameters
    ----------
    days : lifetime of answers; permanent answers do not expire
    may_read : function that returns whether the caller may read a map. For maps that the caller may
        not read, the record omits names (except that of the query's own map), frames and the title
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
    return copy_fields(
        QueryRecord, row, query_id=row.id, at=when(row.at), pose=pose, frame=frame,
        maps=[name for name in row.searched if name == row.map or may_read(name)],
        stored=row.bytes > 0, kept_at=when(row.kept_at),
        title=row.title if all(map(may_read, row.searched)) else None,
        expires_at=None if row.kept_at else when(row.at + DAY_S * days),
    )  # fmt: skip


def unknown_query(query_id: str) -> UnknownQuery:
    """Return the error for an answer that does not exist or that the caller may not read."""
    return UnknownQuery(
        f"There is no answer {query_id!r:.80}. It never existed or has expired. Send the query "
        "again, without `keep=false`."
    )

"""Requests as they are sent: addresses, paths, frames as forms, queries as JSON.

frame, options  --named_or_sent, query_of-->  QueryFrame, Query
QueryFrame, Query  --query_form, query_json-->  arguments of a request
"""

from __future__ import annotations

import ipaddress
import json
import re
from collections.abc import Iterable, Sequence
from os import PathLike
from typing import TYPE_CHECKING, Any, TypedDict

from sceneprint_client.api import (
    CameraIntrinsics,
    Diversity,
    Filter,
    FrameMeta,
    NamedFrame,
    Prior,
    Query,
    Stage,
    ValidationOptions,
)
from sceneprint_client.api.base import checked
from sceneprint_client.errors import (
    NotFound,
    SceneprintError,
    UnknownFrame,
    UnknownJob,
    UnknownMap,
    UnknownQuery,
    UnknownSnapshot,
)

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from sceneprint_client.frame_files import FrameFile

    #: A frame at hand: the content of a file, a path, a frame of `find_sequences`, or an array:
    #: (H, W) depth, uint16 in stored units or floating in metres; (N, 3) floating points.
    FrameInput = bytes | str | PathLike[str] | FrameFile | NDArray[np.generic]
    #: What is known of a frame; or its camera alone, of an array also as (3, 3) matrix or as
    #: (fx, fy, cx, cy), pixels.
    MetaInput = FrameMeta | CameraIntrinsics | Sequence[float] | NDArray[np.generic]

#: Where `sceneprint serve` listens unless told otherwise.
DEFAULT_URL = "http://127.0.0.1:8008"
#: A frame that is stored, or one at hand: its bytes and what is known of it.
QueryFrame = NamedFrame | tuple[bytes, FrameMeta]


def is_loopback(host: str) -> bool:
    """Whether a name or address, without port or brackets, is only ever this machine."""
    if host.lower() == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def given(**parameters: Any) -> dict[str, Any]:
    """Those parameters of a request that are not None."""
    return {name: value for name, value in parameters.items() if value is not None}


def frame_bytes(
    frame: FrameInput, meta: MetaInput | None, *, with_pose: bool,
    up: Sequence[float] | None = None,
) -> tuple[bytes, FrameMeta]:  # fmt: skip
    """Bytes of a frame and what is known of it; see `frame_files.sendable`."""
    from sceneprint_client.frame_files import sendable  # it takes numpy

    return sendable(frame, meta, with_pose=with_pose, up=up)


def frame_form(data: bytes, meta: FrameMeta) -> dict[str, Any]:
    """Arguments of a request that sends a frame."""
    return {
        "files": {"frame": ("frame", data, "application/octet-stream")},
        "data": {"meta": json.dumps(meta_json(meta))},
    }


def frames_form(frames: Sequence[FrameInput], metas: Sequence[MetaInput | None]) -> dict[str, Any]:
    """Arguments of a request that sends several frames with their poses; see `frame_bytes`."""
    sent = [frame_bytes(*one, with_pose=True) for one in zip(frames, metas, strict=True)]
    return {
        "files": [("frame", ("frame", data, "application/octet-stream")) for data, _ in sent],
        "data": {"metas": json.dumps([meta_json(meta) for _, meta in sent])},
    }


def meta_json(meta: FrameMeta) -> dict[str, Any]:
    """What is known of a frame as it is sent: a viewpoint of null says that there is none."""
    return meta.model_dump(mode="json", exclude_defaults=True)


def map_path(name: str) -> str:
    """Path of a map; UnknownMap for a name that none can have."""
    return f"/v1/maps/{_part(name, 'map', UnknownMap)}"


def query_path(query_id: str) -> str:
    """Path of a kept answer; UnknownQuery where no answer can have that id."""
    return f"/v1/queries/{_part(query_id, 'query', UnknownQuery)}"


def reconstruction_path(job_id: str) -> str:
    """Path of a reconstruction; UnknownJob where none can have that id."""
    return f"/v1/reconstructions/{_part(job_id, 'reconstruction', UnknownJob)}"


def snapshot_path(snapshot_id: str) -> str:
    """Path of a snapshot; UnknownSnapshot where none can have that id."""
    return f"/v1/snapshots/{_part(snapshot_id, 'snapshot', UnknownSnapshot)}"


def match_path(query_id: str, frame_id: str) -> str:
    """Path of a match of a kept answer; UnknownQuery or UnknownFrame as `query_path`."""
    return f"{query_path(query_id)}/matches/{_part(frame_id, 'frame', UnknownFrame)}"


def frame_path(map_name: str, frame_id: str) -> str:
    """Path of a frame; UnknownMap or UnknownFrame as `map_path`."""
    return f"{map_path(map_name)}/frames/{_part(frame_id, 'frame', UnknownFrame)}"


def job_path(job_id: str) -> str:
    """Path of a job; UnknownJob as `map_path`."""
    return f"/v1/jobs/{_part(job_id, 'job', UnknownJob)}"


def association_path(map_name: str, association_id: str) -> str:
    """Path of an association; UnknownMap or UnknownJob as `map_path`."""
    return f"{map_path(map_name)}/associations/{_part(association_id, 'association', UnknownJob)}"


def coverage_path(map_name: str, coverage_id: str) -> str:
    """Path of a coverage job; UnknownMap or UnknownJob as `map_path`."""
    return f"{map_path(map_name)}/coverage/{_part(coverage_id, 'coverage', UnknownJob)}"


def difference_path(map_name: str, difference_id: str) -> str:
    """Path of a difference; UnknownMap or UnknownJob as `map_path`."""
    return f"{map_path(map_name)}/differences/{_part(difference_id, 'difference', UnknownJob)}"


def surface_path(map_name: str) -> str:
    """Path of the surface of a map; UnknownMap as `map_path`."""
    return f"{map_path(map_name)}/surface"


def surface_tile_path(map_name: str, digest: str) -> str:
    """Path of a tile; UnknownMap as `map_path`, NotFound where no tile can have that digest."""
    return f"{surface_path(map_name)}/tiles/{_part(digest, 'tile', NotFound)}"


def _part(name: str, what: str, error: type[SceneprintError]) -> str:
    """A name that stays one part of a path: `..` would lead to another resource."""
    if not re.fullmatch(r"[A-Za-z0-9_-][A-Za-z0-9._-]*", name):
        raise error(f"There is no {what} {name!r:.80}. Check the name.")
    return name


# Queries.


class QueryOptions(TypedDict, total=False):
    """How to ask; see the fields of Query."""

    k: int
    stages: str | Iterable[Stage]
    exact: bool
    filter: Filter | dict[str, Any] | None
    seed: int
    candidates: int | None
    diversity: Diversity | dict[str, float] | None
    validation: ValidationOptions | dict[str, Any] | None
    prior: Prior | dict[str, Any] | None
    deadline_ms: int | None
    explain: bool
    explain_frame: str | None
    keep: bool
    record: bool


def query_of(kind: type[Any], how: QueryOptions, **more: Any) -> Any:
    """A query from what the caller gave; TypeError for an option that there is not."""
    unknown = how.keys() - Query.model_fields.keys()
    if unknown:
        raise TypeError(f"a query has no option {', '.join(sorted(unknown))}")
    stages: Any = how.get("stages")
    if stages is not None and not isinstance(stages, str):
        how = {**how, "stages": tuple(stages)}
    return checked(kind, "The query", **how, **more)


def named_or_sent(
    map_name: str | None, frame: FrameInput | None, meta: MetaInput | None,
    frame_id: str | None, up: Sequence[float] | None = None,
) -> tuple[str, QueryFrame]:  # fmt: skip
    """The frame that is asked for, of the map that it is asked of."""
    if map_name is None:
        raise TypeError("give `map_name`, or `maps`")
    if frame_id is not None and frame is None:
        if up is not None:
            raise TypeError("a stored frame has the `up` that it was uploaded with")
        return map_name, NamedFrame.model_construct(map=map_name, frame_id=frame_id)
    if frame is None or frame_id is not None:
        raise TypeError("give either `frame` or `frame_id`")
    return map_name, frame_bytes(frame, meta, with_pose=False, up=up)


def compared_frame(
    frame: FrameInput | NamedFrame | tuple[str, str], meta: MetaInput | None
) -> QueryFrame:
    """One of two frames to compare."""
    if isinstance(frame, tuple):
        return checked(NamedFrame, "The frame", map=frame[0], frame_id=frame[1])
    if isinstance(frame, NamedFrame):
        return frame
    return frame_bytes(frame, meta, with_pose=False)


def query_json(query: Query) -> dict[str, Any]:
    """A query as JSON; a service of before knows no more than what is not the default."""
    told = query.model_dump(mode="json", exclude_defaults=True)
    always = {"k": query.k, "stages": list(query.stages), "exact": query.exact, "seed": query.seed}
    return told | always


def query_form(data: bytes, meta: FrameMeta, query: Query) -> dict[str, Any]:
    """Arguments of a request that sends a frame and how to ask for it."""
    sent = frame_form(data, meta)
    sent["data"] |= {name: form_text(value) for name, value in query_json(query).items()}
    return sent


def form_text(value: object) -> str:
    """A field of a form: names with commas between, else JSON."""
    if isinstance(value, str):
        return value
    if isinstance(value, list):
        return ",".join(value)
    return json.dumps(value)

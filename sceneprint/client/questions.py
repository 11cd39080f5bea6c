"""Questions as the client's backends take them.

frame, options  --side_of, query_of-->  Side, Query  --sent_of, body_of-->  a request
"""

from __future__ import annotations

import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any, TypedDict

from sceneprint.client.frames import checked, sendable
from sceneprint.datasets import FrameReference
from sceneprint.schemas import (
    Diversity,
    Filter,
    FrameMeta,
    NamedFrame,
    Query,
    Stage,
    ValidationOptions,
)

#: A frame that is stored, or one at hand: its bytes and what is known of it.
Side = NamedFrame | tuple[bytes, FrameMeta]


class Options(TypedDict, total=False):
    """How to ask; see the fields of Query."""

    k: int
    stages: str | Iterable[Stage]
    exact: bool
    filter: Filter | dict[str, Any] | None
    seed: int
    candidates: int | None
    diversity: Diversity | dict[str, float] | None
    validation: ValidationOptions | dict[str, Any] | None
    deadline_ms: int | None
    explain: bool
    explain_frame: str | None
    keep: bool


def query_of(kind: type[Any], how: Options, **more: Any) -> Any:
    """A query from what the caller gave; TypeError for an option that there is not."""
    unknown = how.keys() - Query.model_fields.keys()
    if unknown:
        raise TypeError(f"a query has no option {', '.join(sorted(unknown))}")
    stages: Any = how.get("stages")
    if stages is not None and not isinstance(stages, str):
        how = {**how, "stages": tuple(stages)}
    return checked(kind, "The query", **how, **more)


def side_of(
    map_name: str | None, frame: bytes | Path | FrameReference | None, meta: FrameMeta | None,
    frame_id: str | None,
) -> tuple[str, Side]:  # fmt: skip
    """The frame that is asked for, of the map that it is asked of."""
    if map_name is None:
        raise TypeError("give `map_name`, or `maps`")
    if frame_id is not None and frame is None:
        return map_name, NamedFrame.model_construct(map=map_name, frame_id=frame_id)
    if frame is None or frame_id is not None:
        raise TypeError("give either `frame` or `frame_id`")
    return map_name, sendable(frame, meta, with_pose=False)


def frame_of(
    frame: bytes | Path | FrameReference | NamedFrame | tuple[str, str], meta: FrameMeta | None
) -> Side:
    """One of two frames to compare."""
    if isinstance(frame, tuple):
        return checked(NamedFrame, "The frame", map=frame[0], frame_id=frame[1])
    if isinstance(frame, NamedFrame):
        return frame
    return sendable(frame, meta, with_pose=False)


def path_of(map_name: str, what: str) -> str:
    """Path of what is asked of a map."""
    from sceneprint.client.messages import map_path

    return f"{map_path(map_name)}/{what}"


def body_of(query: Query) -> dict[str, Any]:
    """A query as JSON; a service of before knows no more than what is not the default."""
    told = query.model_dump(mode="json", exclude_defaults=True)
    always = {"k": query.k, "stages": list(query.stages), "exact": query.exact, "seed": query.seed}
    return told | always


def sent_of(data: bytes, meta: FrameMeta, query: Query) -> dict[str, Any]:
    """Arguments of a request that sends a frame and how to ask for it."""
    from sceneprint.client.messages import form

    sent = form(data, meta)
    sent["data"] |= {name: text_of(value) for name, value in body_of(query).items()}
    return sent


def text_of(value: object) -> str:
    """A field of a form: names with commas between, else JSON."""
    if isinstance(value, str):
        return value
    if isinstance(value, list):
        return ",".join(value)
    return json.dumps(value)

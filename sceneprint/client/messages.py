"""Requests and answers of the service, as the client writes and reads them."""

from __future__ import annotations

import json
import logging
import re
from typing import Any, TypeVar

import httpx
from pydantic import BaseModel, ValidationError

from sceneprint.client.problems import not_ours
from sceneprint.errors import (
    SceneprintError,
    UnknownFrame,
    UnknownJob,
    UnknownMap,
    UnknownQuery,
    UnknownSnapshot,
)
from sceneprint.schemas import FrameMeta

Record = TypeVar("Record", bound=BaseModel)


class Quiet(logging.Filter):
    """Keeps a line a request of one service out of the log of whoever uses the client."""

    def __init__(self, url: str) -> None:
        super().__init__()
        self._url = url

    def filter(self, record: logging.LogRecord) -> bool:
        """False for what httpx tells of requests to the service."""
        about = record.args if isinstance(record.args, tuple) else ()
        return not any(str(one).startswith(self._url) for one in about)


def read(kind: type[Record], response: httpx.Response) -> Record:
    """The record in an answer; Refused where the answer is none of ours."""
    try:
        return kind.model_validate_json(response.content)
    except ValidationError as error:
        raise not_ours(response) from error


def form(data: bytes, meta: FrameMeta) -> dict[str, Any]:
    """Arguments of a request that sends a frame."""
    return {
        "files": {"frame": ("frame", data, "application/octet-stream")},
        "data": {"meta": json.dumps(said_of(meta))},
    }


def said_of(meta: FrameMeta) -> dict[str, Any]:
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


def _part(name: str, what: str, error: type[SceneprintError]) -> str:
    """A name that stays one part of a path: `..` would lead to another resource."""
    if not re.fullmatch(r"[A-Za-z0-9_-][A-Za-z0-9._-]*", name):
        raise error(f"There is no {what} {name!r:.80}. Check the name.")
    return name

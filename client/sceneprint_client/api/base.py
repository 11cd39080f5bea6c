"""What all records of the API share."""

from __future__ import annotations

import math
import sys
from typing import Annotated, Any, Generic, TypeVar

from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    StringConstraints,
    ValidationError,
    model_validator,
)

from sceneprint_client.errors import InvalidRequest

if sys.version_info >= (3, 11):
    from enum import StrEnum
else:
    from enum import Enum

    class StrEnum(str, Enum):
        """As the one of Python 3.11."""

        __str__ = str.__str__


T = TypeVar("T")
Record = TypeVar("Record", bound=BaseModel)

#: Names that people give: printable, one line.
Label = Annotated[
    str, StringConstraints(min_length=1, max_length=128, pattern=r"^[^\x00-\x1f\x7f]+$")
]


#: Characters of the name of a frame.
MOST_OF_NAME = 255


def _without_a_way_out(name: str) -> str:
    if "\\" in name or any(part in ("", ".", "..") for part in name.split("/")):
        raise ValueError("relative, with `/` between its parts, and without `.`, `..` and `\\`")
    return name


#: What an original file or message was called: a label, never a path that anybody opens.
FileName = Annotated[
    str,
    StringConstraints(min_length=1, max_length=MOST_OF_NAME, pattern=r"^[^\x00-\x1f\x7f\\]+$"),
    AfterValidator(_without_a_way_out),
]


#: What people write about something: no database has a text with NUL.
Note = Annotated[str, StringConstraints(max_length=200, pattern=r"^[^\x00]*$")]


class Given(BaseModel):
    """A record that a caller sends: unknown fields are errors, as they would have no effect."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class ApiRecord(BaseModel):
    """A record that the service answers with; a client may meet fields it does not know yet."""

    # the many records that answers are made of, built when one is first made: a start is quicker
    model_config = ConfigDict(frozen=True, defer_build=True)


class Page(ApiRecord, Generic[T]):
    """A part of a list."""

    items: list[T]
    next_cursor: str | None = Field(
        default=None, description="Give it as `cursor` for the next part; null at the end."
    )


class Problem(ApiRecord):
    """Why a request was refused (RFC 9457)."""

    model_config = ConfigDict(frozen=True, extra="allow")

    type: str = Field(description="Names the kind of problem; the same for the same kind.")
    title: str = Field(description="The kind of problem in words.")
    status: int
    detail: str = Field(description="What happened, why, and what to do.")
    instance: str = Field(default="", description="The request's id, as in the service's log.")


# Rigid transforms as JSON.


class Vector(ApiRecord):
    """Metres."""

    x: float
    y: float
    z: float


class Direction(ApiRecord):
    """A unit vector."""

    x: float
    y: float
    z: float


class Quaternion(ApiRecord):
    """Unit quaternion, w >= 0."""

    x: float
    y: float
    z: float
    w: float


class Transform(ApiRecord):
    """x_parent = matrix @ x_child, in metres. Camera frames (`ID.optical`): x right, y down, z
    ahead; a cloud (`ID.sensor`) keeps the axes of its sensor.
    """

    parent_frame: str
    child_frame: str
    translation: Vector
    rotation: Quaternion
    matrix: list[list[float]] = Field(description="4 x 4, row by row.")


# Which way is up, as a caller gives it.

#: How far from 1 the length of a given direction may be.
_UNIT = 1e-2


class GivenDirection(Given):
    """A unit vector."""

    x: float
    y: float
    z: float

    @model_validator(mode="after")
    def _of_unit_length(self) -> GivenDirection:
        length = math.hypot(self.x, self.y, self.z)
        if not abs(length - 1.0) <= _UNIT:
            raise ValueError(
                f"its length is {length:.3g}, not 1; divide it by its length, as an "
                "accelerometer at rest measures 9.81 upwards"
            )
        return self

    @property
    def unit(self) -> list[float]:
        """Its three numbers, of length 1 as exactly as can be."""
        length = math.hypot(self.x, self.y, self.z)
        return [self.x / length, self.y / length, self.z / length]


def _from_list(given: object) -> object:
    if isinstance(given, list | tuple) and len(given) == len("xyz"):
        return dict(zip("xyz", given, strict=True))
    if not isinstance(given, GivenDirection | dict):
        raise ValueError(  # noqa: TRY004  (pydantic wants it)
            "neither {x, y, z} nor a list of three numbers"
        )
    return given


#: A direction as `{x, y, z}`, or as a list of three numbers.
Up = Annotated[
    GivenDirection,
    BeforeValidator(
        _from_list,
        json_schema_input_type=GivenDirection
        | Annotated[list[float], Field(min_length=3, max_length=3)],
    ),
]


# The states of frames and jobs.


class FrameState(StrEnum):
    """What has become of an uploaded frame; `sentence` says it for people."""

    RECEIVED = "received"
    SIGNING = "signing"
    INDEXED = "indexed"
    REJECTED = "rejected"
    FAILED = "failed"
    REDUNDANT = "redundant"
    DELETED = "deleted"

    @property
    def sentence(self) -> str:
        """The state in a sentence."""
        return _OF_FRAMES[self]


class JobState(StrEnum):
    """What has become of a piece of work; `sentence` says it for people."""

    QUEUED = "queued"
    RUNNING = "running"
    SUCCEEDED = "succeeded"
    FAILED = "failed"
    CANCELLED = "cancelled"
    DEAD = "dead"

    @property
    def sentence(self) -> str:
        """The state in a sentence."""
        return _OF_JOBS[self]

    @property
    def over(self) -> bool:
        """Whether nothing more will happen to the job."""
        return self not in (JobState.QUEUED, JobState.RUNNING)


_OF_FRAMES = {
    FrameState.RECEIVED: "Stored durably, and waiting for a worker.",
    FrameState.SIGNING: "A worker is signing it.",
    FrameState.INDEXED: "Signed, and found by queries from now on.",
    FrameState.REJECTED: "Nothing in it can be signed; `reason` says why. Trying again is no use.",
    FrameState.FAILED: "Signing broke down again and again; the job has the traceback.",
    FrameState.REDUNDANT: "Not kept, as asked: the map has this place; `reason` names the frame.",
    FrameState.DELETED: (
        "Removed on request, or as older than its map keeps frames; found by no query."
    ),
}

_OF_JOBS = {
    JobState.QUEUED: "Waiting for a worker, for the first time or for another try.",
    JobState.RUNNING: "A worker holds its lease.",
    JobState.SUCCEEDED: "Done, and what it made is stored.",
    JobState.FAILED: "Its input cannot be used; `error` says why.",
    JobState.CANCELLED: "Given up on request, such as by deleting its frame.",
    JobState.DEAD: "Given up after too many tries; `traceback` has the last one.",
}


def checked(kind: type[Record], what: str, **fields: Any) -> Record:
    """A record of the API, or what is wrong with its fields in our words.

    Raises
    ------
    InvalidRequest : a field is missing, unknown or out of its range.
    """
    try:
        return kind.model_validate(fields)
    except ValidationError as error:
        found = tuple(
            (".".join(map(str, one["loc"])), one["msg"].removeprefix("Value error, "))
            for one in error.errors(include_url=False)
        )
        told = "; ".join(f"{place or 'it'}: {reason}" for place, reason in found[:3])
        raise InvalidRequest(f"{what} is not as it should be: {told}.", found) from error

"""Which frames of a map a query may find, as JSON."""

from __future__ import annotations

from datetime import datetime
from typing import Annotated, Any

from pydantic import AwareDatetime, BeforeValidator, Field, ValidationInfo, field_validator
from pydantic_core import from_json

from sceneprint.schemas.base import Given, Label
from sceneprint.schemas.frames import GivenVector


def _one_or_many(given: object) -> object:
    return [given] if isinstance(given, str) else given


def parsed(given: object) -> object:
    """What a form gives as text, as JSON has it.

    Raises
    ------
    ValueError : a text that is no JSON.
    """
    if not isinstance(given, str):
        return given
    try:
        return from_json(given)
    except ValueError as error:
        raise ValueError(f"not JSON ({error}); a form has an object as JSON text") from error


_Several = Annotated[list[Label], Field(min_length=1, max_length=100)]
#: One name, or several of which any will do.
Names = Annotated[_Several, BeforeValidator(_one_or_many, json_schema_input_type=Label | _Several)]


class Region(Given):
    """A box along the axes of the frame that poses lead to; its faces belong to it."""

    parent_frame: Label = Field(
        description="Frames whose pose leads to another frame, or that have none, are outside."
    )
    min: GivenVector
    max: GivenVector

    @field_validator("max")
    @classmethod
    def _above_min(cls, corner: GivenVector, info: ValidationInfo) -> GivenVector:
        least = info.data.get("min")
        wrong = [
            axis
            for axis in "xyz"
            if least is not None and getattr(corner, axis) < getattr(least, axis)
        ]
        if wrong:
            raise ValueError(f"{', '.join(wrong)}: less than in `min`")
        return corner


class Filter(Given):
    """What a frame must be for a query to find it; all that is given must hold.

    A frame that lacks what a condition asks about, such as a time, does not pass it.
    """

    robot: Names | None = Field(default=None, description="Taken by this one, or one of these.")
    session: Names | None = Field(default=None, description="Taken in this one, or one of these.")
    captured_after: AwareDatetime | None = Field(default=None, description="Then, or later.")
    captured_before: AwareDatetime | None = Field(default=None, description="Then, or earlier.")
    tags: list[Label] = Field(default=[], max_length=32, description="It has all of them.")
    not_within_s: float | None = Field(
        default=None,
        gt=0,
        description="Leaves out frames of the query's own session taken at most so many seconds "
        "before or after it: for loop closure. Those of the session without a time are left out "
        "too; a session is another's where both name robots and the robots differ.",
    )
    region: Region | None = Field(default=None, description="Its pose lies in there.")
    exclude_frames: list[Label] = Field(
        default=[], max_length=1000, description="It is none of these ids."
    )

    @field_validator("captured_before")
    @classmethod
    def _not_earlier(cls, before: datetime | None, info: ValidationInfo) -> datetime | None:
        after: Any = info.data.get("captured_after")
        if before is not None and after is not None and before < after:
            raise ValueError("earlier than `captured_after`")
        return before

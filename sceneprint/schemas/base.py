"""What all records of the API share."""

from __future__ import annotations

from typing import Annotated, Generic, TypeVar

from pydantic import BaseModel, ConfigDict, Field, StringConstraints

T = TypeVar("T")

#: Names that people give: printable, one line.
Label = Annotated[
    str, StringConstraints(min_length=1, max_length=128, pattern=r"^[^\x00-\x1f\x7f]+$")
]


#: What people write about something: no database has a text with NUL.
Note = Annotated[str, StringConstraints(max_length=200, pattern=r"^[^\x00]*$")]


class Given(BaseModel):
    """A record that a caller sends: unknown fields are errors, as they would have no effect."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class Told(BaseModel):
    """A record that the service answers with; a client may meet fields it does not know yet."""

    model_config = ConfigDict(frozen=True)


class Page(Told, Generic[T]):
    """A part of a list."""

    items: list[T]
    next_cursor: str | None = Field(
        default=None, description="Give it as `cursor` for the next part; null at the end."
    )


class Problem(Told):
    """Why a request was refused (RFC 9457)."""

    model_config = ConfigDict(frozen=True, extra="allow")

    type: str = Field(description="Names the kind of problem; the same for the same kind.")
    title: str = Field(description="The kind of problem in words.")
    status: int
    detail: str = Field(description="What happened, why, and what to do.")
    instance: str = Field(default="", description="The request's id, as in the service's log.")

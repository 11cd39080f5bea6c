"""How a query selects and validates, as JSON; where the defaults are from: docs/evaluation.md."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import BeforeValidator, Field, StringConstraints

from sceneprint_client.api.base import ApiRecord, Given
from sceneprint_client.api.listing import parsed

Stage = Literal["retrieve", "diversify", "validate"]
STAGES: tuple[Stage, ...] = ("retrieve", "diversify", "validate")

#: Most maps that one query asks.
MOST_MAPS = 64

#: A map's name or a frame's id as it is asked for; whether there is such a one is found out later.
Named = Annotated[str, StringConstraints(min_length=1, max_length=128)]

#: A part of a whole.
Share = Annotated[float, Field(ge=0.0, le=1.0)]

#: An object in JSON; a form and a query string give it as text.
JsonText = BeforeValidator(parsed)


class NamedFrame(Given):
    """A stored frame that is asked about."""

    map: Named = Field(description="The map it is in.")
    frame_id: Named


class FrameName(ApiRecord):
    """A stored frame that was asked about."""

    map: str
    frame_id: str


class Diversity(Given):
    """The scales of the determinantal point process, Eq. 3 of the paper."""

    sigma: float = Field(
        default=1.0,
        ge=0.01,
        le=100.0,
        description="Times the median distance within the ranking: greater makes more frames "
        "count as alike.",
    )
    omega: float = Field(
        default=4.0,
        ge=0.01,
        le=1000.0,
        description="Times the ranking's span of distances: greater lets diversity outweigh rank.",
    )


class ValidationOptions(Given):
    """What a match must stand to be accepted.

    What is left out is as the map's model has it; the defaults told are those of `depth`.
    """

    mode: Literal["full", "paper"] = Field(
        default="full",
        description="`paper`: the residual of the two directions alone decides, and more wrong "
        "matches are accepted.",
    )
    residual_m: float = Field(
        default=0.08, gt=0, le=1.0, description="Most that both directions may disagree."
    )
    residual_deg: float = Field(default=5.0, gt=0, le=45.0, description="The same, of the turn.")
    evidence: Share = Field(
        default=0.2,
        description="Least `overlap` - `violation_weight` x `free_space_violations`.",
    )
    violation_weight: float = Field(default=5.0, ge=0.0, le=100.0)
    plane_overlap: Share = Field(default=0.15, description="Least, every plane counting alike.")
    strong: Share = Field(
        default=0.3, description="Evidence below which an accepted match is weak."
    )
    weak: Share = Field(
        default=0.05, description="`ambiguity` from which on an accepted match is weak."
    )
    ambiguous: Share = Field(
        default=0.14, description="`ambiguity` from which on nothing is accepted."
    )
    ambiguous_share: float = Field(
        default=0.5,
        ge=0.0,
        le=10.0,
        description="Nor from this share of `plane_overlap` on.",
    )

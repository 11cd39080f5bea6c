"""How a query selects and validates, as JSON; where the defaults are from: docs/evaluation.md."""

from __future__ import annotations

import math
from typing import Annotated, Literal

from pydantic import BeforeValidator, Field, StringConstraints

from sceneprint.geometry.acceptance import AcceptanceParameters, Mode
from sceneprint.geometry.diversity import DiversityParameters
from sceneprint.schemas.base import Given, Told
from sceneprint.schemas.filters import parsed

Stage = Literal["retrieve", "diversify", "validate"]
STAGES: tuple[Stage, ...] = ("retrieve", "diversify", "validate")

#: Most maps that one query asks.
MOST_MAPS = 64

_A, _D = AcceptanceParameters(), DiversityParameters()

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


class FrameName(Told):
    """A stored frame that was asked about."""

    map: str
    frame_id: str


class Diversity(Given):
    """The scales of the determinantal point process, Eq. 3 of the paper."""

    sigma: float = Field(
        default=_D.sigma,
        ge=0.01,
        le=100.0,
        description="Times the median distance within the ranking: greater makes more frames "
        "count as alike.",
    )
    omega: float = Field(
        default=_D.omega,
        ge=0.01,
        le=1000.0,
        description="Times the ranking's span of distances: greater lets diversity outweigh rank.",
    )


class ValidationOptions(Given):
    """What a match must stand to be accepted.

    What is left out is as the map's model has it; the defaults told are those of `depth`.
    """

    mode: Mode = Field(
        default="full",
        description="`paper`: the residual of the two directions alone decides, and more wrong "
        "matches are accepted.",
    )
    residual_m: float = Field(
        default=_A.residual_m, gt=0, le=1.0, description="Most that both directions may disagree."
    )
    residual_deg: float = Field(
        default=math.degrees(_A.residual_rad), gt=0, le=45.0, description="The same, of the turn."
    )
    evidence: Share = Field(
        default=_A.evidence,
        description="Least `overlap` - `violation_weight` x `free_space_violations`.",
    )
    violation_weight: float = Field(default=_A.violation_weight, ge=0.0, le=100.0)
    plane_overlap: Share = Field(
        default=_A.plane_overlap, description="Least, every plane counting alike."
    )
    strong: Share = Field(
        default=_A.strong, description="Evidence below which an accepted match is weak."
    )
    weak: Share = Field(
        default=_A.weak, description="`ambiguity` from which on an accepted match is weak."
    )
    ambiguous: Share = Field(
        default=_A.ambiguous, description="`ambiguity` from which on nothing is accepted."
    )
    ambiguous_share: float = Field(
        default=_A.ambiguous_share,
        ge=0.0,
        le=10.0,
        description="Nor from this share of `plane_overlap` on.",
    )

"""What can be looked at after a query, as JSON."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from sceneprint.schemas.base import Told
from sceneprint.schemas.matches import Uncertainty, Validation
from sceneprint.schemas.options import FrameName
from sceneprint.schemas.outputs import Triple
from sceneprint.schemas.transforms import Transform

#: What an overlay's colours tell.
OverlayColour = Literal["source", "normal", "residual"]
#: By which transform an overlay's clouds are laid on each other.
OverlayTransform = Literal["aligned", "rival", "none"]
#: Whose points.
PointsSide = Literal["query", "match"]
COLOURS: tuple[OverlayColour, ...] = ("source", "normal", "residual")
TRANSFORMS: tuple[OverlayTransform, ...] = ("aligned", "rival", "none")

#: Most points of a kind that are listed, and most patches.
MOST_POINTS = 2000


class Similarities(Told):
    """How alike a query and the frames of its ranking are, each to each: for a heat map."""

    query_id: str
    model: str
    frames: list[FrameName] = Field(
        description="Of the ranking, the nearest first; those deleted since are left out."
    )
    similarity: list[list[float]] = Field(
        description="1 - distance / that of unrelated frames, 0 to 1. The first row and column are "
        "the query's, the others those of `frames`, in their order."
    )


class Coincidences(Told):
    """Patches of both frames that coincide under the transform, a place in each list for each."""

    query: list[int] = Field(description="Index among the query's validation patches.")
    match: list[int] = Field(description="Index among the match's: see its `/patches`.")
    query_mean: list[Triple] = Field(description="Metres, in the query's sensor's frame.")
    query_normal: list[Triple]
    match_mean: list[Triple] = Field(description="Metres, in the match's sensor's frame.")
    match_normal: list[Triple]
    distance_m: list[float] = Field(description="Between the means under the transform, rising.")


class Points(Told):
    """Points of one frame, in its own sensor's frame, that evidence is counted on."""

    sampled: int = Field(description="How many were looked up in the other frame.")
    inliers: list[Triple] = Field(
        description=f"They lie on the other's surface; {MOST_POINTS} at most."
    )
    violations: list[Triple] = Field(
        description=f"They lie where the other saw through; {MOST_POINTS} at most."
    )


class MatchDetails(Told):
    """One match of a query, validated once more as the query had it, with what it rests on."""

    query_id: str
    frame_id: str
    map: str
    validation: Validation
    transform: Transform | None = Field(
        description="Query to match; null where the frames gave no hypothesis."
    )
    uncertainty: Uncertainty | None = Field(description="Of `transform`, where it is accepted.")
    rival: Transform | None = Field(
        description="The other transform that explains the frames best and is not refuted."
    )
    patches: Coincidences | None = Field(description="Null without a transform.")
    query: Points | None
    match: Points | None
    seed: int

"""Matches of a query as JSON."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from sceneprint_client.api.base import ApiRecord, Transform, Vector
from sceneprint_client.api.options import Stage

ValidationStatus = Literal["accepted", "rejected", "ambiguous", "skipped"]


class Residual(ApiRecord):
    """Both directions composed: the identity if they agreed."""

    translation_m: float
    rotation_deg: float


class Validation(ApiRecord):
    """What came of aligning the query with a match."""

    status: ValidationStatus = Field(
        description="`skipped`: it was not tried, and `reason` says why."
    )
    strength: Literal["strong", "weak"] | None = Field(
        default=None, description="Of an accepted match."
    )
    reason: str
    residual: Residual | None = None
    overlap: float | None = Field(
        default=None, description="Share of both frames' points that agree."
    )
    plane_overlap: float | None = Field(
        default=None, description="The same, every plane counting alike."
    )
    free_space_violations: float | None = Field(
        default=None,
        description="Share that lies where the other frame saw through; null where neither frame "
        "has a viewpoint, so that nothing is known of free space.",
    )
    planes: float | None = Field(
        default=None, description="Distinct planes that agree, the mean of both frames."
    )
    plane_violations: float | None = Field(
        default=None, description="`free_space_violations` with every plane counting alike."
    )
    inliers: int | None = Field(default=None, description="Points of both frames that agree.")
    ambiguity: float | None = Field(
        default=None,
        description="Share that the best rival explains.",
    )
    search: Literal["correspondences", "plans", "guided"] | None = Field(
        default=None,
        description="What proposed the transform: patches with alike surroundings, or the plans of "
        "two scans laid on each other. `guided`: other matches and the map's poses; it was refined "
        "and checked, but not searched for, so it is no vote of its own.",
    )
    directions: list[Literal["query_to_match", "match_to_query"]] = Field(
        default=[],
        description="In which directions it was found; of an accepted match, both.",
    )
    tilt_deg: float | None = Field(
        default=None,
        description="By how much the transform tilts the query's `up` against the match's; null "
        "where either is not known.",
    )


class FreeDirection(ApiRecord):
    """A direction in which a transform is hardly held, as along a corridor.

    Both parts together are of length 1: the error's metres and radians along it.
    """

    translation: Vector
    rotation: Vector
    deviation: float = Field(
        description="Standard deviation along it: metres where it shifts, radians where it turns; "
        "at most 10, for what nothing holds."
    )


class Uncertainty(ApiRecord):
    """How far a transform is likely off, if it is not wrong altogether.

    Of errors (x, y, z, rx, ry, rz): metres along the axes of the transform's parent frame, by which
    the child's origin is off, then the rotation vector, radians about the parent's axes, that the
    rotation lacks on its left. This is how ROS orders and means PoseWithCovariance.
    """

    covariance: list[float] = Field(
        min_length=36, max_length=36, description="6 x 6, row by row, in that order."
    )
    method: Literal["information-scaled", "votes-and-spread"] = Field(
        description="`information-scaled`: of one match, the inverse information of its "
        "refinement, scaled to the errors of synthetic rooms. `votes-and-spread`: of several "
        "matches, from theirs and how far they lie apart. What they are worth: docs/uncertainty.md."
    )
    degenerate: list[FreeDirection] = Field(
        description="Directions at least 30 times as uncertain as the best held, the freest first."
    )


class Match(ApiRecord):
    """A database frame returned for a query."""

    frame_id: str
    map: str
    robot: str | None
    session: str | None
    name: str | None = Field(default=None, description="Of the original file or message.")
    sequence: int | None = Field(default=None, description="Place within the session.")
    rank: int = Field(description="Place in the ranking R, from 1.")
    distance: int = Field(description="L1 distance of the stored signatures.")
    similarity: float = Field(description="1 - distance / that of unrelated frames, 0 to 1.")
    selected: bool | None = Field(
        description="In the diverse selection C; null without that stage. False: a frame of "
        "another place, validated as it looks like the query too."
    )
    diversity_gain: float | None = Field(description="1 for the first; near 0 for a duplicate.")
    validation: Validation
    transform: Transform | None = Field(description="Query to match; believe it where accepted.")
    predicted: Transform | None = Field(
        default=None,
        description="Of a guided match: `transform` as the map's poses predict it from the matches "
        "before, up to 15 cm and 6 deg off.",
    )
    pose_in_map: Transform | None = Field(
        description="The query in the parent frame of the match's pose, where that is known and "
        "the match is not rejected."
    )
    uncertainty: Uncertainty | None = Field(
        default=None, description="Of `transform`, where the match is accepted."
    )
    base_in_map: Transform | None = Field(
        default=None,
        description="As `pose_in_map`, of the robot's base: where the query has T_base_sensor.",
    )


#: What decided on a pose.
Verifier = Literal["matches", "map", "prior"]


class Alternative(ApiRecord):
    """A pose of the query that the evidence supports; of several, one is right at most."""

    pose: Transform
    map: str | None = Field(default=None, description="Whose parent frame it is given in.")
    weight: float = Field(
        description="Of its votes, one for each viewpoint: 1 of a strong match, 0.4 of a weak or "
        "an ambiguous one; 0 where the map alone suggests it."
    )
    support: int = Field(description="Matches from different viewpoints that vote for it.")
    score: float | None = Field(
        description="How far the map's frames bear it out: the share of the query's surface that "
        "they show there, every plane counting alike, less for what they saw through; 1 at most. "
        "Null where they were not asked."
    )


class Location(ApiRecord):
    """The query's pose averaged over the accepted matches that agree on it."""

    pose: Transform
    map: str | None = Field(default=None, description="Whose frames it is averaged over.")
    support: int = Field(
        description="Matches that agree on it; 0 where the map alone confirms it, and 1 is one "
        "view, unconfirmed."
    )
    guided: int = Field(
        default=0,
        description="How many of these were guided by the others: they make the pose more precise, "
        "and are no evidence of their own.",
    )
    votes: int = Field(description="Accepted matches, whatever pose they vote for.")
    strength: Literal["strong", "weak"] = Field(
        default="strong", description="`strong` where a match that votes for it is."
    )
    verified_by: Verifier = Field(
        default="matches",
        description="`matches`: accepted matches agree, and no other pose comes near. `map`: the "
        "map's frames confirm it, where matches did not suffice. `prior`: they bear several poses "
        "out, and this is the one that the prior expects.",
    )
    rival_ratio: float | None = Field(
        default=None,
        description="How far the map bears out the best pose of another place, as a share of the "
        "best of all: 0 where nothing comes near, 1 where it is as good. Null where the map's "
        "frames were not asked.",
    )
    spread_m: float
    spread_deg: float
    uncertainty: Uncertainty | None = Field(default=None, description="Of `pose`.")
    base: Transform | None = Field(
        default=None,
        description="As `pose`, of the robot's base: where the query has T_base_sensor.",
    )


# Why a query found what it found, and not another frame, as JSON.

Outcome = Literal["accepted", "ambiguous", "rejected", "skipped", "not_selected", "ranked"]
Lost = Literal[
    "state", "query", "filter", "shortlist", "ranking", "selection", "turn", "deadline",
    "validation",
]  # fmt: skip


class Explanation(ApiRecord):
    """How far a frame of the ranking came."""

    frame_id: str
    map: str
    name: str | None = Field(default=None, description="Of the original file or message.")
    rank: int = Field(description="Place in the ranking R, from 1.")
    distance: int
    similarity: float
    stage: Stage = Field(description="The furthest that it came to.")
    outcome: Outcome = Field(
        description="`skipped`: a candidate that was not validated; `not_selected`: not a "
        "candidate; `ranked`: nothing but the ranking was asked for."
    )
    reason: str


class ExplainedFrame(ApiRecord):
    """Why one frame is, or is not, among the matches."""

    frame_id: str
    map: str
    name: str | None = Field(default=None, description="Of the original file or message.")
    state: str = Field(description="Of the frame; only indexed ones are searched.")
    passes_filter: bool | None = Field(description="Null where it is not searched at all.")
    distance: int | None = Field(description="Exact, whether or not the query compared it.")
    similarity: float | None
    rank: int | None = Field(
        description="From 1 among all frames that pass the filter, each compared exactly: where "
        "the frame itself does not pass, the rank it would have."
    )
    of: int | None = Field(description="How many frames pass the filter.")
    shortlisted: bool | None = Field(
        description="False where an approximate index missed a frame that is near enough to be "
        "ranked."
    )
    ranked: bool | None = Field(description="It is in the ranking R.")
    selected: bool | None = Field(
        description="It is a candidate: in the selection C, or without that stage of the first "
        "of R."
    )
    validation: Validation | None = Field(
        description="Of the alignment with it, made for this even if the query never came to it; "
        "null where validation was not asked for."
    )
    transform: Transform | None = Field(description="Query to the frame, of that alignment.")
    lost_at: Lost | None = Field(
        description="Where it was lost; null where it is a match. `turn`: enough were accepted "
        "before it; `query`: it is the query itself."
    )
    reason: str

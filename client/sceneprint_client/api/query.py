"""Records of queries, matches and answers. docs/evaluation.md explains the defaults."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import BeforeValidator, Field, StringConstraints, field_validator, model_validator

from sceneprint_client.api.base import ApiRecord, Given, GivenPose, Transform, Vector
from sceneprint_client.api.frames import Kind
from sceneprint_client.api.listing import Filter, parsed

Stage = Literal["retrieve", "diversify", "validate"]
STAGES: tuple[Stage, ...] = ("retrieve", "diversify", "validate")

#: Maximum number of maps in one query.
MOST_MAPS = 64

#: Name of a map or id of a frame in a request. The map or frame may not exist.
Named = Annotated[str, StringConstraints(min_length=1, max_length=128)]

#: Share of a whole, 0 to 1.
Share = Annotated[float, Field(ge=0.0, le=1.0)]

#: Validator that parses the JSON text of an object in a form or query string.
JsonText = BeforeValidator(parsed)


class NamedFrame(Given):
    """A stored frame in a request."""

    map: Named = Field(description="Name of the map.")
    frame_id: Named


class FrameName(ApiRecord):
    """A stored frame in a response."""

    map: str
    frame_id: str


class Diversity(Given):
    """Scales of the determinantal point process, Eq. 3 of the paper."""

    sigma: float = Field(
        default=1.0,
        ge=0.01,
        le=100.0,
        description="Factor of the median distance within the ranking. With a greater factor, more "
        "frames count as similar.",
    )
    omega: float = Field(
        default=4.0,
        ge=0.01,
        le=1000.0,
        description="Factor of the range of distances in the ranking. With a greater factor, "
        "diversity has more weight relative to rank.",
    )


class ValidationOptions(Given):
    """Requirements on accepted matches.

    Omitted options have the values of the map's model; the defaults below are those of `depth`.
    """

    mode: Literal["full", "paper"] = Field(
        default="full",
        description="`full`: apply all checks. `paper`: check only the residual between the two "
        "search directions; this mode accepts more wrong matches.",
    )
    residual_m: float = Field(
        default=0.08,
        gt=0,
        le=1.0,
        description="Maximum distance between the transforms of the two search directions, metres.",
    )
    residual_deg: float = Field(
        default=5.0,
        gt=0,
        le=45.0,
        description="Maximum angle between the transforms of the two search directions, degrees.",
    )
    evidence: Share = Field(
        default=0.2,
        description="Minimum value of `overlap` - `violation_weight` x `free_space_violations`. By "
        "default, half of this minimum is enough for a weak match if the frames have little "
        "surface in common but agree in all of it.",
    )
    violation_weight: float = Field(
        default=5.0, ge=0.0, le=100.0, description="Weight of `free_space_violations`."
    )
    plane_overlap: Share = Field(
        default=0.15, description="Minimum overlap, computed with the same weight for every plane."
    )
    strong: Share = Field(
        default=0.3, description="An accepted match with less evidence than this is weak."
    )
    weak: Share = Field(
        default=0.05, description="An accepted match with at least this `ambiguity` is weak."
    )
    ambiguous: Share = Field(
        default=0.14, description="A match with at least this `ambiguity` is not accepted."
    )
    ambiguous_share: float = Field(
        default=0.5,
        ge=0.0,
        le=10.0,
        description="A match is not accepted if its `ambiguity` is at least this share of its "
        "`plane_overlap`.",
    )


# Matches of a query.

ValidationStatus = Literal["accepted", "rejected", "ambiguous", "skipped"]


class Residual(ApiRecord):
    """Composition of the transforms of the two search directions; the identity if they agree."""

    translation_m: float
    rotation_deg: float


class Validation(ApiRecord):
    """The result of aligning the query with a match.

    Acceptance means that the two frames look alike, not that they show the same place. The
    `status` of the answer also considers the rest of the map.
    """

    status: ValidationStatus = Field(
        description="`skipped`: the match was not validated; see `reason`."
    )
    strength: Literal["strong", "weak"] | None = Field(
        default=None, description="Strength of an accepted match."
    )
    reason: str
    residual: Residual | None = None
    overlap: float | None = Field(
        default=None, description="Share of the points of both frames that agree."
    )
    plane_overlap: float | None = Field(
        default=None, description="`overlap`, computed with the same weight for every plane."
    )
    free_space_violations: float | None = Field(
        default=None,
        description="Share of points that the other frame saw through; null if neither frame has a "
        "viewpoint.",
    )
    planes: float | None = Field(
        default=None, description="Number of distinct planes that agree (mean of both frames)."
    )
    plane_violations: float | None = Field(
        default=None,
        description="`free_space_violations`, computed with the same weight for every plane.",
    )
    inliers: int | None = Field(
        default=None, description="Number of points of both frames that agree."
    )
    ambiguity: float | None = Field(
        default=None,
        description="Share of the points that the best alternative transform explains.",
    )
    search: Literal["correspondences", "plans", "guided"] | None = Field(
        default=None,
        description="Source of the transform. `correspondences`: patches with similar "
        "surroundings. `plans`: the plans of two scans. `guided`: other matches and the map's "
        "poses; the transform was refined and checked, but is not an independent vote.",
    )
    directions: list[Literal["query_to_match", "match_to_query"]] = Field(
        default=[],
        description="Search directions that found the transform. If there is only one, an accepted "
        "match is weak.",
    )
    tilt_deg: float | None = Field(
        default=None,
        description="Angle by which the transform tilts the query's `up` relative to the match's "
        "`up`; null if either is unknown.",
    )


class FreeDirection(ApiRecord):
    """A direction in which a transform is poorly constrained, for example along a corridor.

    The translation in metres and the rotation in radians together form a vector of unit length.
    """

    translation: Vector
    rotation: Vector
    deviation: float = Field(
        description="Standard deviation along the direction, metres for a translation and radians "
        "for a rotation; at most 10, the value if nothing constrains the direction."
    )


class Uncertainty(ApiRecord):
    """The likely error of a transform, provided that the transform is roughly right.

    Errors are (x, y, z, rx, ry, rz): the displacement of the child's origin along the axes of the
    transform's parent frame in metres, then a rotation vector about the parent's axes in radians,
    multiplied from the left. PoseWithCovariance in ROS has the same order and meaning.
    """

    covariance: list[float] = Field(
        min_length=36,
        max_length=36,
        description="6 x 6 covariance matrix, row by row, in the order x, y, z, rx, ry, rz.",
    )
    method: Literal["information-scaled", "votes-and-spread"] = Field(
        description="`information-scaled`, for one match: inverse information of the refinement, "
        "scaled to the errors in synthetic rooms. `votes-and-spread`, for several matches: their "
        "uncertainties and spread. See docs/uncertainty.md."
    )
    degenerate: list[FreeDirection] = Field(
        description="Directions at least 30 times as uncertain as the most certain one, most "
        "uncertain first."
    )


class Match(ApiRecord):
    """A database frame returned for a query."""

    frame_id: str
    map: str
    robot: str | None
    session: str | None
    name: str | None = Field(default=None, description="Name of the original file or message.")
    sequence: int | None = Field(default=None, description="Index in the session.")
    rank: int = Field(description="Position in the ranking R, from 1.")
    distance: int = Field(description="Distance between the signatures.")
    similarity: float = Field(
        description="Similarity, 0 to 1: 1 - distance / distance between unrelated frames."
    )
    selected: bool | None = Field(
        description="Whether the match is in the diverse selection C; null if that stage was not "
        "requested. If false, the match shows another place and was validated because it also "
        "resembles the query."
    )
    diversity_gain: float | None = Field(
        description="Diversity of the match: 1 for the first one, near 0 for a duplicate."
    )
    validation: Validation
    transform: Transform | None = Field(
        description="Transform from query to match. Use it only if the match is accepted."
    )
    predicted: Transform | None = Field(
        default=None,
        description="For a guided match, the prediction of `transform` from the map's poses and "
        "the earlier matches, with an error of up to 15 cm and 6 deg.",
    )
    parent_frame: str | None = Field(
        default=None,
        description="Parent frame of the frame's pose as uploaded; null if the frame has no pose. "
        "If the map joined this parent frame to another one, `pose_in_map` uses the other one.",
    )
    pose_in_map: Transform | None = Field(
        description="Pose of the query in the parent frame of the match's pose; null if the match "
        "has no pose or is rejected."
    )
    uncertainty: Uncertainty | None = Field(
        default=None, description="Uncertainty of `transform` for an accepted match."
    )
    base_in_map: Transform | None = Field(
        default=None,
        description="Pose of the robot's base in the parent frame of `pose_in_map`, if the query "
        "has `T_base_sensor`.",
    )


#: Evidence that decided on a pose.
Verifier = Literal["matches", "map", "prior"]


class EvidenceRecord(ApiRecord):
    """Evidence for and against a pose, the input of its `confidence`."""

    score: float = Field(
        description="Degree to which the map's frames confirm the pose: `share` minus the share "
        "that they saw through; at most 1."
    )
    share: float = Field(
        description="Share of the query's surface that the map contains at the pose; every plane "
        "has the same weight."
    )
    planes: float = Field(
        description="Number of distinct planes of the query that agree with the map."
    )
    frames: int = Field(description="Number of the map's frames that agree.")
    viewpoints: int = Field(description="Number of different viewpoints of the agreeing frames.")
    excess: float = Field(
        description="Share of the surface that should be visible in the query or the map but is "
        "missing, in excess of what is missing between the map's own frames."
    )
    weight: float = Field(
        description="Total weight of the matches that vote for the pose, with one match for each "
        "viewpoint. A strong match has the weight 1, a weak or ambiguous match 0.4."
    )
    strong: int = Field(
        description="Number of different viewpoints of strong matches that vote for the pose."
    )
    accepted: int = Field(
        description="Number of different viewpoints of accepted matches that lead to the pose, "
        "including guided ones."
    )
    suggested: int = Field(
        description="Number of different viewpoints of candidates that suggest the pose, accepted "
        "or not."
    )
    similarity: float = Field(
        description="Similarity of the signatures of the query and the most similar candidate that "
        "suggests the pose, 0 to 1."
    )
    rival: float = Field(
        description="Score of the best pose at another place, divided by `score`; 0 if there is no "
        "such pose. If the prior decided, only places that the prior expects are considered."
    )
    rival_weight: float = Field(
        description="Maximum weight of the matches that vote for another place."
    )
    distinctness: float = Field(
        default=0.0,
        description="Maximum, over the candidates that suggest the pose, of the ratio of the "
        "correlation of both scans' points above the ground at the pose to their correlation "
        "anywhere else; 0 if unknown. It is computed for scans that see all around and are some "
        "metres apart.",
    )
    rendered: bool = Field(
        default=False,
        description="Whether most of the frames that agree are rendered views of an imported map. "
        "For rendered views, the same evidence means a different confidence.",
    )


_CONFIDENCE = (
    "Probability that the pose is right, 0 to 1; null if the pose was not compared with the map."
)


class Alternative(ApiRecord):
    """A pose that the evidence supports. At most one of several alternatives is right."""

    pose: Transform
    confidence: float | None = Field(default=None, description=_CONFIDENCE)
    evidence: EvidenceRecord | None = Field(
        default=None,
        description="Evidence behind `confidence`; null if `confidence` is null.",
    )
    map: str | None = Field(default=None, description="Map of the pose's parent frame.")
    support: int = Field(
        description="Number of matches from different viewpoints that vote for the pose; 0 if only "
        "the map suggests it."
    )


class Location(ApiRecord):
    """The query's pose: a weighted mean over the accepted matches that agree on it."""

    pose: Transform
    confidence: float | None = Field(default=None, description=_CONFIDENCE)
    evidence: EvidenceRecord | None = Field(
        default=None,
        description="Evidence behind `confidence`; null if `confidence` is null.",
    )
    map: str | None = Field(default=None, description="Map of the matches.")
    support: int = Field(
        description="Number of matches that agree on the pose. 1 means a single view; 0 means that "
        "only the map confirms the pose."
    )
    guided: int = Field(
        default=0,
        description="Number of agreeing matches that were guided by other matches. Guided matches "
        "make the pose more precise, but are not independent evidence.",
    )
    votes: int = Field(description="Number of accepted matches, for any pose.")
    strength: Literal["strong", "weak"] = Field(
        default="strong", description="`strong` if a strong match votes for the pose."
    )
    verified_by: Verifier = Field(
        default="matches",
        description="`matches`: a strong match votes for the pose. `map`: no strong match does, "
        "but the map's frames confirm the pose. `prior`: the frames confirm several poses, and the "
        "prior expects this one.",
    )
    spread_m: float
    spread_deg: float
    uncertainty: Uncertainty | None = Field(default=None, description="Uncertainty of `pose`.")
    base: Transform | None = Field(
        default=None,
        description="Pose of the robot's base in the parent frame of `pose`, if the query has "
        "`T_base_sensor`.",
    )


# Explanations of the result of a query.

Outcome = Literal["accepted", "ambiguous", "rejected", "skipped", "not_selected", "ranked"]
Lost = Literal[
    "state", "query", "filter", "shortlist", "ranking", "selection", "turn", "deadline",
    "validation",
]  # fmt: skip


class Explanation(ApiRecord):
    """The last stage that a frame of the ranking reached, and the reason."""

    frame_id: str
    map: str
    name: str | None = Field(default=None, description="Name of the original file or message.")
    rank: int = Field(description="Position in the ranking R, from 1.")
    distance: int
    similarity: float
    stage: Stage = Field(description="Last stage that the frame reached.")
    outcome: Outcome = Field(
        description="`skipped`: a candidate that was not validated. `not_selected`: not a "
        "candidate. `ranked`: only the ranking was requested."
    )
    reason: str


class ExplainedFrame(ApiRecord):
    """Reason why a frame is, or is not, among the matches."""

    frame_id: str
    map: str
    name: str | None = Field(default=None, description="Name of the original file or message.")
    state: str = Field(description="State of the frame. Only indexed frames are searched.")
    passes_filter: bool | None = Field(
        description="Whether the frame matches the filter; null if the frame is not searchable."
    )
    distance: int | None = Field(
        description="Exact distance, whether or not the query computed it."
    )
    similarity: float | None
    rank: int | None = Field(
        description="Rank from 1 among all frames that match the filter, by exact distance. For a "
        "frame that does not match, the rank that it would have."
    )
    of: int | None = Field(description="Number of frames that match the filter.")
    shortlisted: bool | None = Field(
        description="False if the approximate index missed the frame although it is near enough "
        "for the ranking."
    )
    ranked: bool | None = Field(description="Whether the frame is in the ranking R.")
    selected: bool | None = Field(
        description="Whether the frame is a candidate: in the selection C or, if that stage was "
        "not requested, among the first frames of R."
    )
    validation: Validation | None = Field(
        description="Validation of the frame, computed for this explanation even if the query did "
        "not reach it; null if validation was not requested."
    )
    transform: Transform | None = Field(description="Transform from the query to the frame.")
    lost_at: Lost | None = Field(
        description="Stage at which the frame was dropped; null for a match. `turn`: enough frames "
        "were accepted before this one, or `k` other frames are listed before it. `query`: the "
        "frame is the query itself."
    )
    reason: str


# Queries and answers.

AnswerStatus = Literal["found", "ambiguous", "not_found", "unvalidated"]
#: Maximum number of frames of a sequence in one query.
MOST_OF_SEQUENCE = 10
#: Minimum and maximum deviations of a prior, metres and radians. Other values are meaningless or
#: cause numerical errors.
LEAST_DEVIATION, MOST_DEVIATION = 1e-6, 1000.0
#: Maximum distance of a prior from the origin of its parent frame, metres.
FARTHEST_PRIOR = 1e9
#: Most likely causes of an answer `not_found`.
Cause = Literal[
    "no_frames", "deadline", "too_little_in_view", "one_plane", "gravity", "other_sensor", "scale",
    "nothing_alike",
]  # fmt: skip


class Prior(Given):
    """The expected pose of a robot, T_parent_query, and its uncertainty."""

    pose: GivenPose = Field(
        description="Pose of the query's sensor in a parent frame of the map. `parent_frame` "
        f"is required. Each coordinate is at most {FARTHEST_PRIOR:,.0f} m from the origin."
    )
    covariance: Annotated[list[float], Field(min_length=36, max_length=36)] | None = Field(
        default=None,
        description="6 x 6 covariance matrix, row by row, of the errors (x, y, z, rx, ry, rz) "
        "along the parent's axes in metres and radians, as in PoseWithCovariance in ROS. The "
        f"square roots of its diagonal must be between {LEAST_DEVIATION} and {MOST_DEVIATION:.0f}.",
    )
    deviation_m: float = Field(
        default=0.3,
        ge=LEAST_DEVIATION,
        le=20,
        description="Standard deviation along each axis, metres; used if there is no `covariance`.",
    )
    deviation_deg: float = Field(
        default=10.0,
        ge=1e-4,
        le=180,
        description="Standard deviation about each axis, degrees; used if there is no "
        "`covariance`.",
    )

    @model_validator(mode="after")
    def _require_parent_frame(self) -> Prior:
        if self.pose.parent_frame is None:
            raise ValueError(
                "a prior requires pose.parent_frame, a parent frame of the map's poses"
            )
        if self.pose.of != "sensor":
            raise ValueError("a prior is a pose of the sensor: omit `of`")
        return self


class Query(Given):
    """Options of a query, for an uploaded or a stored frame."""

    k: int = Field(
        default=5,
        ge=1,
        le=50,
        description="Maximum number of accepted matches in the answer or, without validation, of "
        "all matches. Status and pose do not depend on `k`; they use the first 5 accepted matches.",
    )
    stages: tuple[Stage, ...] = Field(
        default=STAGES,
        description="Stages in order, starting with `retrieve`. The paper calls the combinations "
        "R, DR, VR and VDR.",
    )
    exact: bool = Field(
        default=False,
        description="Whether to compare every frame that matches the filter. By default, only "
        "queries in large maps skip some frames.",
    )
    filter: Filter | None = Field(
        default=None,
        description="Conditions on the searched frames. A narrow filter does not shorten the "
        "ranking.",
    )
    seed: int = Field(
        default=0,
        ge=0,
        lt=2**32,
        description="Seed for the random choices. The answer contains the same seed.",
    )
    candidates: int | None = Field(
        default=None,
        ge=1,
        le=200,
        description="Maximum number of frames of the ranking that are selected and validated, at "
        "approximately 20 ms per frame; default: 10, or `k` if it is greater. Validation ends when "
        "5 frames, or `k` if it is greater, are accepted. Without validation, `k` applies instead.",
    )
    diversity: Annotated[Diversity | None, JsonText] = Field(
        default=None, description="Scales of the diverse selection."
    )
    validation: Annotated[ValidationOptions | None, JsonText] = Field(
        default=None, description="Requirements on accepted matches."
    )
    prior: Annotated[Prior | None, JsonText] = Field(
        default=None,
        description="Expected pose of the robot. Candidates near this pose are tried first, and "
        "the pose is refined on the map in addition to the global search. The prior decides only "
        "between poses that the map supports equally.",
    )
    confidence: float = Field(
        default=0.99,
        ge=0.5,
        le=0.999,
        description="Minimum confidence of a `found` pose. All other places together have at most "
        "the remaining probability.",
    )
    deadline_ms: int | None = Field(
        default=None,
        ge=1,
        le=600_000,
        description="Time limit from the arrival of the request. Candidates that would probably "
        "exceed the limit are not validated; ranking and selection are always completed.",
    )
    explain: bool = Field(
        default=False,
        description="Whether to explain which stage each frame of the ranking reached.",
    )
    explain_frame: Named | None = Field(
        default=None,
        description="Id of a frame of the map whose result is explained. The frame is compared and "
        "validated even if the query did not reach it. If several maps are queried, the first "
        "frame with this id is used.",
    )
    keep: bool = Field(
        default=True,
        description="Whether to store the answer for GET /v1/queries/{query_id}.",
    )
    record: bool = Field(
        default=True,
        description="Whether to list the query in GET /v1/queries, send an event for it, and count "
        "it.",
    )

    @field_validator("stages", mode="before", json_schema_input_type=str | tuple[Stage, ...])
    @classmethod
    def _from_text(cls, stages: object) -> object:
        """Split the comma-separated stages of a form or a command line."""
        if isinstance(stages, str):
            return [stage.strip() for stage in stages.split(",")]
        if isinstance(stages, list | tuple):
            return stages
        # The message of pydantic would mention tuples.
        raise ValueError("must be a list of stages, or a text with stages separated by commas")

    @field_validator("filter", mode="before", json_schema_input_type=str | Filter | None)
    @classmethod
    def _from_json(cls, value: object) -> object:
        return parsed(value)

    @field_validator("stages")
    @classmethod
    def _require_order(cls, stages: tuple[Stage, ...]) -> tuple[Stage, ...]:
        if stages != tuple(stage for stage in STAGES if stage in stages) or not stages:
            raise ValueError("list stages once, in the order retrieve, diversify, validate")
        if stages[0] != "retrieve":
            raise ValueError("every query starts with retrieve")
        return stages


class SeveralQuery(Query):
    """Options of a query in several maps of one model."""

    maps: Literal["*"] | Annotated[list[Named], Field(min_length=1, max_length=MOST_MAPS)] = Field(
        description=f"Names of at most {MOST_MAPS} maps, or `*` for all maps that you may read. In "
        "forms and query strings, separate the names with commas."
    )
    frame: NamedFrame | None = Field(
        default=None,
        description="Stored frame to query instead of an upload. The frame is not compared with "
        "itself.",
    )
    query_id: str | None = Field(
        default=None,
        description="Id of an earlier query to repeat instead of an upload. Its stored frame is "
        "queried again with these options; the new answer has its own id.",
    )

    @field_validator("maps", mode="before")
    @classmethod
    def _split(cls, maps: object) -> object:
        if isinstance(maps, str) and maps.strip() != "*":
            return [name.strip() for name in maps.split(",")]
        return maps.strip() if isinstance(maps, str) else maps


class Counts(ApiRecord):
    """Number of frames at each stage."""

    map: int = Field(description="Number of searchable frames in the map.")
    passed: int = Field(
        description="Number of searchable frames that match the filter; equals `map` without a "
        "filter."
    )
    compared: int = Field(description="Number of frames whose distance was computed.")
    ranked: int
    selected: int
    validated: int
    accepted: int


class OfMap(ApiRecord):
    """The result of a query in one of several maps."""

    index_version: int = Field(
        description="Version of the index that was searched; 0 if this node has no index."
    )
    counts: Counts


class Answer(ApiRecord):
    """The answer to a query."""

    query_id: str
    status: AnswerStatus = Field(
        description="`found`: the confidence of one pose reaches the `confidence` of the query or, "
        "if no accepted match has a pose, at least one match is accepted. `ambiguous`: the "
        "evidence supports one or several poses, but none with this confidence; never navigate by "
        "them. `not_found`: the evidence supports no pose; see `cause`. `unvalidated`: validation "
        "was not requested, or the deadline passed before a match was accepted."
    )
    reason: str = Field(
        default="",
        description="Explanation in one sentence, with advice if the status is `not_found`.",
    )
    cause: Cause | None = Field(
        default=None, description="Most likely cause if the status is `not_found`."
    )
    matches: list[Match] = Field(
        description="Accepted matches, followed by the other validated matches. Strong matches "
        "precede weak ones; within each group, the most precise matches are first (for full-turn "
        "scans, the nearest)."
    )
    location: Location | None = Field(
        description="Pose of the query if the answer is `found` and the matches have poses."
    )
    alternatives: list[Alternative] = Field(
        default=[],
        description="Poses of an `ambiguous` answer that the evidence supports, best first.",
    )
    seed: int
    model: str
    index_version: int = Field(
        description="Version of the index that was searched; 0 for a small map, a search by "
        "PostgreSQL, or a model that stores psi. If several maps were searched, the minimum of "
        "their versions."
    )
    exact: bool = Field(description="Whether every frame that matches the filter was compared.")
    counts: Counts
    milliseconds: dict[str, float] = Field(
        description="Duration of each stage: `prepare` (signature and geometry of the query), "
        "`retrieve`, `diversify`, `validate`, `locate`, `explain` if requested, `earlier` for the "
        "earlier frames of a sequence, and `total`."
    )
    maps: list[str] = Field(default=[], description="Names of the searched maps.")
    frame: FrameName | None = Field(
        default=None,
        description="Stored frame of the query; null for an upload. In transforms, its sensor is "
        "named after the id of the frame if only the map of the frame was searched, and `query` "
        "otherwise.",
    )
    kind: Kind = Field(
        default="depth",
        description="Kind of the query's frame. In transforms, the sensor of a depth image is "
        "`ID.optical` (x right, y down, z forward), and the sensor of a cloud is `ID.sensor`, with "
        "the cloud's own axes.",
    )
    frames: int = Field(
        default=1,
        description="Number of frames in the query. For a sequence, `matches` are those of the "
        "last frame.",
    )
    per_map: dict[str, OfMap] | None = Field(
        default=None, description="Result for each map; null if only one map was searched."
    )
    deadline_reached: bool | None = Field(
        default=None,
        description="Whether candidates were skipped because of the deadline; null if there was no "
        "deadline.",
    )
    explanations: list[Explanation] | None = Field(
        default=None,
        description="Explanations of all frames of the ranking, nearest first, if `explain` was "
        "requested.",
    )
    explained_frame: ExplainedFrame | None = Field(
        default=None, description="Explanation of the frame in `explain_frame`."
    )


# The pose of a robot in one record.

LocalizationStatus = Literal["found", "ambiguous", "not_found"]


class Localization(ApiRecord):
    """The pose of the query and its reliability."""

    status: LocalizationStatus = Field(
        description="`found`: the confidence of one pose reaches the `confidence` of the query. "
        "`ambiguous`: no pose reaches this confidence; see `alternatives`, move, and query again. "
        "`not_found`: the evidence supports no pose, or the deadline passed; see `cause`."
    )
    reason: str
    cause: Cause | None = Field(
        default=None, description="Most likely cause if the status is `not_found`."
    )
    map: str
    pose: Transform | None = Field(
        description="T_parent_query, the pose of the query's sensor in the parent frame of its "
        "matches' poses. Null if the status is not `found` or no accepted match has a pose; see "
        "`best`."
    )
    confidence: float | None = Field(
        default=None,
        description="Probability that `pose`, or for `ambiguous` the first alternative, is right, "
        "0 to 1. Null if there is no pose, or if the pose was not compared with the map.",
    )
    evidence: EvidenceRecord | None = Field(
        default=None,
        description="Evidence behind `confidence`; null if `confidence` is null.",
    )
    support: int = Field(
        description="Number of matches that agree on the pose. 1 means a single view; 0 means that "
        "only the map confirms the pose."
    )
    votes: int = Field(description="Number of accepted matches, for any pose.")
    spread_m: float | None = Field(
        description="Spread of the votes, metres; null if there is no pose."
    )
    spread_deg: float | None
    uncertainty: Uncertainty | None = Field(default=None, description="Uncertainty of `pose`.")
    base: Transform | None = Field(
        default=None,
        description="Pose of the robot's base in the parent frame of `pose`, if the query has "
        "`T_base_sensor`.",
    )
    strength: Literal["strong", "weak"] | None = Field(
        description="`strong` if a strong match votes for the pose; null if the status is not "
        "`found`."
    )
    verified_by: Verifier | None = Field(
        default=None,
        description="Evidence that decided on the pose, as in `location`; null if the status is "
        "not `found`.",
    )
    alternatives: list[Alternative] = Field(
        default=[],
        description="Poses of an `ambiguous` answer that the evidence supports, best first.",
    )
    best: Match | None = Field(description="Best accepted match, with its transform.")
    matches: list[str] = Field(description="Ids of the accepted matches, best first.")
    frames: int = Field(
        default=1, description="Number of frames in the query, including all frames of a sequence."
    )
    query_id: str
    seed: int
    model: str
    deadline_reached: bool | None = None
    milliseconds: dict[str, float]

"""What can be looked at after a query, as JSON."""

from __future__ import annotations

import math
from datetime import datetime, timezone
from typing import Annotated, Any, Literal

from pydantic import AwareDatetime, Field, StringConstraints, model_validator

from sceneprint_client.api.base import (
    ApiRecord,
    Given,
    GivenQuaternion,
    GivenVector,
    Label,
    Note,
    Quaternion,
    Transform,
    Vector,
)
from sceneprint_client.api.frames import FRAME_ID, Kind
from sceneprint_client.api.maps import Preset, Slug
from sceneprint_client.api.query import (
    MOST_MAPS,
    FrameName,
    JsonText,
    NamedFrame,
    Uncertainty,
    Validation,
    ValidationOptions,
)

# How a query was asked, as JSON: so that it can be understood, and asked again.


class Question(ApiRecord):
    """What was asked, and how."""

    query_id: str
    maps: list[str] = Field(description="The maps that were asked.")
    frame: FrameName | None = Field(
        description="The stored frame that was asked for; null for an upload."
    )
    kind: Kind = Field(description="Of the frame that was asked for.")
    robot: str | None = Field(description="Who took an uploaded frame, as it was told.")
    session: str | None
    asked_at: str = Field(description="When, in UTC.")
    validates: bool = Field(
        description="Its points are kept, so that it can be asked again with the stage `validate`."
    )
    model: str
    options: dict[str, Any] = Field(
        description="As they were given; what was left out had its default."
    )


# What is left of a query for longer than its answer, as JSON.

#: What came of a query: the status of its answer, or that there was none.
RecordStatus = Literal["found", "ambiguous", "not_found", "unvalidated", "failed"]
RECORD_STATUSES: tuple[RecordStatus, ...] = (
    "found", "ambiguous", "not_found", "unvalidated", "failed"
)  # fmt: skip


class RecordedPose(ApiRecord):
    """T_parent_query, metres and a unit quaternion."""

    parent_frame: str
    translation: Vector
    rotation: Quaternion


class KeepOptions(Given):
    """How to keep an answer."""

    title: Note | None = Field(default=None, description="For people.")
    until: AwareDatetime | None = Field(
        default=None,
        description="It is released then; with a time zone. Default: it is kept until it is "
        "released.",
    )


class AnswerRetention(ApiRecord):
    """For how long an answer can be looked at."""

    query_id: str
    kept: bool = Field(description="Whether somebody keeps it.")
    title: str | None = None
    kept_at: datetime | None = Field(default=None, description="Since when it is kept.")
    until: datetime | None = Field(
        default=None,
        description="When it goes, or earlier where room is needed; of a kept one when it is "
        "released: null, not by itself.",
    )


class KeptAnswer(ApiRecord):
    """How an answer is kept beyond its hour."""

    title: str | None
    kept_at: datetime
    until: datetime | None = Field(description="When it is released; null: not by itself.")
    bytes: int


class QueryRecord(ApiRecord):
    """What came of a query, in short; nothing of what its frame shows."""

    query_id: str = Field(description="GET /v1/queries/{query_id} has the answer while it is kept.")
    at: datetime = Field(description="When the query came.")
    map: str = Field(
        description="Of several maps that were asked: the one it was found in, that of the first "
        "alternative or match, or the first that was named."
    )
    maps: list[str] = Field(description="Those that were asked and that you may read.")
    robot: str | None = Field(description="Who asked, as far as the query said.")
    session: str | None
    key: str | None = Field(description="Name of the key that was shown; null without one.")
    status: RecordStatus = Field(
        description="Of the answer. `failed`: there was none, and `reason` says why."
    )
    cause: str | None = Field(
        description="Of `not_found`, and of a deadline, as in the answer; of `failed` the type of "
        "the problem, such as `busy`."
    )
    reason: str
    pose: RecordedPose | None = Field(description="Of `found`, where the matches have poses.")
    support: int | None = Field(description="Matches that agree on `pose`.")
    rival_ratio: float | None = Field(description="How near another place comes, 0 to 1.")
    alternatives: int = Field(description="Of `ambiguous`: poses that the evidence supports.")
    milliseconds: float
    kind: Kind | None = Field(description="Of the frame; null where it was not read.")
    frame: FrameName | None = Field(
        description="The stored frame that was asked for; null for an upload, and where you may "
        "not read its map."
    )
    kept_until: datetime | None = Field(
        description="The answer is kept until then, while there is room; null: not any more, or "
        "it never was. See also `keep`."
    )
    keep: KeptAnswer | None = Field(
        default=None, description="Where somebody keeps the answer for longer."
    )
    offline: bool = Field(
        default=False,
        description="The robot answered the query itself, from a copy of the map, and sent this "
        "record later. The service never had the answer.",
    )


# Records of queries that a robot answered itself, as JSON.

#: Most records in one request.
MOST_OF_RECORDS = 100
#: Characters of a record's reason; that of an answer has some 200.
MOST_REASON = 1000
#: Longest that a query may have taken, milliseconds: a day.
MOST_MS = 86_400_000.0
#: Farthest place of a pose along each axis, metres, and what a quaternion's norm may miss 1 by.
FARTHEST_POSE, NORM_TOLERANCE = 1e9, 1e-3
#: Most matches or alternatives that a record may count.
MOST_COUNTED = 1_000_000


class NewRecordedPose(Given):
    """T_parent_query, metres and a unit quaternion."""

    parent_frame: Label
    translation: GivenVector
    rotation: GivenQuaternion

    @model_validator(mode="after")
    def _is_pose(self) -> NewRecordedPose:
        t, r = self.translation, self.rotation
        if max(abs(t.x), abs(t.y), abs(t.z)) > FARTHEST_POSE:
            raise ValueError(f"farther than {FARTHEST_POSE:g} m from the origin")
        if abs(math.hypot(r.x, r.y, r.z, r.w) - 1.0) > NORM_TOLERANCE:
            raise ValueError("its rotation is not a unit quaternion")
        return self


class NewRecordedFrame(Given):
    """The stored frame that was asked for."""

    map: Slug
    frame_id: Annotated[str, StringConstraints(pattern=f"^{FRAME_ID}$")]


class NewQueryRecord(Given):
    """What came of a query that a robot answered itself; fields as in QueryRecord."""

    query_id: Annotated[str, StringConstraints(pattern=r"^[0-9a-f]{32}$")]
    at: AwareDatetime = Field(
        description="When the query came, on the robot's clock. The service stores a time in the "
        "future as that of the request."
    )
    maps: Annotated[list[Slug], Field(min_length=1, max_length=MOST_MAPS)] | None = Field(
        default=None, description="All that were asked, if more than this map."
    )
    robot: Label | None = None
    session: Label | None = None
    status: RecordStatus
    cause: Annotated[str, StringConstraints(pattern=r"^[a-z0-9_-]{1,64}$")] | None = None
    reason: Annotated[str, StringConstraints(max_length=MOST_REASON, pattern=r"^[^\x00]*$")]
    pose: NewRecordedPose | None = None
    support: int | None = Field(default=None, ge=0, le=MOST_COUNTED)
    rival_ratio: float | None = Field(default=None, ge=0, le=MOST_COUNTED)
    alternatives: int = Field(default=0, ge=0, le=MOST_COUNTED)
    milliseconds: float = Field(ge=0, le=MOST_MS)
    kind: Kind | None = None
    frame: NewRecordedFrame | None = None

    @model_validator(mode="after")
    def _is_consistent(self) -> NewQueryRecord:
        if self.pose is not None and self.status != "found":
            raise ValueError(f"pose: of a query that was {self.status}; only `found` has one")
        try:  # as it will be told
            datetime.fromtimestamp(self.at.timestamp(), timezone.utc)
        except (ValueError, OverflowError) as error:
            raise ValueError("at: not within the years 1 to 9999 of UTC") from error
        return self


class NewQueryRecords(Given):
    """Records of queries of one map."""

    records: list[NewQueryRecord] = Field(min_length=1, max_length=MOST_OF_RECORDS)

    @model_validator(mode="after")
    def _once_each(self) -> NewQueryRecords:
        ids = {one.query_id for one in self.records}
        if len(ids) < len(self.records):
            raise ValueError("records: a `query_id` is there twice")
        return self


class RefusedRecord(ApiRecord):
    """A record that the service did not store, and why."""

    query_id: str
    reason: str


class QueryRecordsAdded(ApiRecord):
    """What came of some records; each is counted or named once."""

    received: int = Field(description="Stored.")
    there: int = Field(description="Stored before, with the same content.")
    expired: int = Field(description="Older than the service keeps records, and so not stored.")
    refused: list[RefusedRecord] = Field(
        description="Not stored: the id belongs to another record, or the query is older than the "
        "map."
    )


# What a frame is made of, as JSON.

#: In which coordinates a frame's cloud is told.
CloudFrame = Literal["optical", "parent", "base"]
CLOUD_FRAMES: tuple[CloudFrame, ...] = ("optical", "parent", "base")

#: What a picture of a frame shows.
View = Literal["depth", "normals", "patches"]
VIEWS: tuple[View, ...] = ("depth", "normals", "patches")
#: Least and most columns of a picture, and how many it has by default.
WIDTHS = (64, 1280)
WIDTH = 320

#: Points of a surface that are sent to be drawn, unless another number is asked for.
MOST_DRAWN = 20_000

Triple = tuple[float, float, float]


class PatchLevel(ApiRecord):
    """Surface patches, a place in each list for each of them.

    Metres are rounded to a tenth of a millimetre, normals to four digits, areas to a tenth of a
    square centimetre.
    """

    mean: list[Triple] = Field(description="x, y, z in metres.")
    normal: list[Triple] = Field(description="Unit length, towards the sensor.")
    area_m2: list[float]
    size: list[int] = Field(description="Pixels of the surface map, which is about 160 x 120.")


class FramePatches(ApiRecord):
    """The patches of a frame, as its model segments it."""

    frame_id: str
    map: str
    frame: str = Field(description="Frame of the coordinates: the sensor's.")
    model: str
    levels: list[PatchLevel] = Field(
        description="The hierarchy that the signature describes, the finest first."
    )
    validation: PatchLevel = Field(description="The patches that matches are validated with.")


class FrameSignature(ApiRecord):
    """The signature of a frame."""

    frame_id: str
    map: str
    model: str
    model_id: str = Field(description="Signatures of two models are never compared.")
    dtype: Literal["uint8"] = "uint8"
    length: int = Field(description="Bytes.")
    n_patches: list[int] = Field(description="Of each level, the finest first.")
    n_pairs: list[int] = Field(description="Ordered pairs of patches of each level.")
    base64: str = Field(description="The bytes. Compare two by the sum of absolute differences.")


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


class Similarities(ApiRecord):
    """How alike a query and the frames of its ranking are, each to each: for a heat map."""

    query_id: str
    model: str
    frames: list[FrameName] = Field(
        description="Of the ranking, the nearest first; those deleted since are left out."
    )
    names: list[str | None] = Field(
        default=[], description="What the files of `frames` were called, in their order."
    )
    similarity: list[list[float]] = Field(
        description="1 - distance / that of unrelated frames, 0 to 1. The first row and column are "
        "the query's, the others those of `frames`, in their order."
    )


class Coincidences(ApiRecord):
    """Patches of both frames that coincide under the transform, a place in each list for each."""

    query: list[int] = Field(description="Index among the query's validation patches.")
    match: list[int] = Field(description="Index among the match's: see its `/patches`.")
    query_mean: list[Triple] = Field(description="Metres, in the query's sensor's frame.")
    query_normal: list[Triple]
    match_mean: list[Triple] = Field(description="Metres, in the match's sensor's frame.")
    match_normal: list[Triple]
    distance_m: list[float] = Field(description="Between the means under the transform, rising.")


class Points(ApiRecord):
    """Points of one frame, in its own sensor's frame, that evidence is counted on."""

    sampled: int = Field(description="How many were looked up in the other frame.")
    inliers: list[Triple] = Field(
        description=f"They lie on the other's surface; {MOST_POINTS} at most."
    )
    violations: list[Triple] = Field(
        description=f"They lie where the other saw through; {MOST_POINTS} at most."
    )


class MatchDetails(ApiRecord):
    """One match of a query, validated once more as the query had it, with what it rests on."""

    query_id: str
    frame_id: str
    map: str
    name: str | None = Field(default=None, description="Of the original file or message.")
    sequence: int | None = Field(default=None, description="Place within the session.")
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


# Two frames compared, as JSON.


class Comparison(Given):
    """Which frames to compare, and how."""

    frame_a: Annotated[NamedFrame | None, JsonText] = Field(
        default=None, description="A stored frame, in place of an upload `a`."
    )
    frame_b: Annotated[NamedFrame | None, JsonText] = Field(
        default=None, description="A stored frame, in place of an upload `b`."
    )
    aligned: bool = Field(
        default=True,
        alias="validate",
        description="Align them, and say whether they see one place.",
    )
    validation: Annotated[ValidationOptions | None, JsonText] = Field(
        default=None, description="What the alignment must stand to be accepted."
    )
    seed: int = Field(
        default=0, ge=0, lt=2**32, description="Of the random choices; the answer echoes it."
    )
    model: Preset | None = Field(
        default=None,
        description="That signs two uploads; default: `depth`; of a LiDAR, `lidar`. A stored frame "
        "brings its own.",
    )


class Similarity(ApiRecord):
    """How alike two frames are."""

    distance: int = Field(
        description="Of their signatures: squared L2, or L1 where psi itself is stored."
    )
    similarity: float = Field(description="1 - distance / that of unrelated frames, 0 to 1.")
    model: str
    a: FrameName | None = Field(description="The stored frame; null for an upload.")
    b: FrameName | None
    validation: Validation | None = Field(description="Null where it was not asked for.")
    transform: Transform | None = Field(
        description="x_a = matrix @ x_b; believe it where the validation accepts it."
    )
    uncertainty: Uncertainty | None = Field(
        default=None, description="Of `transform`, where the validation accepts it."
    )
    seed: int
    milliseconds: dict[str, float] = Field(
        description="`prepare` (both frames), `validate`, `total`."
    )

"""Past queries, and what can be looked at after one, as JSON."""

from __future__ import annotations

from datetime import datetime
from typing import Annotated, Any, Literal

from pydantic import Field

from sceneprint_client.api.base import (
    ApiRecord,
    Given,
    Note,
    Quaternion,
    Transform,
    Vector,
)
from sceneprint_client.api.frames import Kind
from sceneprint_client.api.maps import Preset
from sceneprint_client.api.query import (
    FrameName,
    JsonText,
    NamedFrame,
    Uncertainty,
    Validation,
    ValidationOptions,
)

# Past queries.

#: The outcome of a query: the status of its answer, or that there was none.
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

    title: Note | None = Field(default=None, description="A label for people.")


class QueryRecord(ApiRecord):
    """A past query and its outcome; nothing of what its frame shows."""

    query_id: str = Field(
        description="While `stored` is true, GET /v1/queries/{query_id} returns the answer."
    )
    at: datetime = Field(description="When the query came.")
    map: str = Field(
        description="Of several maps that were searched: the one it was found in, that of the "
        "first alternative or match, or the first that was named."
    )
    maps: list[str] = Field(description="All maps that were searched and that you may read.")
    robot: str | None = Field(description="Who sent it, if the query said so.")
    session: str | None
    key: str | None = Field(description="Name of the API key; null without one, or once revoked.")
    status: RecordStatus = Field(
        description="Of the answer. `failed`: there was none, and `reason` says why."
    )
    cause: str | None = Field(
        description="Of `not_found`, and of a deadline, as in the answer; of `failed` the type of "
        "the problem, such as `busy`."
    )
    reason: str
    pose: RecordedPose | None = Field(description="Of `found`, where the matches have poses.")
    confidence: float | None = Field(
        description="Probability that `pose` is right, or of `ambiguous` the best alternative; "
        "null where the map was not asked."
    )
    support: int | None = Field(description="Number of matches that agree on `pose`.")
    alternatives: int = Field(
        description="Of `ambiguous`: number of poses that the evidence supports."
    )
    milliseconds: float
    kind: Kind | None = Field(description="Of the frame; null where it was not read.")
    frame: FrameName | None = Field(
        description="The stored frame that was the query; null for an upload, and where you may "
        "not read its map."
    )
    stored: bool = Field(description="Whether the answer can still be looked at.")
    expires_at: datetime | None = Field(
        description="When the record and the answer are removed; the answer earlier where room is "
        "needed. Null: the answer is kept."
    )
    kept_at: datetime | None = Field(description="Since when somebody keeps the answer.")
    title: str | None = Field(description="Of a kept answer.")


class StoredQuery(QueryRecord):
    """A past query whose answer is stored, and how it was sent."""

    validates: bool = Field(
        description="Its points are stored, so that it can be repeated with the stage `validate`."
    )
    model: str
    options: dict[str, Any] = Field(
        description="The options that the request set. Every other option had its default."
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
        description="x_a = matrix @ x_b. Where the validation accepts it, it is right if the two "
        "frames are of one place, which a pair alone cannot show."
    )
    uncertainty: Uncertainty | None = Field(
        default=None, description="Of `transform`, where the validation accepts it."
    )
    seed: int
    milliseconds: dict[str, float] = Field(
        description="`prepare` (both frames), `validate`, `total`."
    )

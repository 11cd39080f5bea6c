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
    """Options of keeping an answer."""

    title: Note | None = Field(default=None, description="A label for people.")


class QueryRecord(ApiRecord):
    """A past query and its outcome, without the content of its frame."""

    query_id: str = Field(
        description="GET /v1/queries/{query_id} returns the answer while `stored` is true."
    )
    at: datetime = Field(description="Time of the query.")
    map: str = Field(
        description="If several maps were searched: the map in which the query was found, that "
        "of the first alternative or match, or the first in the request."
    )
    maps: list[str] = Field(description="All maps that were searched and that you may read.")
    robot: str | None = Field(description="Robot that sent it, if the query named it.")
    session: str | None
    key: str | None = Field(
        description="Name of the API key; null without one, or after its revocation."
    )
    status: RecordStatus = Field(
        description="Status of the answer. `failed`: there was no answer, and `reason` says why."
    )
    cause: str | None = Field(
        description="Cause of `not_found`, or of a deadline, as in the answer; for `failed`, "
        "the type of the problem, such as `busy`."
    )
    reason: str
    pose: RecordedPose | None = Field(description="Pose if `found` and the matches have poses.")
    confidence: float | None = Field(
        description="Probability that `pose`, or the best alternative, is right; null if the "
        "pose was not compared with the map."
    )
    support: int | None = Field(description="Number of matches that agree on `pose`.")
    alternatives: int = Field(
        description="If `ambiguous`: number of poses that the evidence supports."
    )
    milliseconds: float
    kind: Kind | None = Field(description="Kind of the frame; null if it was not read.")
    frame: FrameName | None = Field(
        description="The stored frame of the query; null for an upload, and if you may not read "
        "its map."
    )
    stored: bool = Field(description="Whether the answer is still stored.")
    expires_at: datetime | None = Field(
        description="Time at which the record and the answer are removed; the answer may be "
        "removed earlier to make room. Null for a kept answer."
    )
    kept_at: datetime | None = Field(description="Time since which the answer is kept.")
    title: str | None = Field(description="Title of a kept answer.")


class StoredQuery(QueryRecord):
    """A past query whose answer is stored, with its options."""

    validates: bool = Field(
        description="Whether its points are stored, so that it can be repeated with the stage "
        "`validate`."
    )
    model: str
    options: dict[str, Any] = Field(
        description="Options that the request set; the others had their defaults."
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
    """Surface patches. Each list has one entry for each patch.

    Metres are rounded to a tenth of a millimetre, normals to four digits, areas to a tenth of a
    square centimetre.
    """

    mean: list[Triple] = Field(description="x, y, z in metres.")
    normal: list[Triple] = Field(description="Unit length, towards the sensor.")
    area_m2: list[float]
    size: list[int] = Field(
        description="Number of pixels of the surface map, which is about 160 x 120."
    )


class FramePatches(ApiRecord):
    """The patches of a frame, as its model segments them."""

    frame_id: str
    map: str
    frame: str = Field(description="Name of the sensor's frame, in which the coordinates are.")
    model: str
    levels: list[PatchLevel] = Field(
        description="The hierarchy that the signature describes, the finest first."
    )
    validation: PatchLevel = Field(description="The patches used to validate matches.")


class FrameSignature(ApiRecord):
    """The signature of a frame."""

    frame_id: str
    map: str
    model: str
    model_id: str = Field(
        description="Id of the model. Signatures of different models cannot be compared."
    )
    dtype: Literal["uint8"] = "uint8"
    length: int = Field(description="Number of bytes.")
    n_patches: list[int] = Field(description="Number of patches at each level, the finest first.")
    n_pairs: list[int] = Field(description="Number of ordered pairs of patches at each level.")
    base64: str = Field(
        description="The bytes of the signature. Compare two by the sum of absolute differences."
    )


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
    """Similarities of a query and the frames of its ranking, each to each, for a heat map."""

    query_id: str
    model: str
    frames: list[FrameName] = Field(
        description="Frames of the ranking, the nearest first, without those deleted since."
    )
    names: list[str | None] = Field(
        default=[], description="Names of the files of `frames`, in their order."
    )
    similarity: list[list[float]] = Field(
        description="1 - distance / distance of unrelated frames, 0 to 1. The first row and "
        "column are the query's, the others those of `frames`, in their order."
    )


class Coincidences(ApiRecord):
    """Patches of both frames that coincide under the transform. Each list has one entry for each
    pair.
    """

    query: list[int] = Field(description="Index of the query's validation patch.")
    match: list[int] = Field(description="Index of the match's patch; see its `/patches`.")
    query_mean: list[Triple] = Field(description="Metres, in the frame of the query's sensor.")
    query_normal: list[Triple]
    match_mean: list[Triple] = Field(description="Metres, in the frame of the match's sensor.")
    match_normal: list[Triple]
    distance_m: list[float] = Field(
        description="Distance of the means under the transform, in increasing order."
    )


class Points(ApiRecord):
    """Points of one frame, in its sensor's frame, on which the evidence is counted."""

    sampled: int = Field(description="Number of points that were looked up in the other frame.")
    inliers: list[Triple] = Field(
        description=f"Points on the other frame's surface; at most {MOST_POINTS}."
    )
    violations: list[Triple] = Field(
        description=f"Points that the other frame saw through; at most {MOST_POINTS}."
    )


class MatchDetails(ApiRecord):
    """One match of a query, validated again as in the query, with its evidence."""

    query_id: str
    frame_id: str
    map: str
    name: str | None = Field(default=None, description="Name of the original file or message.")
    sequence: int | None = Field(default=None, description="Position in the session.")
    validation: Validation
    transform: Transform | None = Field(
        description="Transform from query to match; null if the frames gave no hypothesis."
    )
    uncertainty: Uncertainty | None = Field(
        description="Uncertainty of `transform`, if it is accepted."
    )
    rival: Transform | None = Field(
        description="The best other transform that explains the frames and is not refuted."
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
    """The similarity of two frames."""

    distance: int = Field(
        description="Distance of their signatures: squared L2, or L1 if psi itself is stored."
    )
    similarity: float = Field(description="1 - distance / distance of unrelated frames, 0 to 1.")
    model: str
    a: FrameName | None = Field(description="The stored frame; null for an upload.")
    b: FrameName | None
    validation: Validation | None = Field(description="Null if it was not requested.")
    transform: Transform | None = Field(
        description="x_a = matrix @ x_b. If it is accepted, it is right if both frames show the "
        "same place, which a pair alone cannot prove."
    )
    uncertainty: Uncertainty | None = Field(
        default=None, description="Uncertainty of `transform`, if it is accepted."
    )
    seed: int
    milliseconds: dict[str, float] = Field(
        description="`prepare` (both frames), `validate`, `total`."
    )

"""Records of past queries, stored answers, frame data and comparisons."""

from __future__ import annotations

from datetime import datetime
from typing import Annotated, Any, Literal

from pydantic import Field

from sceneprint_client.api.base import ApiRecord, Given, Note, Quaternion, Transform, Vector
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

#: Outcome of a query: status of its answer, or `failed`.
RecordStatus = Literal["found", "ambiguous", "not_found", "unvalidated", "failed"]
RECORD_STATUSES: tuple[RecordStatus, ...] = (
    "found", "ambiguous", "not_found", "unvalidated", "failed"
)  # fmt: skip


class RecordedPose(ApiRecord):
    """T_parent_query in metres, with a unit quaternion."""

    parent_frame: str
    translation: Vector
    rotation: Quaternion


class KeepOptions(Given):
    """Options for keeping an answer."""

    title: Note | None = Field(default=None, description="Human-readable title of the answer.")


class QueryRecord(ApiRecord):
    """A past query and its outcome, without the data of its frame."""

    query_id: str = Field(
        description="Id of the query. GET /v1/queries/{query_id} returns the answer if `stored` is "
        "true."
    )
    at: datetime = Field(description="Time of the query.")
    map: str = Field(
        description="Map that was searched. If several maps were searched, the map of the found "
        "pose, otherwise of the first alternative or match, otherwise the first map in the "
        "request."
    )
    maps: list[str] = Field(description="Searched maps that you may read.")
    robot: str | None = Field(description="Robot that sent the query, if known.")
    session: str | None
    key: str | None = Field(
        description="Name of the API key; null if there was no key or the key was revoked."
    )
    status: RecordStatus = Field(
        description="Status of the answer. `failed`: there is no answer, and `reason` says why."
    )
    cause: str | None = Field(
        description="Cause as in the answer, for `not_found` or a deadline that passed; for "
        "`failed`, the type of the problem, such as `busy`."
    )
    reason: str
    pose: RecordedPose | None = Field(
        description="Pose of a `found` answer; null if the matches have no poses."
    )
    confidence: float | None = Field(
        description="Probability that `pose`, or the best alternative, is right; null if the pose "
        "was not compared with the map."
    )
    support: int | None = Field(description="Number of matches that agree on `pose`.")
    alternatives: int = Field(
        description="Number of poses of an `ambiguous` answer that the evidence supports."
    )
    milliseconds: float
    kind: Kind | None = Field(description="Kind of the frame; null if the frame was not read.")
    frame: FrameName | None = Field(
        description="Stored frame of the query; null for an upload, or if you cannot read the map "
        "of the frame."
    )
    stored: bool = Field(description="Whether the answer is still stored.")
    expires_at: datetime | None = Field(
        description="Expiry time of the record and the answer; the answer may be deleted earlier "
        "to free space. Null for a kept answer."
    )
    kept_at: datetime | None = Field(description="Time of the request to keep the answer.")
    title: str | None = Field(description="Title of a kept answer.")


class StoredQuery(QueryRecord):
    """A past query whose answer is stored, with its options."""

    validates: bool = Field(
        description="Whether the points of the query are stored, so that the query can be repeated "
        "with the stage `validate`."
    )
    model: str
    options: dict[str, Any] = Field(
        description="Options in the request; all other options had their defaults."
    )


# Data derived from a frame.

#: Coordinate frame of a cloud.
CloudFrame = Literal["optical", "parent", "base"]
CLOUD_FRAMES: tuple[CloudFrame, ...] = ("optical", "parent", "base")

#: Content of a picture of a frame.
View = Literal["depth", "normals", "patches"]
VIEWS: tuple[View, ...] = ("depth", "normals", "patches")
#: Minimum, maximum and default width of a picture, pixels.
WIDTHS = (64, 1280)
WIDTH = 320

#: Default maximum number of surface points in a response.
MOST_DRAWN = 20_000

Triple = tuple[float, float, float]


class PatchLevel(ApiRecord):
    """Surface patches of one level. Each list has one entry per patch.

    Metres are rounded to a tenth of a millimetre, normals to four digits, areas to a tenth of a
    square centimetre.
    """

    mean: list[Triple] = Field(description="Mean x, y, z in metres.")
    normal: list[Triple] = Field(description="Unit normal towards the sensor.")
    area_m2: list[float]
    size: list[int] = Field(
        description="Number of pixels of the patch in the surface map of approximately 160 x 120 "
        "pixels."
    )


class FramePatches(ApiRecord):
    """The patches of a frame, as segmented for its model."""

    frame_id: str
    map: str
    frame: str = Field(
        description="Name of the sensor's coordinate frame, to which all coordinates refer."
    )
    model: str
    levels: list[PatchLevel] = Field(
        description="Levels of the hierarchy that the signature describes, finest first."
    )
    validation: PatchLevel = Field(description="Patches for the validation of matches.")


class FrameSignature(ApiRecord):
    """The signature of a frame."""

    frame_id: str
    map: str
    model: str
    model_id: str = Field(
        description="Id of the model. Signatures of different models cannot be compared."
    )
    dtype: Literal["uint8"] = "uint8"
    length: int = Field(description="Length of the signature, bytes.")
    n_patches: list[int] = Field(description="Number of patches at each level, finest first.")
    n_pairs: list[int] = Field(description="Number of ordered pairs of patches at each level.")
    base64: str = Field(
        description="The signature in base64. The distance between two signatures is the sum of "
        "the squared differences of their bytes, or of the absolute differences if psi is stored."
    )


#: Meaning of an overlay's colours.
OverlayColour = Literal["source", "normal", "residual"]
#: Transform between the clouds of an overlay.
OverlayTransform = Literal["aligned", "rival", "none"]
#: Frame whose points are returned.
PointsSide = Literal["query", "match"]
COLOURS: tuple[OverlayColour, ...] = ("source", "normal", "residual")
TRANSFORMS: tuple[OverlayTransform, ...] = ("aligned", "rival", "none")

#: Maximum number of listed points of each kind, and of listed patches.
MOST_POINTS = 2000


class Similarities(ApiRecord):
    """Pairwise similarities of a query and the frames of its ranking, for a heat map."""

    query_id: str
    model: str
    frames: list[FrameName] = Field(
        description="Frames of the ranking, nearest first, except frames that have been deleted "
        "since."
    )
    names: list[str | None] = Field(
        default=[], description="Names of the files of `frames`, in the same order."
    )
    similarity: list[list[float]] = Field(
        description="Similarities, 0 to 1: 1 - distance / distance between unrelated frames. The "
        "first row and column belong to the query, and the others to `frames`, in order."
    )


class Coincidences(ApiRecord):
    """Pairs of patches that coincide under the transform. Each list has one entry per pair."""

    query: list[int] = Field(description="Index of the query's validation patch.")
    match: list[int] = Field(description="Index of the match's validation patch; see `/patches`.")
    query_mean: list[Triple] = Field(
        description="Means in the frame of the query's sensor, metres."
    )
    query_normal: list[Triple]
    match_mean: list[Triple] = Field(
        description="Means in the frame of the match's sensor, metres."
    )
    match_normal: list[Triple]
    distance_m: list[float] = Field(
        description="Distance between the two means under the transform, metres, in increasing "
        "order."
    )


class Points(ApiRecord):
    """Sampled points of one frame that count as evidence, in the frame of its sensor."""

    sampled: int = Field(description="Number of points that were compared with the other frame.")
    inliers: list[Triple] = Field(
        description=f"Points on the other frame's surface; at most {MOST_POINTS}."
    )
    violations: list[Triple] = Field(
        description=f"Points that the other frame saw through; at most {MOST_POINTS}."
    )


class MatchDetails(ApiRecord):
    """One match of a query, validated again with the options of the query, and its evidence."""

    query_id: str
    frame_id: str
    map: str
    name: str | None = Field(default=None, description="Name of the original file or message.")
    sequence: int | None = Field(default=None, description="Index in the session.")
    validation: Validation
    transform: Transform | None = Field(
        description="Transform from query to match; null if there is no hypothesis."
    )
    uncertainty: Uncertainty | None = Field(
        description="Uncertainty of `transform` for an accepted match."
    )
    rival: Transform | None = Field(
        description="Best alternative transform that explains the frames and is not refuted."
    )
    patches: Coincidences | None = Field(
        description="Coincident patches; null if there is no transform."
    )
    query: Points | None
    match: Points | None
    seed: int


# Comparisons of two frames.


class Comparison(Given):
    """Two frames to compare, and options."""

    frame_a: Annotated[NamedFrame | None, JsonText] = Field(
        default=None, description="Stored frame to compare instead of an upload `a`."
    )
    frame_b: Annotated[NamedFrame | None, JsonText] = Field(
        default=None, description="Stored frame to compare instead of an upload `b`."
    )
    aligned: bool = Field(
        default=True,
        alias="validate",
        description="Whether to align the frames and decide whether they show the same place.",
    )
    validation: Annotated[ValidationOptions | None, JsonText] = Field(
        default=None, description="Requirements on an accepted alignment."
    )
    seed: int = Field(
        default=0,
        ge=0,
        lt=2**32,
        description="Seed for the random choices. The result contains the same seed.",
    )
    model: Preset | None = Field(
        default=None,
        description="Model for two uploads; default: `depth`, or `lidar` for LiDAR scans. Stored "
        "frames have their own model.",
    )


class Similarity(ApiRecord):
    """The similarity of two frames."""

    distance: int = Field(
        description="Distance between the signatures (squared L2, or L1 if psi itself is stored)."
    )
    similarity: float = Field(
        description="Similarity, 0 to 1: 1 - distance / distance between unrelated frames."
    )
    model: str
    a: FrameName | None = Field(description="Stored frame a; null for an upload.")
    b: FrameName | None = Field(description="Stored frame b; null for an upload.")
    validation: Validation | None = Field(
        description="Result of the validation; null if validation was not requested."
    )
    transform: Transform | None = Field(
        description="Transform with x_a = matrix @ x_b. An accepted transform is right if both "
        "frames show the same place; a single pair cannot prove that they do."
    )
    uncertainty: Uncertainty | None = Field(
        default=None, description="Uncertainty of an accepted `transform`."
    )
    seed: int
    milliseconds: dict[str, float] = Field(
        description="Duration of each stage: `prepare` (both frames), `validate` and `total`."
    )

"""What is said between robots, dashboards and the service: one set of records for both ends.

Field names, units and words are those of the JSON; docs/api.md has examples.
"""

from sceneprint_client.api.admin import Job, Progress
from sceneprint_client.api.base import (
    CameraIntrinsics,
    FrameMeta,
    FrameState,
    GivenPose,
    JobState,
    Page,
    Problem,
    Quaternion,
    Transform,
    Vector,
)
from sceneprint_client.api.frames import Added, Frame
from sceneprint_client.api.listing import Filter, Region
from sceneprint_client.api.maps import Map, NewMap, Reencoding
from sceneprint_client.api.query import (
    Alternative,
    Answer,
    AnswerStatus,
    Counts,
    Diversity,
    ExplainedFrame,
    Explanation,
    FrameName,
    Localization,
    Location,
    Match,
    NamedFrame,
    OfMap,
    Prior,
    Query,
    Residual,
    SeveralQuery,
    Stage,
    Validation,
    ValidationOptions,
)
from sceneprint_client.api.results import Comparison, Similarity

__all__ = [
    "Added",
    "Alternative",
    "Answer",
    "AnswerStatus",
    "CameraIntrinsics",
    "Comparison",
    "Counts",
    "Diversity",
    "ExplainedFrame",
    "Explanation",
    "Filter",
    "Frame",
    "FrameMeta",
    "FrameName",
    "FrameState",
    "GivenPose",
    "Job",
    "JobState",
    "Localization",
    "Location",
    "Map",
    "Match",
    "NamedFrame",
    "NewMap",
    "OfMap",
    "Page",
    "Prior",
    "Problem",
    "Progress",
    "Quaternion",
    "Query",
    "Reencoding",
    "Region",
    "Residual",
    "SeveralQuery",
    "Similarity",
    "Stage",
    "Transform",
    "Validation",
    "ValidationOptions",
    "Vector",
]

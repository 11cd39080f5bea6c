"""What is said between robots, dashboards and the service: one set of records for both ends.

Field names, units and words are those of the JSON; docs/api.md has examples.
"""

from sceneprint.schemas.base import Page, Problem
from sceneprint.schemas.explanations import ExplainedFrame, Explanation
from sceneprint.schemas.filters import Filter, Region
from sceneprint.schemas.frames import (
    Added,
    CameraIntrinsics,
    Frame,
    FrameMeta,
    GivenPose,
)
from sceneprint.schemas.jobs import Job, Progress
from sceneprint.schemas.localization import Localization
from sceneprint.schemas.maps import Map, NewMap, Reencoding
from sceneprint.schemas.matches import Location, Match, Residual, Validation
from sceneprint.schemas.options import (
    Diversity,
    FrameName,
    NamedFrame,
    Stage,
    ValidationOptions,
)
from sceneprint.schemas.queries import Answer, AnswerStatus, Counts, OfMap, Query, SeveralQuery
from sceneprint.schemas.similarities import Comparison, Similarity
from sceneprint.schemas.states import FrameState, JobState
from sceneprint.schemas.transforms import Quaternion, Transform, Vector

__all__ = [
    "Added",
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

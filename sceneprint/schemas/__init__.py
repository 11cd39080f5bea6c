"""What is said between robots, dashboards and the service: one set of records for both ends.

Field names, units and words are those of the JSON; docs/api.md has examples.
"""

from sceneprint.schemas.base import Page, Problem
from sceneprint.schemas.filters import Filter, Region
from sceneprint.schemas.frames import (
    Added,
    CameraIntrinsics,
    Frame,
    FrameMeta,
    GivenPose,
    Job,
)
from sceneprint.schemas.maps import Map, NewMap, Reencoding
from sceneprint.schemas.queries import (
    Answer,
    AnswerStatus,
    Counts,
    Location,
    Match,
    Query,
    Residual,
    Stage,
    Validation,
)
from sceneprint.schemas.states import FrameState, JobState
from sceneprint.schemas.transforms import Quaternion, Transform, Vector

__all__ = [
    "Added",
    "Answer",
    "AnswerStatus",
    "CameraIntrinsics",
    "Counts",
    "Filter",
    "Frame",
    "FrameMeta",
    "FrameState",
    "GivenPose",
    "Job",
    "JobState",
    "Location",
    "Map",
    "Match",
    "NewMap",
    "Page",
    "Problem",
    "Quaternion",
    "Query",
    "Reencoding",
    "Region",
    "Residual",
    "Stage",
    "Transform",
    "Validation",
    "Vector",
]

"""What is said between robots, dashboards and the service: one set of records for both ends.

Field names, units and words are those of the JSON; docs/api.md has examples.
"""

from sceneprint.schemas.base import Page, Problem
from sceneprint.schemas.frames import (
    Added,
    CameraIntrinsics,
    Frame,
    FrameMeta,
    GivenPose,
    Job,
)
from sceneprint.schemas.maps import Map, NewMap
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
    "Residual",
    "Stage",
    "Transform",
    "Validation",
    "Vector",
]

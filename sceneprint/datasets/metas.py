"""What a data set knows of its frames, as it is sent with an upload.

Sequence, FrameReference  --meta_of-->  FrameMeta
"""

from __future__ import annotations

from collections.abc import Iterable
from datetime import UTC, datetime
from typing import Any, TypeVar

from pydantic import BaseModel, ValidationError

from sceneprint.datasets.clouds import CloudSource
from sceneprint.datasets.intrinsics import Camera
from sceneprint.datasets.records import FrameReference, Sequence
from sceneprint.errors import InvalidRequest
from sceneprint.scans import SUFFIXES, Unsaid
from sceneprint.schemas import CameraIntrinsics, FrameMeta, GivenPose
from sceneprint.schemas.frames import GivenBase

Record = TypeVar("Record", bound=BaseModel)

#: Time stamps, in seconds, that are dates (2001 to 2096); others count from some start.
_DATES_S = (1e9, 4e9)


def meta_of(
    reference: FrameReference,
    *,
    robot: str | None = None,
    session: str | None = None,
    tags: Iterable[str] = (),
    with_pose: bool = True,
    parent_frame: str | None = None,
    base: GivenBase | None = None,
) -> FrameMeta:
    """What a data set knows of one of its frames, as it is sent with an upload.

    Parameters
    ----------
    reference : the frame
    robot, tags : see FrameMeta
    session : default: the name of the frame's sequence
    with_pose : send the pose where it is known
    parent_frame : what its pose leads to; default: the session's name. Sequences of one scene
        share it: `Sequence.parent_frame`
    base : where the sensor sits on the robot

    Raises
    ------
    InvalidPose : the file of the pose holds none.
    InvalidRequest : a name is empty, too long or not printable.
    """
    sequence = reference.name.rpartition("/")[0] or reference.path.absolute().parent.name
    T_parent_sensor = reference.pose if with_pose else None
    stamp, pose = reference.timestamp, None
    if T_parent_sensor is not None:
        matrix = T_parent_sensor.tolist()
        pose = checked(GivenPose, "The pose", matrix=matrix, parent_frame=parent_frame)
    if stamp is not None and not _DATES_S[0] <= stamp < _DATES_S[1]:
        stamp = None
    return checked(
        FrameMeta,
        "What is known of the frame",
        **(_of_depth(reference.camera) if reference.camera else _of_cloud(reference)),
        robot=robot,
        session=sequence if session is None else session,
        captured_at=None if stamp is None else datetime.fromtimestamp(stamp, UTC),
        pose=pose,
        T_base_sensor=base,
        tags=list(tags),
    )


def _of_depth(camera: Camera) -> dict[str, Any]:
    """How the samples of a depth image are read."""
    lens = camera.intrinsics
    return {
        "intrinsics": CameraIntrinsics(
            width=lens.width,
            height=lens.height,
            fx=lens.fx,
            fy=lens.fy,
            cx=lens.cx,
            cy=lens.cy,
            distortion=list(lens.distortion),
        ),
        "depth_scale": camera.depth_scale,
        "depth_along_ray": camera.along_ray,
    }


def _of_cloud(reference: FrameReference) -> dict[str, Any]:
    """How the points of a cloud are read; a KITTI scan's name alone says that it is one."""
    source = reference.cloud or CloudSource()
    told = source.file_format
    if told is None and SUFFIXES.get(reference.path.suffix.lower()) == "kitti":
        told = "kitti"
    known: dict[str, Any] = {"format": told, "units_per_metre": source.units_per_metre}
    if source.viewpoint is None:
        known["viewpoint"] = None
    elif not isinstance(source.viewpoint, Unsaid):
        known["viewpoint"] = dict(zip("xyz", source.viewpoint, strict=True))
    return known


def session_of(sequence: Sequence) -> str:
    """Name of a sequence, the same whether its own folder was named or the scene's."""
    if sequence.parent_frame == sequence.name:
        return sequence.name
    return f"{sequence.parent_frame}/{sequence.folder.name}"


def parent_frame_of(sequence: Sequence, robot: str | None) -> str:
    """What poses lead to: folders of two robots may share a name, and their poses no frame."""
    own = sequence.parent_frame
    return own if robot is None else f"{robot}/{own}"


def checked(kind: type[Record], what: str, **fields: Any) -> Record:
    """A record of the API, or what is wrong with its fields in our words.

    Raises
    ------
    InvalidRequest : a field is missing, unknown or out of its range.
    """
    try:
        return kind.model_validate(fields)
    except ValidationError as error:
        found = tuple(
            (".".join(map(str, one["loc"])), one["msg"].removeprefix("Value error, "))
            for one in error.errors(include_url=False)
        )
        told = "; ".join(f"{place or 'it'}: {reason}" for place, reason in found[:3])
        raise InvalidRequest(f"{what} is not as it should be: {told}.", found) from error

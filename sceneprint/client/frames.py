"""What a frame at hand is sent as: its bytes, and what is known of it.

bytes | Path | FrameReference  --sendable-->  bytes, FrameMeta
"""

from __future__ import annotations

from collections.abc import Iterable
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel, ValidationError

from sceneprint.datasets import FrameReference, find_sequences
from sceneprint.datasets.files import read_bytes
from sceneprint.datasets.png import MAXIMUM_BYTES
from sceneprint.errors import DatasetError, InvalidRequest, UnreadableFrame
from sceneprint.schemas import CameraIntrinsics, FrameMeta, GivenPose

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

    Raises
    ------
    InvalidPose : the file of the pose holds none.
    InvalidRequest : a name is empty, too long or not printable.
    """
    camera, lens = reference.camera, reference.camera.intrinsics
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
        intrinsics=CameraIntrinsics(
            width=lens.width,
            height=lens.height,
            fx=lens.fx,
            fy=lens.fy,
            cx=lens.cx,
            cy=lens.cy,
            distortion=list(lens.distortion),
        ),
        depth_scale=camera.depth_scale,
        depth_along_ray=camera.along_ray,
        robot=robot,
        session=sequence if session is None else session,
        captured_at=None if stamp is None else datetime.fromtimestamp(stamp, UTC),
        pose=pose,
        tags=list(tags),
    )


def sendable(
    frame: bytes | Path | FrameReference, meta: FrameMeta | None, *, with_pose: bool
) -> tuple[bytes, FrameMeta]:
    """Bytes of a frame and what is known of it; a path's camera is looked for beside it.

    Raises
    ------
    UnreadableFrame : the file cannot be read.
    DatasetError : there is no intrinsics.json beside the file or above, or it is a folder.
    InvalidIntrinsics, InvalidPose : what is beside it is none.
    TypeError : bytes without metadata.
    """
    if isinstance(frame, bytes):
        if meta is None:
            raise TypeError("the bytes of a frame need its `meta`, at least the intrinsics")
        return frame, meta
    if isinstance(frame, FrameReference):
        reference = frame
    elif meta is not None:
        return read_bytes(frame, MAXIMUM_BYTES, UnreadableFrame), meta
    elif frame.is_dir():
        raise DatasetError(
            f"{frame}: This is a folder, and one frame is wanted. Name a depth image, or send "
            "the frames that sceneprint.find_sequences returns."
        )
    else:
        reference = find_sequences(frame)[0].frames[0]
    data = read_bytes(reference.path, MAXIMUM_BYTES, UnreadableFrame)
    return data, meta_of(reference, with_pose=with_pose) if meta is None else meta


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

"""The door of the engine: uploaded bytes and their metadata to a frame, and who it is.

bytes, FrameMeta  --read_upload-->  Read: Frame | Cloud  --content_id-->  64 digits
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import astuple, dataclass
from typing import Any

import numpy as np

from sceneprint import errors
from sceneprint.decoders import Decoder, Decoders
from sceneprint.errors import InvalidPose
from sceneprint.formats.dataset import decode_frame, rigid_transform
from sceneprint.formats.points import UNSAID, decode_cloud, decode_scan, format_of
from sceneprint.store.tables import FrameRow
from sceneprint.types import AnyFrame, Cloud, Floats, Intrinsics
from sceneprint_client.api import CameraIntrinsics, FrameMeta
from sceneprint_client.api.base import GivenBase, GivenTransform
from sceneprint_client.api.frames import Kind
from sceneprint_client.files import naming
from sceneprint_client.formats import CloudFormat, format_at, titles_of
from sceneprint_client.poses import rotation_of

#: What the coordinates of a cloud as they were sent are called, where its viewpoint is elsewhere.
GIVEN_FRAME = "cloud"


@dataclass(frozen=True, eq=False)
class Read:
    """An upload as it was read.

    Parameters
    ----------
    frame : as the geometry reads it
    cloud : of a cloud, what is stored of it: how it was packed, where it was seen from, the units
        a metre has, how many points it has, and what was done to them
    base : what the frame of the robot's base is called, and T_base_sensor; None where not known
    """

    frame: AnyFrame
    cloud: dict[str, Any] | None
    base: tuple[str, Floats] | None

    @property
    def kind(self) -> Kind:
        """A depth image or a point cloud."""
        return "depth" if self.cloud is None else "cloud"


def read_upload(data: bytes, meta: FrameMeta, decoders: Decoders) -> Read:
    """The frame of an upload, checked as far as can be without signing it.

    Parameters
    ----------
    decoders : one of which decodes it

    Raises
    ------
    FrameError : undecodable samples, a camera that is none or of another image, a pose or
        T_base_sensor that is not rigid, no sample at all, or a file that its decoder fails at.
    InvalidRequest : a depth image without a camera, a cloud with one, or what has no meaning for
        the kind it is; UnsupportedType where what unpacks it is not installed.
    Busy : no decoder gets free, or none can be started.
    """
    with decoders.place() as decoder:
        return _read(data, meta, decoder)


def _read(data: bytes, meta: FrameMeta, decoder: Decoder) -> Read:
    pose = None if meta.pose is None else pose_matrix(meta.pose)
    base = None if meta.T_base_sensor is None else base_of(meta.T_base_sensor, None)
    if pose is not None and base is not None and meta.pose is not None and meta.pose.of == "base":
        pose = pose @ base[1]
    if _is_cloud(data, meta):
        return _read_cloud(data, meta, pose, decoder)
    _refuse(meta, "depth image", {"viewpoint": "file", "units_per_metre": 1.0, "format": None})
    if meta.intrinsics is None:
        raise _without_camera(data)
    try:
        frame = decode_frame(
            data,
            _camera(meta.intrinsics),
            depth_scale=meta.depth_scale,
            along_ray=meta.depth_along_ray,
            pose=pose,
            samples_of=decoder.samples,
            trust_depth=meta.trust_depth,
        )
    except errors.DecoderFailure as error:
        raise errors.UnreadableFrame(_failed(error)) from error
    return Read(frame, None, base)


def _failed(error: errors.DecoderFailure) -> str:
    return f"The file cannot be decoded: {error}. Write it again, or send it in another format."


def read_stored(data: bytes, row: FrameRow, decoders: Decoders) -> AnyFrame:
    """The frame of an upload that was let in before.

    Raises
    ------
    DamagedBlob : a decoder fails at it, as it did not before.
    Busy : no decoder gets free, or none can be started.
    """
    try:
        with decoders.place() as decoder:
            return _read_stored(data, row, decoder)
    except errors.DecoderFailure as error:
        raise errors.DamagedBlob(
            f"The upload of frame {row.id} cannot be decoded: {error}. Try again; if it stays so, "
            "send the frame again."
        ) from error


def _read_stored(data: bytes, row: FrameRow, decoder: Decoder) -> AnyFrame:
    if row.cloud is not None:
        # a lost upload may have come again, packed otherwise
        return decode_cloud(
            data,
            file_format=_packing(data),
            viewpoint=viewpoint_of(row),
            units_per_metre=row.cloud["units_per_metre"],
            name=row.id,
            points_of=decoder.points,
        )
    return decode_frame(
        data,
        _camera(CameraIntrinsics.model_validate(row.intrinsics)),
        depth_scale=row.depth_scale,
        along_ray=row.depth_along_ray,
        name=row.id,
        samples_of=decoder.samples,
        trust_depth=True,  # it was let in
    )


def viewpoint_of(row: FrameRow) -> tuple[float, float, float] | None:
    """The viewpoint of a stored cloud in its coordinates; None of a depth image."""
    if row.cloud is None or row.cloud["viewpoint"] is None:
        return None
    x, y, z = row.cloud["viewpoint"]
    return x, y, z


def content_id(read: Read) -> str:
    """Hash of samples and camera, or points and viewpoint; not of how they were packed."""
    if isinstance(read.frame, Cloud):
        viewpoint = None if read.cloud is None else read.cloud["viewpoint"]
        digest = hashlib.sha256(f"cloud {json.dumps(viewpoint)}\n".encode())
        digest.update(np.ascontiguousarray(read.frame.points, "<f4").data)
        return digest.hexdigest()
    camera = json.dumps(astuple(read.frame.intrinsics)).encode()
    digest = hashlib.sha256(camera + b"\n")
    digest.update(read.frame.depth.astype("<f4", copy=False).data)
    return digest.hexdigest()


def columns(
    meta: FrameMeta, pose: Floats | None, base: tuple[str, Floats] | None
) -> dict[str, Any]:
    """What of an upload's metadata is stored with it, by the columns of the table.

    Parameters
    ----------
    pose, base : T_parent_sensor, and see Read
    """
    parent = None
    if meta.pose is not None:
        own = meta.session if meta.robot is None else f"{meta.robot}/{meta.session}"
        parent = meta.pose.parent_frame or own  # two robots may call their runs alike
    return {
        "intrinsics": None if meta.intrinsics is None else meta.intrinsics.model_dump(),
        "depth_scale": meta.depth_scale,
        "depth_along_ray": meta.depth_along_ray,
        "robot": meta.robot,
        "session": meta.session,
        "captured_at": None if meta.captured_at is None else meta.captured_at.timestamp(),
        "tags": meta.tags,
        "pose_parent": parent,
        "pose": None if pose is None else pose.tolist(),
        "base_frame": None if base is None else base[0],
        "base": None if base is None else base[1].tolist(),
        "up": None if meta.up is None else meta.up.unit,
        "name": meta.name,
        "sequence": meta.sequence,
    }


def base_of(
    given: GivenBase | None, viewpoint: Sequence[float] | None
) -> tuple[str, Floats] | None:
    """What a robot's base is called, and T_base_sensor.

    Parameters
    ----------
    given : as the caller said it
    viewpoint : of a cloud: where nothing was said and it is not the origin, the coordinates as
        they were sent take the base's place, so that answers speak of them too

    Raises
    ------
    InvalidPose : not a rigid transform.
    """
    if given is not None:
        return given.base_frame, pose_matrix(given, "T_base_sensor")
    if viewpoint is None or not any(viewpoint):
        return None
    T = np.eye(4)
    T[:3, 3] = viewpoint
    return GIVEN_FRAME, T


def _packing(data: bytes) -> CloudFormat:
    """How a cloud is packed that was let in: what does not say so is a KITTI scan."""
    return format_of(data) or "kitti"


def _is_cloud(data: bytes, meta: FrameMeta) -> bool:
    """Whether an upload is a point cloud; an array may be either, and with a camera is an image."""
    if meta.format is not None:
        return True
    found = format_of(data)
    return found is not None and (found != "npy" or meta.intrinsics is None)


def _read_cloud(data: bytes, meta: FrameMeta, pose: Floats | None, decoder: Decoder) -> Read:
    _refuse(
        meta, "point cloud",
        {"intrinsics": None, "depth_scale": 1000.0, "depth_along_ray": False, "trust_depth": False},
    )  # fmt: skip
    given = meta.viewpoint
    said = None if given is None else UNSAID if given == "file" else (given.x, given.y, given.z)
    try:
        scan = decode_scan(
            data,
            file_format=meta.format,
            viewpoint=said,
            units_per_metre=meta.units_per_metre,
            pose=pose,
            points_of=decoder.points,
        )
    except errors.DecoderFailure as error:
        raise errors.UnreadableCloud(_failed(error)) from error
    except (
        errors.MissingDependency
    ) as error:  # of this machine, and yet it is the file that asks for it
        raise errors.UnsupportedType(str(error)) from error
    if scan.file_format != _packing(data):  # it could not be read again without what was said
        raise errors.UnreadableCloud(
            f"The file is read as {scan.file_format.upper()} but does not start like one. Write "
            "the file again."
        )
    # nobody means -0.0 by another place
    seen_from = None if scan.viewpoint is None else [value + 0.0 for value in scan.viewpoint]
    stored = {
        "format": scan.file_format,
        "viewpoint": seen_from,
        "units_per_metre": meta.units_per_metre,
        "points": len(scan.cloud.points),
        "note": scan.cloud.note or None,
    }
    return Read(scan.cloud, stored, base_of(meta.T_base_sensor, seen_from))


def _refuse(meta: FrameMeta, kind: str, defaults: dict[str, object]) -> None:
    """See that nothing is said of a frame that would have no effect on it; InvalidRequest."""
    said = [name for name, default in defaults.items() if getattr(meta, name) != default]
    if said:
        raise errors.InvalidRequest(
            f"The frame is a {kind}, and {' and '.join(f'`{name}`' for name in said)} would have "
            "no effect. Leave it out, or check that you sent the right file.",
            tuple((name, f"does not apply to a {kind}") for name in said),
        )


def _without_camera(data: bytes) -> errors.SceneprintError:
    """Why an upload without intrinsics is not read."""
    if format_at(data, "depth") is not None:
        return errors.InvalidRequest(
            "The frame is a depth image, but its intrinsics are missing. Send width, height, "
            "fx, fy, cx and cy of the camera. If it is a point cloud as NPY, give it the shape "
            "(N, 3) or (N, 4).",
            (("intrinsics", "needed for a depth image"),),
        )
    if not data:
        return errors.UnreadableFrame("The file is empty. Write it again.")
    return errors.UnreadableFrame(
        f"The file is neither a depth image ({titles_of('depth', last='or')}) nor a point cloud "
        f"({titles_of('cloud', last='or')}). For a KITTI file, set format=kitti."
    )


def _camera(k: CameraIntrinsics) -> Intrinsics:
    return Intrinsics(k.width, k.height, k.fx, k.fy, k.cx, k.cy, tuple(k.distortion))


# Transforms and poses between matrices and JSON.

#: How far from 1 the length of a given quaternion may be.
_TOLERANCE = 1e-2


def pose_matrix(pose: GivenTransform, what: str = "") -> Floats:
    """T_parent_sensor (4, 4) of a pose or another transform given either way.

    Parameters
    ----------
    what : to begin an error with, where it is no pose

    Raises
    ------
    InvalidPose : not a rigid transform, or a quaternion that is not of unit length.
    """
    with naming(what):
        return _matrix(pose)


def _matrix(pose: GivenTransform) -> Floats:
    if pose.matrix is not None:
        return rigid_transform(np.array(pose.matrix))
    t, r = pose.translation, pose.rotation
    if t is None or r is None:  # the schema asks for both where there is no matrix
        raise InvalidPose("The pose is incomplete. Give translation and rotation, or matrix.")
    q = np.array([r.x, r.y, r.z, r.w])
    length = float(np.linalg.norm(q))
    if not abs(length - 1.0) <= _TOLERANCE:
        raise InvalidPose(
            f"The quaternion of the pose has length {length:.3g}, not 1. Give a unit quaternion "
            "x, y, z, w."
        )
    T = np.eye(4)
    T[:3, :3] = rotation_of(q / length)
    T[:3, 3] = (t.x, t.y, t.z)
    return rigid_transform(T)

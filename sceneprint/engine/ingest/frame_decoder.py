"""Decoding of uploads and their metadata to frames, and content identity.

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
from sceneprint.formats.points.cloud import decode_cloud, decode_scan
from sceneprint.store.tables import FrameRow
from sceneprint.types import AnyFrame, Cloud, Floats, Intrinsics
from sceneprint_client.api import CameraIntrinsics, FrameMeta
from sceneprint_client.api.base import GivenBase, GivenTransform
from sceneprint_client.api.frames import Kind
from sceneprint_client.files import naming
from sceneprint_client.formats import CloudFormat, format_at, format_of, titles_of
from sceneprint_client.poses import rotation_of
from sceneprint_client.sidecars import UNSAID

#: Name of the base frame of a cloud whose viewpoint is not the origin of its coordinates.
CLOUD_FRAME = "cloud"


@dataclass(frozen=True, eq=False)
class Read:
    """A decoded upload.

    Parameters
    ----------
    cloud : stored description of a cloud: file format, viewpoint, units per metre, number of
        points, and a note on corrections; None for a depth image
    base : name of the base frame of the robot, and T_base_sensor (4, 4); None if unknown
    """

    frame: AnyFrame
    cloud: dict[str, Any] | None
    base: tuple[str, Floats] | None

    @property
    def kind(self) -> Kind:
        """Return whether the upload is a depth image or a point cloud."""
        return "depth" if self.cloud is None else "cloud"


def read_upload(data: bytes, meta: FrameMeta, decoders: Decoders) -> Read:
    """Return a decoded upload, validated except for checks that require signing.

    Raises
    ------
    FrameError : If the samples are missing or cannot be decoded, the camera is invalid or does not
        fit the image, or the pose or T_base_sensor is not rigid.
    InvalidRequest : If a depth image lacks a camera, or metadata does not apply to the kind of
        frame; UnsupportedType if a package for the file type is not installed.
    Busy : If no decoder is free, or none can be started.
    """
    with decoders.place() as decoder:
        return _read(data, meta, decoder)


def _read(data: bytes, meta: FrameMeta, decoder: Decoder) -> Read:
    pose = None if meta.pose is None else pose_matrix(meta.pose)
    base = None if meta.T_base_sensor is None else base_of(meta.T_base_sensor, None)
    if pose is not None and base is not None and meta.pose is not None and meta.pose.of == "base":
        pose = pose @ base[1]
    cloud_format = format_of(data)
    # a camera distinguishes an image in NPY format from a cloud
    if meta.format or (cloud_format and (cloud_format != "npy" or meta.intrinsics is None)):
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
        raise errors.UnreadableFrame(_decoding_error(error)) from error
    return Read(frame, None, base)


def _decoding_error(error: errors.DecoderFailure) -> str:
    return f"The file cannot be decoded: {error}. Write it again, or send it in another format."


def read_stored(data: bytes, row: FrameRow, decoders: Decoders) -> AnyFrame:
    """Decode a stored upload.

    Raises
    ------
    DamagedBlob : If the decoder fails.
    Busy : If no decoder is free, or none can be started.
    """
    try:
        with decoders.place() as decoder:
            return _read_stored(data, row, decoder)
    except errors.DecoderFailure as error:
        raise errors.DamagedBlob(
            f"The upload of frame {row.id} cannot be decoded: {error}. Try again; if that fails, "
            "send the frame again."
        ) from error


def _read_stored(data: bytes, row: FrameRow, decoder: Decoder) -> AnyFrame:
    if row.cloud is not None:
        # do not use the stored format: a later upload of the same points may have another format
        return decode_cloud(
            data,
            file_format=_file_format(data),
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
        trust_depth=True,  # the upload was validated earlier
    )


def viewpoint_of(row: FrameRow) -> tuple[float, float, float] | None:
    """Return the viewpoint (x, y, z) of a stored cloud in its own frame; None for a depth image."""
    if row.cloud is None or row.cloud["viewpoint"] is None:
        return None
    x, y, z = row.cloud["viewpoint"]
    return x, y, z


def content_id(read: Read) -> str:
    """Return the content hash of a frame, which does not depend on the file format.

    It covers the samples and the camera of a depth image, or the points and the viewpoint of a
    cloud.
    """
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
    """Convert the metadata of an upload to columns of its frame.

    Parameters
    ----------
    pose : T_parent_sensor (4, 4); None if unknown
    base : see `Read`
    """
    parent = None
    if meta.pose is not None:
        own = meta.session if meta.robot is None else f"{meta.robot}/{meta.session}"
        parent = meta.pose.parent_frame or own
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
    transform: GivenBase | None, viewpoint: Sequence[float] | None
) -> tuple[str, Floats] | None:
    """Return the name of the base frame of a robot, and T_base_sensor (4, 4); None if unknown.

    Parameters
    ----------
    viewpoint : viewpoint of a cloud. Without `transform`, the coordinate frame of the cloud serves
        as the base frame, unless the viewpoint is its origin

    Raises
    ------
    InvalidPose : If the transform is not rigid.
    """
    if transform is not None:
        return transform.base_frame, pose_matrix(transform, "T_base_sensor")
    if viewpoint is None or not any(viewpoint):
        return None
    T = np.eye(4)
    T[:3, 3] = viewpoint
    return CLOUD_FRAME, T


def _file_format(data: bytes) -> CloudFormat:
    """Return the file format of an accepted cloud; a file without magic bytes is a KITTI scan."""
    return format_of(data) or "kitti"


def _read_cloud(data: bytes, meta: FrameMeta, pose: Floats | None, decoder: Decoder) -> Read:
    _refuse(
        meta, "point cloud",
        {"intrinsics": None, "depth_scale": 1000.0, "depth_along_ray": False, "trust_depth": False},
    )  # fmt: skip
    p = meta.viewpoint
    viewpoint = None if p is None else UNSAID if p == "file" else (p.x, p.y, p.z)
    try:
        scan = decode_scan(
            data,
            file_format=meta.format,
            viewpoint=viewpoint,
            units_per_metre=meta.units_per_metre,
            pose=pose,
            points_of=decoder.points,
        )
    except errors.DecoderFailure as error:
        raise errors.UnreadableCloud(_decoding_error(error)) from error
    except errors.MissingDependency as error:
        raise errors.UnsupportedType(str(error)) from error
    if scan.file_format != _file_format(data):  # `read_stored` would use the wrong format
        raise errors.UnreadableCloud(
            f"The file was sent as {scan.file_format.upper()}, but does not have the magic bytes "
            "of this format. Write the file again, or correct `format`."
        )
    # adding 0.0 converts -0.0 to 0.0, which is the same viewpoint
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
    """Raise InvalidRequest if a field of `defaults` is set although it does not apply to `kind`."""
    extra = [name for name, default in defaults.items() if getattr(meta, name) != default]
    if extra:
        raise errors.InvalidRequest(
            f"The frame is a {kind}, and {' and '.join(f'`{name}`' for name in extra)} would have "
            f"no effect. Omit {'them' if extra[1:] else 'it'}, or check that you sent the right "
            "file.",
            tuple((name, f"does not apply to a {kind}") for name in extra),
        )


def _without_camera(data: bytes) -> errors.SceneprintError:
    """Return the error for a depth image without intrinsics, or for an unknown file format."""
    if format_at(data, "depth") is not None:
        return errors.InvalidRequest(
            "The frame is a depth image, but its intrinsics are missing. Send width, height, "
            "fx, fy, cx and cy of the camera. If it is a point cloud as NPY, its shape must be "
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


#: Maximum deviation of the length of a quaternion from 1.
_TOLERANCE = 1e-2


def pose_matrix(pose: GivenTransform, what: str = "") -> Floats:
    """Convert a pose or another transform to a matrix (4, 4), such as T_parent_sensor.

    Parameters
    ----------
    what : name of the transform in errors, if it is not a pose

    Raises
    ------
    InvalidPose : If the transform is not rigid, or the quaternion does not have unit length.
    """
    with naming(what):
        return _matrix(pose)


def _matrix(pose: GivenTransform) -> Floats:
    if pose.matrix is not None:
        return rigid_transform(np.array(pose.matrix))
    t, r = pose.translation, pose.rotation
    if t is None or r is None:  # the schema excludes this case
        raise InvalidPose("The pose is incomplete. Send translation and rotation, or matrix.")
    q = np.array([r.x, r.y, r.z, r.w])
    length = float(np.linalg.norm(q))
    if not abs(length - 1.0) <= _TOLERANCE:
        raise InvalidPose(
            f"The quaternion of the pose has length {length:.3g}. Send a unit quaternion "
            "x, y, z, w."
        )
    T = np.eye(4)
    T[:3, :3] = rotation_of(q / length)
    T[:3, 3] = (t.x, t.y, t.z)
    return rigid_transform(T)

"""The door of the engine: uploaded bytes and their metadata to a frame, and who it is.

bytes, FrameMeta  --read_upload-->  Frame  --content_id-->  64 digits
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import astuple
from typing import Any

from sceneprint.datasets import decode_frame
from sceneprint.engine.transforms import pose_matrix
from sceneprint.schemas import CameraIntrinsics, FrameMeta
from sceneprint.store.records import FrameRow
from sceneprint.types import Frame, Intrinsics


def read_upload(data: bytes, meta: FrameMeta) -> Frame:
    """The frame of an upload, checked as far as can be without signing it.

    Raises
    ------
    FrameError : undecodable samples, a camera that is none or of another image, a pose or
        T_base_sensor that is not rigid, or no sample at all.
    """
    pose = None if meta.pose is None else pose_matrix(meta.pose)
    if meta.T_base_sensor is not None:
        pose_matrix(meta.T_base_sensor, "T_base_sensor")
    return decode_frame(
        data,
        _camera(meta.intrinsics),
        depth_scale=meta.depth_scale,
        along_ray=meta.depth_along_ray,
        pose=pose,
    )


def read_stored(data: bytes, row: FrameRow) -> Frame:
    """The frame of an upload that was let in before."""
    return decode_frame(
        data,
        _camera(CameraIntrinsics(**row.intrinsics)),
        depth_scale=row.depth_scale,
        along_ray=row.depth_along_ray,
        name=row.id,
    )


def content_id(frame: Frame) -> str:
    """Hash of what the geometry reads: samples in metres and camera, not how they were packed."""
    camera = json.dumps(astuple(frame.intrinsics)).encode()
    digest = hashlib.sha256(camera + b"\n")
    digest.update(frame.depth.astype("<f4", copy=False).data)
    return digest.hexdigest()


def columns(meta: FrameMeta, frame: Frame) -> dict[str, Any]:
    """What of an upload's metadata is stored with it, by the columns of the table."""
    parent, base = None, meta.T_base_sensor
    if meta.pose is not None:
        own = meta.session if meta.robot is None else f"{meta.robot}/{meta.session}"
        parent = meta.pose.parent_frame or own  # two robots may call their runs alike
    return {
        "intrinsics": meta.intrinsics.model_dump(),
        "depth_scale": meta.depth_scale,
        "depth_along_ray": meta.depth_along_ray,
        "robot": meta.robot,
        "session": meta.session,
        "captured_at": None if meta.captured_at is None else meta.captured_at.timestamp(),
        "tags": meta.tags,
        "pose_parent": parent,
        "pose": None if frame.pose is None else frame.pose.tolist(),
        "base_frame": None if base is None else base.base_frame,
        "base": None if base is None else pose_matrix(base).tolist(),
    }


def _camera(k: CameraIntrinsics) -> Intrinsics:
    return Intrinsics(k.width, k.height, k.fx, k.fy, k.cx, k.cy, tuple(k.distortion))

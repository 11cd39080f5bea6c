"""What a frame at hand is sent as: its bytes, and what is known of it.

bytes | Path | FrameReference  --sendable-->  bytes, FrameMeta
"""

from __future__ import annotations

from pathlib import Path

from sceneprint.datasets import FrameReference, find_sequences
from sceneprint.datasets.files import read_bytes
from sceneprint.datasets.metas import checked, meta_of
from sceneprint.datasets.png import MAXIMUM_BYTES
from sceneprint.errors import DatasetError, UnreadableCloud, UnreadableFrame
from sceneprint.scans import MAXIMUM_BYTES as MOST_OF_CLOUD
from sceneprint.scans import format_of
from sceneprint.schemas import FrameMeta

__all__ = ["checked", "meta_of", "sendable"]


def sendable(
    frame: bytes | Path | FrameReference, meta: FrameMeta | None, *, with_pose: bool
) -> tuple[bytes, FrameMeta]:
    """Bytes of a frame and what is known of it; a path's camera is looked for beside it.

    Raises
    ------
    UnreadableFrame, UnreadableCloud : the file cannot be read.
    DatasetError : there is no intrinsics.json beside a depth image or above, or it is a folder.
    InvalidIntrinsics, InvalidPose : what is beside it is none.
    TypeError : bytes without metadata, and of no point cloud.
    """
    if isinstance(frame, bytes):
        if meta is None and format_of(frame) is None:
            raise TypeError("the bytes of a depth image need its `meta`, at least the intrinsics")
        return frame, meta or FrameMeta()
    if isinstance(frame, FrameReference):
        reference = frame
    elif meta is not None:
        return _read(frame, is_cloud=meta.intrinsics is None), meta
    elif frame.is_dir():
        raise DatasetError(
            f"{frame}: This is a folder, and one frame is wanted. Name a depth image or a cloud, "
            "or send the frames that sceneprint.find_sequences returns."
        )
    else:
        reference = find_sequences(frame)[0].frames[0]
    data = _read(reference.path, is_cloud=reference.kind == "cloud")
    return data, meta_of(reference, with_pose=with_pose) if meta is None else meta


def _read(path: Path, *, is_cloud: bool) -> bytes:
    if is_cloud:
        return read_bytes(path, MOST_OF_CLOUD, UnreadableCloud)
    return read_bytes(path, MAXIMUM_BYTES, UnreadableFrame)

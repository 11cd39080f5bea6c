"""Reading of Record3D captures: .r3d files, and folders with their unpacked content.

path  --record3d_sequence-->  FrameSequence

An .r3d file is a zip with a JSON file `metadata`, and a depth image `rgbd/N.depth` for each frame:
dw x dh float32 metres, compressed with LZFSE. `metadata` has w and h of the colour images,
`perFrameIntrinsicCoeffs` (fx, fy, cx, cy of each frame) or K (column by column), and `poses`: qx,
qy, qz, qw, x, y, z of the transform from camera to world in ARKit axes (x right, y up, z backward).

The export "EXR + JPG sequence" stores depth as OpenEXR, which is not supported.
"""

from __future__ import annotations

import io
import json
import struct
import zlib
from collections import Counter
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from sceneprint.errors import (
    DatasetError,
    MissingDependency,
    SceneprintError,
    UnreadableArchive,
    UnreadableFrame,
)
from sceneprint.formats.dataset.frame_reference import FrameReference, FrameSequence, Layout
from sceneprint.formats.depth_file import encode_npy
from sceneprint.formats.exports.opengl import (
    Lens,
    depth_camera,
    number,
    optical,
    pixels,
    sequence_of,
    transform,
)
from sceneprint.types import MAXIMUM_SAMPLES, Floats
from sceneprint_client.errors import printable
from sceneprint_client.files import naming, read_bytes
from sceneprint_client.poses import rotation_of

METADATA, FRAMES, DEPTH_SUFFIX = "metadata", "rgbd", ".depth"
_MAXIMUM_METADATA_BYTES = 64 << 20
_MOST_FRAMES = 100_000
_REMEDY = "In Record3D, export the capture as .r3d (shareable internal format)."
#: Width and height of LiDAR depth in portrait orientation, for old files that do not specify them.
_LIDAR = (192, 256)


def is_record3d(files: list[str], folders: list[str]) -> bool:
    """Return whether a folder with these files and subfolders is an unpacked capture."""
    return (METADATA in files and FRAMES in folders) or (
        "metadata.json" in files and "depth" in folders and "rgb" in folders
    )


@dataclass(frozen=True)
class LzfseDepth:
    """The source of a frame's bytes: a depth image in a capture.

    Parameters
    ----------
    capture : .r3d file, or folder
    width, height : size of the depth image, pixels
    """

    capture: Path
    name: str
    width: int
    height: int

    def read_bytes(self) -> bytes:
        """Return an NPY file of float32 metres.

        Raise UnreadableFrame if the file is damaged, or its content has another size. Raise
        MissingDependency if lzfse is not installed.
        """
        size = 4 * self.width * self.height
        with naming(str(self.capture / self.name)):
            # content that cannot be compressed is slightly larger in LZFSE
            samples = _decompress(_read_part(self.capture, self.name, size + 65_536), size)
        return encode_npy(np.frombuffer(samples, "<f4").reshape(self.height, self.width))


def _decompress(packed: bytes, size: int) -> bytes:
    """Decompress a depth file; raise UnreadableFrame unless the content has `size` bytes."""
    if len(packed) == size:
        return packed
    try:
        import lzfse
    except ImportError as cause:
        raise MissingDependency(
            "Record3D compresses depth with LZFSE, but the package lzfse is not installed. "
            "Run: pip install 'lzfse>=0.4.2,<0.5'"
        ) from cause
    try:
        samples: bytes = lzfse.decompress(packed)
    except (lzfse.error, ValueError, MemoryError) as cause:
        raise UnreadableFrame(
            f"The depth cannot be decompressed ({cause}). Copy the capture again."
        ) from cause
    if len(samples) != size:
        raise UnreadableFrame(
            f"The depth has {len(samples)} bytes, but the metadata declare {size}. Export the "
            "capture again."
        )
    return samples


# The parts of a capture are members of the zip, or files of the folder.

_LOCAL_HEADER = struct.Struct("<4s4xH16xHH")
_STORED, _DEFLATED = 0, 8


def _read_part(capture: Path, name: str, limit: int) -> bytes:
    """Read a part of a capture; raise UnreadableFrame if it is missing, damaged or too large."""
    if capture.is_dir():
        return read_bytes(capture / name, limit, UnreadableFrame)
    try:
        status = capture.stat()
        place = _parts_of_zip(capture, status.st_mtime_ns, status.st_size).get(name)
        if place is None or place[2] > limit:
            raise UnreadableFrame(
                f"{name} is missing, or larger than {limit} bytes. Export the capture again."
            )
        start, packed, size = place
        with capture.open("rb") as file:
            file.seek(start)
            _, method, names, extra = _LOCAL_HEADER.unpack(file.read(_LOCAL_HEADER.size))
            file.seek(names + extra, io.SEEK_CUR)
            data = file.read(min(packed, 2 * limit))
        if method == _DEFLATED:
            data = zlib.decompressobj(-zlib.MAX_WBITS).decompress(data, size + 1)
        if method not in (_STORED, _DEFLATED) or len(data) != size:
            raise UnreadableFrame(f"{name} is damaged. Copy the capture again.")
    except (OSError, UnreadableArchive, zlib.error, struct.error) as cause:
        raise UnreadableFrame(
            printable(f"The capture cannot be read ({cause}). Copy it again.")
        ) from cause
    return data


@lru_cache(maxsize=4)
def _parts_of_zip(capture: Path, _changed_ns: int, _size: int) -> dict[str, tuple[int, int, int]]:
    """Return the offset, compressed size and size of each readable member of a zip, by name."""
    from sceneprint.formats.archive import zip_entries

    with capture.open("rb") as file:
        return {
            entry.name: (entry.start, entry.packed, entry.size)
            for entry in zip_entries(file)
            if entry.trouble is None
        }


def record3d_sequence(capture: Path, name: str) -> FrameSequence:
    """Return the frames of a capture, as a sequence.

    Parameters
    ----------
    capture : .r3d file, or folder with `metadata` and `rgbd`

    Returns
    -------
    sequence : sequence whose `note` lists the omitted frames

    Raises
    ------
    DatasetError : If the capture is damaged or exported in another format, or no frame has depth.
    """
    if capture.is_dir() and not (capture / METADATA).is_file():
        raise DatasetError(
            f"{capture}: This Record3D export stores depth as OpenEXR, which is not supported. "
            f"{_REMEDY}"
        )
    try:
        fields = json.loads(_read_part(capture, METADATA, _MAXIMUM_METADATA_BYTES))
        if not isinstance(fields, dict) or not isinstance(fields.get("poses"), list):
            raise DatasetError("there is no list of poses")
        width, height = (pixels(fields.get(key), key) for key in ("w", "h"))
        portrait = _LIDAR if width < height else _LIDAR[::-1]
        size = (
            pixels(fields.get("dw", portrait[0]), "dw"),
            pixels(fields.get("dh", portrait[1]), "dh"),
        )
        if size[0] * size[1] > MAXIMUM_SAMPLES:
            raise DatasetError(f"depth images of {size[0]} x {size[1]} pixels are too large")
    except (ValueError, RecursionError, SceneprintError) as cause:
        reason = printable(f"{cause!s:.200}")
        raise DatasetError(
            f"{capture}: The metadata cannot be read ({reason}). {_REMEDY}"
        ) from cause
    frames, left_out = list[FrameReference](), Counter[str]()
    for place, pose in enumerate(fields["poses"][:_MOST_FRAMES]):
        file = f"{FRAMES}/{place}{DEPTH_SUFFIX}"
        if not _has_part(capture, file):
            left_out["frames without depth"] += 1
            continue
        try:
            lens = _read_lens(fields, place, width, height)
            frames.append(
                FrameReference(
                    f"{name}/{place:06d}",
                    capture / file,
                    depth_camera(lens, size, 1.0),
                    _read_stamp(fields, place),
                    optical(_read_pose(pose)),
                    source=LzfseDepth(capture, file, *size),
                    original=file,
                    sequence=place,
                )
            )
        except SceneprintError as error:
            left_out[f"frames that are damaged ({error})"] += 1
    return sequence_of(capture, Layout.RECORD3D, name, frames, left_out, _REMEDY)


def _has_part(capture: Path, file: str) -> bool:
    if capture.is_dir():
        return (capture / file).is_file()
    status = capture.stat()
    return file in _parts_of_zip(capture, status.st_mtime_ns, status.st_size)


def _read_lens(fields: dict[str, Any], place: int, width: int, height: int) -> Lens:
    """Return the camera of a frame; raise DatasetError if it is invalid."""
    rows, K = fields.get("perFrameIntrinsicCoeffs"), fields.get("K")
    if isinstance(rows, list) and place < len(rows) and isinstance(rows[place], list):
        values = rows[place][:4]
    elif isinstance(K, list) and len(K) == 9:
        values = [K[0], K[4], K[6], K[7]]  # K is stored column by column
    else:
        raise DatasetError("K and perFrameIntrinsicCoeffs are missing")
    if len(values) != 4:
        raise DatasetError("a camera has fewer than four numbers")
    fx, fy, cx, cy = (number(value, "an intrinsic") for value in values)
    return Lens(fx, fy, cx, cy, width, height)


def _read_pose(values: object) -> Floats:
    """Return T_world_camera (4, 4) in ARKit axes; raise DatasetError if it is invalid."""
    if not isinstance(values, list) or len(values) != 7:
        raise DatasetError("a pose does not have seven numbers")
    numbers = np.array([number(value, "a pose") for value in values])
    length = float(np.linalg.norm(numbers[:4]))
    if not 0.9 < length < 1.1:
        raise DatasetError("the quaternion of a pose does not have unit length")
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = rotation_of(numbers[:4] / length), numbers[4:]
    return transform(T.tolist(), "a pose")


def _read_stamp(fields: dict[str, Any], place: int) -> float | None:
    stamps = fields.get("frameTimestamps")
    if isinstance(stamps, list) and place < len(stamps):
        return number(stamps[place], "a time stamp")
    return None

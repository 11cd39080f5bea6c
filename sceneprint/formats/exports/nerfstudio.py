"""Reading of folders with a nerfstudio or Instant NGP `transforms.json` that lists depth images.

folder  --nerfstudio_sequence-->  FrameSequence

The format is described at docs.nerf.studio (data conventions). fl_x, fl_y, cx, cy, w, h, k1 to k4,
p1 and p2 are fields of the file or of each frame. A frame has a `transform_matrix` from camera to
world, with the camera in OpenGL axes (x right, y up, z backward), and a `depth_file_path` relative
to the folder. `depth_unit_scale_factor` (default 0.001) is the number of metres per stored unit of
PNG and NPY depth. The exporter applied `applied_transform` to the poses. The reader inverts it, so
that poses are in the frame of the original reconstruction.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from sceneprint.errors import DatasetError, SceneprintError, UnreadableFrame
from sceneprint.formats.dataset.frame_reference import FrameReference, FrameSequence, Layout
from sceneprint.formats.depth_file import decode_npy, encode_npy
from sceneprint.formats.exports.opengl import (
    Lens,
    depth_camera,
    depth_size,
    number,
    optical,
    pixels,
    sequence_of,
    transform,
)
from sceneprint.types import Floats
from sceneprint_client.files import MAXIMUM_IMAGE_BYTES, NPY_SIGNATURE, read_bytes, read_object

TRANSFORMS = "transforms.json"
_MAXIMUM_BYTES = 64 << 20
_MOST_FRAMES = 100_000
_EXAMPLE = '{"fl_x": 525.0, "frames": [{"transform_matrix": ..., "depth_file_path": ...}]}'
_DEPTH_KEYS = ("depth_file_path", "depth_path")
_SCALE_KEYS = ("depth_unit_scale_factor", "integer_depth_scale")
_REMEDY = (
    "Frames need a depth_file_path to a PNG or NPY file. Process the capture with depth (for "
    "Polycam, ns-process-data polycam --use-depth), or upload the raw capture."
)


@dataclass(frozen=True)
class ScaledNpy:
    """The source of a frame's bytes: an NPY depth image in units other than metres.

    `metres`: metres per stored unit.
    """

    path: Path
    metres: float

    def read_bytes(self) -> bytes:
        """Return the file as an NPY file in metres; raise UnreadableFrame if it is invalid."""
        return self.converted(read_bytes(self.path, MAXIMUM_IMAGE_BYTES, UnreadableFrame))

    def converted(self, data: bytes) -> bytes:
        """Return the file with floats in metres; PNGs and integers are returned unchanged."""
        if not data.startswith(NPY_SIGNATURE):
            return data
        samples = decode_npy(data)
        if samples.dtype == np.uint16:  # the camera's depth scale applies to these samples
            return data
        with np.errstate(all="ignore"):  # overflows are missing samples
            metres = (samples * np.float32(self.metres)).astype(np.float32)
        return encode_npy(metres)


def nerfstudio_sequence(folder: Path, name: str) -> FrameSequence:
    """Return the frames of a folder with a `transforms.json`, as a sequence.

    Returns
    -------
    sequence : sequence whose `note` lists the omitted frames

    Raises
    ------
    DatasetError : If the JSON file is invalid, or no frame has depth.
    """
    file = folder / TRANSFORMS
    fields = read_object(file, _MAXIMUM_BYTES, DatasetError, _EXAMPLE)
    listed = fields.get("frames")
    if not isinstance(listed, list):
        raise DatasetError(
            f"{file}: The file has no list of frames. Write it in the form {_EXAMPLE}."
        )
    T_original_saved, scale = _original_transform(file, fields)
    frames, left_out = list[FrameReference](), Counter[str]()
    for place, entry in enumerate(listed[:_MOST_FRAMES]):
        if not isinstance(entry, dict) or _depth_name(entry) is None:
            left_out["frames without a depth_file_path"] += 1
            continue
        try:
            frame = _make_frame(folder, fields | entry, name, place)
        except SceneprintError as error:
            left_out[f"frames that are damaged ({str(error).replace(f'{folder}/', '')})"] += 1
            continue
        T_saved_camera = frame.pose
        assert T_saved_camera is not None
        T_saved_camera[:3, 3] /= scale
        frames.append(replace(frame, pose_source=T_original_saved @ T_saved_camera))
    return sequence_of(folder, Layout.NERFSTUDIO, name, frames, left_out, _REMEDY)


def _original_transform(file: Path, fields: dict[str, Any]) -> tuple[Floats, float]:
    """Return T_original_saved (4, 4), and the scale of the saved poses."""
    try:
        scale = number(fields.get("applied_scale", 1.0), "applied_scale")
        if not scale > 0:
            raise DatasetError(f"applied_scale is {scale:g}, not positive. Export the file again.")
        if "applied_transform" not in fields:
            return np.eye(4), scale
        T_saved_original = transform(fields["applied_transform"], "applied_transform")
    except DatasetError as cause:
        raise DatasetError(f"{file}: {cause}") from cause
    return np.linalg.inv(T_saved_original).astype(np.float64), scale


def _depth_name(fields: dict[str, Any]) -> str | None:
    name = next((fields[key] for key in _DEPTH_KEYS if fields.get(key)), None)
    return name if isinstance(name, str) else None


def _make_frame(folder: Path, fields: dict[str, Any], name: str, place: int) -> FrameReference:
    """Return a frame with its saved pose; raise a SceneprintError if it is invalid."""
    relative = PurePosixPath(str(_depth_name(fields)).replace("\\", "/"))
    # an untrusted file must not select arbitrary files of this machine
    if relative.is_absolute() or ".." in relative.parts:
        raise DatasetError("a depth file is outside the folder")
    path = folder / relative
    if path.suffix.lower() not in (".png", ".npy"):
        raise DatasetError(f"unsupported depth format {path.suffix or 'without a suffix'}")
    if not path.is_file():
        raise DatasetError("a depth file is missing")
    metres = next((number(fields[key], key) for key in _SCALE_KEYS if key in fields), 1e-3)
    if not 1e-6 <= metres <= 1e3:
        raise DatasetError(f"invalid depth unit of {metres:g} m")
    source = ScaledNpy(path, metres) if path.suffix.lower() == ".npy" and metres != 1.0 else None
    return FrameReference(
        f"{name}/{place:06d}-{path.stem}",
        path,
        depth_camera(_read_lens(fields), depth_size(path), 1.0 / metres),
        None,
        optical(transform(fields.get("transform_matrix"), "transform_matrix")),
        source=source,
        original=relative.as_posix(),
        sequence=place,
    )


def _read_lens(fields: dict[str, Any]) -> Lens:
    """Return the camera of a frame; raise DatasetError if it is invalid or a fisheye camera."""
    model = fields.get("camera_model", "OPENCV")
    width, height = (pixels(fields.get(key), key) for key in ("w", "h"))
    if "fl_x" not in fields and "camera_angle_x" in fields:
        angle = number(fields["camera_angle_x"], "camera_angle_x")
        fields = fields | {"fl_x": 0.5 * width / float(np.tan(0.5 * angle))}
    fx = number(fields.get("fl_x"), "fl_x")
    fy = number(fields.get("fl_y", fx), "fl_y")
    cx = number(fields.get("cx", width / 2), "cx")
    cy = number(fields.get("cy", height / 2), "cy")
    k1, k2, k3, k4, p1, p2 = (
        number(fields.get(key, 0.0), key) for key in ("k1", "k2", "k3", "k4", "p1", "p2")
    )
    if model not in ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL") or k4:
        raise DatasetError(f"unsupported camera model {model!r:.40}: undistort the images")
    distortion = (k1, k2, p1, p2, k3) if k3 else (k1, k2, p1, p2)
    return Lens(fx, fy, cx, cy, width, height, distortion if any(distortion) else ())
